"""Types of the Rust module: numpy arrays in, numpy arrays out.

Arrays are C-contiguous. ``Real`` is float32, or float64 for the backend "reference" (see
``working_dtype``). N is the number of splats, K of SH coefficients per splat, H x W the picture's
size in pixels, V the number of photos. Lengths and depths are in world units. Every ``backend`` is
a resolved one: "cpu", "gpu" or "reference".

A wrong argument raises ValueError, whose message begins with the argument's name; a missing or
unknown one raises TypeError; a GPU that is missing or fails raises RuntimeError.
"""

from collections.abc import Sequence
from typing import Any, Literal, TypedDict

import numpy as np
import numpy.typing as npt

__version__: str

Real = npt.NDArray[Any]
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

class SplatArrays(TypedDict):
    """Splat parameters as fitted and stored: log-scales, opacity logits."""

    means: Float32  # [N, 3] relative to origin
    quats: Float32  # [N, 4] wxyz
    scales: Float32  # [N, 3]
    opacities: Float32  # [N]
    sh: Float32  # [N, K, 3]
    origin: Float64  # [3]

def resolve_backend(name: str) -> Literal["cpu", "gpu", "reference"]:
    """The backend that "auto", "cpu", "gpu" or "reference" stands for.

    Raises ValueError for another name, RuntimeError where "gpu" has no adapter or the one that
    answers fails; there, "auto" is "cpu", and a UserWarning says why, once.
    """

def backend_info(name: str) -> dict[str, str]:
    """``backend``, ``device`` and ``instruction_set`` of a resolved backend."""

def gpu_report() -> dict[str, Any]:
    """Driver and limits of the backend "gpu"'s device."""

def run_viewer(words: list[str]) -> int:
    """Do what a command line of splat-view asks for; its exit status.

    A window is opened by the process's first thread only. Ctrl-C ends it only where SIGINT has the
    system's own handler.
    """

def example_files() -> dict[str, bytes]:
    """The files of the example capture, by their names in its folder."""

def time_gpu_start() -> tuple[float, float, float]:
    """Milliseconds to open the best adapter, compile all kernels, and test them."""

def inject_gpu_faults(faults: list[str]) -> None:
    """For tests: close the devices; adapters fail by "shader", "values", "limits" or "memory".

    "real" makes a software adapter pass for a real one.
    """

def lose_gpu() -> None:
    """For tests: lose the open devices, as a driver that is reset does."""

def working_dtype(backend: str) -> type[np.floating[Any]]:
    """The dtype of every Real array of a resolved backend."""

def project(
    means: Real,
    quats: Real,
    scales: Real,
    opacities: Real,
    colors: Real,
    *,
    sh_degree: int | None,
    raw_parameters: bool,
    viewmat: Float64,
    intrinsics: Float64,
    width: int,
    height: int,
    near: float,
    far: float,
    eps2d: float,
    antialiased: bool,
    backend: str,
) -> dict[str, Real]:
    """Project splats to 2D splats, as one camera sees them.

    ``means`` [N, 3], ``quats`` [N, 4] wxyz, ``scales`` [N, 3], ``opacities`` [N]. ``colors`` is
    [N, 3], or [N, K, 3] SH coefficients with ``sh_degree``. ``raw_parameters`` says that scales are
    logarithms and opacities logits. ``viewmat`` [4, 4] is world-to-camera in OpenCV axes,
    ``intrinsics`` [4] is fx, fy, cx, cy in pixels. Splats nearer than ``near`` or farther than
    ``far`` are culled. ``eps2d`` is added to the variances of the 2D covariance, square pixels;
    with ``antialiased`` opacities are lowered to make up for it.

    Returns means2d [N, 2] in pixels, factors [N, 3], depths [N], colors [N, 3], opacities [N],
    radii [N, 2]; a culled splat has zeros.
    """

def rasterize(
    projected: dict[str, Real],
    *,
    width: int,
    height: int,
    background: Real,
    backend: str,
) -> dict[str, Real]:
    """Draw 2D splats over a background [3].

    ``projected`` is what ``project`` returns. Returns color [H, W, 3] and alpha, depth and
    transmittance [H, W]; depth is accumulated: divide it by alpha for the expected depth.
    """

def rasterize_backward(
    projected: dict[str, Real],
    image: dict[str, Real],
    *,
    v_color: Real,
    v_alpha: Real,
    v_depth: Real,
    background: Real,
    absolute: bool,
    backend: str,
) -> dict[str, Real]:
    """Turn gradients of a picture into gradients of its 2D splats and background.

    ``image`` is what ``rasterize`` returned for the same arguments. Returns v_means2d [N, 2],
    v_factors [N, 3], v_depths [N], v_colors [N, 3], v_opacities [N] and v_background [3]; with
    ``absolute`` also v_means2d_absolute [N, 2], the sums of the pixels' absolute gradients.
    """

def project_backward(
    means: Real,
    quats: Real,
    scales: Real,
    opacities: Real,
    colors: Real,
    projected: dict[str, Real],
    v_projected: dict[str, Real],
    *,
    sh_degree: int | None,
    raw_parameters: bool,
    viewmat: Float64,
    intrinsics: Float64,
    width: int,
    height: int,
    near: float,
    far: float,
    eps2d: float,
    antialiased: bool,
    backend: str,
) -> dict[str, Real]:
    """Turn gradients of 2D splats into gradients of the splats and the camera.

    Returns v_means, v_quats, v_scales, v_opacities and v_colors, shaped as the parameters, and
    v_viewmat [4, 4] and v_intrinsics [4], which are float64 for every backend.
    """

def peak_multiply_add(seconds: float) -> float:
    """Measure GFLOP/s of multiply-adds in registers on all threads, for about ``seconds``."""

def band_pixels(
    projected: dict[str, Real], *, width: int, height: int, alpha_band: float
) -> npt.NDArray[np.uint8]:
    """Pixels where rounding to float32 may change which splats count: 1 there, [H, W].

    In these, a pair's alpha lies within ``alpha_band`` (relative) of its threshold, or the
    transmittance within 1e-4 of its own, or two depths within 1e-6. ``projected`` is float64.
    """

def time_rasterize(
    projected: dict[str, Real],
    *,
    width: int,
    height: int,
    background: Real,
    v_color: Real,
    v_alpha: Real,
    v_depth: Real,
    repeats: int,
    backend: str,
) -> dict[str, Float64]:
    """Milliseconds [repeats] of "rasterize" and "rasterize_backward"; arrays are converted once."""

def time_pipeline(
    means: Real,
    quats: Real,
    scales: Real,
    opacities: Real,
    colors: Real,
    *,
    sh_degree: int | None,
    raw_parameters: bool,
    viewmat: Float64,
    intrinsics: Float64,
    width: int,
    height: int,
    near: float,
    far: float,
    eps2d: float,
    antialiased: bool,
    background: Real,
    v_color: Real,
    v_alpha: Real,
    v_depth: Real,
    repeats: int,
    backend: str,
) -> dict[str, Float64]:
    """Milliseconds [repeats] of each of the four stages; arrays are converted once."""

NEAR_PLANE: float  # default near plane of rasterization, world units
FAR_PLANE: float  # splats farther than this are culled, world units
EPS2D: float  # variance in square pixels added to every projected Gaussian
JACOBIAN_MARGIN: float  # part of tan(fov / 2) beyond each edge at which x/z and y/z are clamped
ALPHA_MIN: float  # a pair fainter than this contributes nothing
ALPHA_MAX: float  # no pair is more opaque than this
TRANSMITTANCE_MIN: float  # a pixel stops before its transmittance falls below this
RIGID_TOLERANCE: float  # largest deviation of R R^T from the identity in a viewmat
TILE_SIZE: int  # side of a tile in pixels
SIDE_MAX: int  # largest side of a picture in pixels
LEVELS_INDEX: str  # name of the file that lists the cells of a scene in levels of detail

def splats_from_points(points: Float32, colors: Float32, sh_degree: int) -> dict[str, Float32]:
    """One isotropic splat per point [P, 3] with colors [P, 3] in 0..1.

    Returns means, quats, scales (logarithms of the mean distance to the three nearest neighbors),
    opacities (logits of 0.1) and sh, as ``SplatArrays`` has them.
    """

def reduction(steps: int, coarse_to_fine: bool, step: int, longest: int) -> int:
    """What both sides of photos are divided by in a step, from 0, of a fit from coarse to fine.

    ``longest`` is the longest side of all photos, in pixels.
    """

def depth_maps(
    grays: list[Float32],
    usable: list[npt.NDArray[np.uint8]],
    viewmats: Float64,
    intrinsics: Float64,
    searches: Sequence[tuple[int, Sequence[int], tuple[float, float], Float32]],
) -> list[dict[str, Float32]]:
    """Depth maps by PatchMatch stereo, of the pixels that other depth maps confirm.

    Args:
        grays: gray in 0..1 of V photos, [H, W] each.
        usable: which of their pixels count, [H, W], not 0 where they do.
        viewmats: [V, 4, 4], world-to-camera.
        intrinsics: [V, 4], fx, fy, cx, cy in pixels.
        searches: (index of the photo, indices of up to 8 compared with, inverse depths of the
            nearest and the farthest surface, known points [P, 3] as column, row and inverse depth),
            one for each map.

    Returns:
        For each search "depth" [H, W], 0 where nothing confirms it; "normal" [H, W, 3] towards the
        camera, in its frame; and "confidence" [H, W] in 0..1.
    """

class Fitter:
    """A fit in progress; parameters and optimizer state stay on the device that computes."""

    def __init__(
        self,
        images: list[npt.NDArray[np.uint8]],
        masks: list[npt.NDArray[np.bool_] | npt.NDArray[np.float32] | None],
        backgrounds: Sequence[tuple[float, float, float] | None],
        schedule: Sequence[tuple[int, int | None]],
        viewmats: Float64,
        intrinsics: Float64,
        state: dict[str, Any],
        config: dict[str, Any],
        backend: str,
        pose_priors: dict[str, Float64] | None = None,
        exposures: dict[str, npt.NDArray[Any]] | None = None,
        rigs: Sequence[int] | None = None,
        depths: list[npt.NDArray[np.float32] | None] | None = None,
    ) -> None:
        """A fit to V photos.

        Args:
            images: [H, W, 3], or [H, W, 4] with straight alpha.
            masks: [H, W] each, or None: bool, or float32 weights.
            backgrounds: RGB in 0..1 behind an image without alpha, or None if not known.
            schedule: for each photo, its steps per round (at least 1), and the first step from
                which it is left out, or None.
            viewmats: [V, 4, 4], world-to-camera, relative to the splats' origin.
            intrinsics: [V, 4], fx, fy, cx, cy in pixels.
            state: the initialization (``SplatArrays`` without origin), or what ``state()``
                returned.
            config: steps, first_step (where in the schedule the fit begins), seed, sh_degree,
                max_splats, density ("mcmc", "original", "fixed"), learning_rate (what the first
                half of the steps multiplies rates by), dropout, background, coarse_to_fine
                (the first steps are on photos of a fraction of their size), depth_weight (what the
                loss of depths is multiplied by in the first step); poses ("fixed",
                "joint"), focal ("fixed", "shared", "per-camera"), camera_rate (pixels per
                step), camera_decay, camera_warm_up (fraction of the steps), frozen (splats are not
                changed), frozen_splats (so many, the last ones, are drawn and not changed),
                exposures (whether gains and offsets of the photos are fitted). An absent or None
                entry takes the default.
            backend: "cpu" or "gpu".
            pose_priors: pose priors of the fitted cameras: viewmats and intrinsics as above,
                information [V, 6, 6] (the inverse covariance of a rotation in radians about, and a
                translation along, the camera's axes) and focal_information [V] (of the logarithm of
                the focal length); zero where nothing is known.
            exposures: where the exposures that are fitted start: gains [V, 3], offsets [V, 3],
                fitted [V], False for photos with the splats' own colors, and pulls [V] back to
                the start.
            rigs: [V], the rig of each photo, whose cameras move as one.
            depths: of each photo float32 [H, W, 2], camera-space z in world units and its
                confidence in 0..1, 0 where z is not known; or None.
        """

    def step(self, count: int) -> dict[str, Any]:
        """Do ``count`` steps. Returns ``step``, ``splats`` (their number) and the last ``loss``."""

    def measured_steps(self, count: int) -> list[list[tuple[str, float]]]:
        """Do ``count`` steps; return the commands of each with their milliseconds on the GPU.

        Commands are entry points of kernels, "copy" and "clear". Each runs in a pass of its own, so
        steps take longer than by ``step``.

        Raises:
            ValueError: the backend is "cpu".
            RuntimeError: the device has no timestamps.
        """

    @property
    def steps_done(self) -> int:
        """Number of steps done, with those before the fit was resumed."""

    def splats(self) -> dict[str, Float32]:
        """The parameters as they are now, without origin."""

    def cameras(self) -> dict[str, Float64]:
        """The cameras as they are now: camera_viewmats [V, 4, 4] and camera_intrinsics [V, 4]."""

    def exposures(self) -> dict[str, Float64] | None:
        """The exposures as they are now: gains and offsets, [V, 3] each; None if not fitted."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Everything needed to resume the fit with the same bits: the constructor's ``state``."""

def read_splats(path: str) -> dict[str, Any]:
    """Read a splat file; its content tells the format.

    Returns ``SplatArrays``, antialiased (bool), format (its ending without a dot) and notes
    (messages on what was ignored). Raises OSError where the file cannot be read.
    """

def write_splats(path: str, splats: dict[str, Any]) -> list[str]:
    """Write ``SplatArrays`` and antialiased in the format of the ending, whole or not at all.

    Returns a message for each thing that the format cannot hold. Raises OSError where the file
    cannot be written.
    """

def write_levels(source: str, folder: str, levels: int, per_cell: int) -> dict[str, Any]:
    """Write a splat file in levels of detail into an empty folder, in bounded memory.

    Returns counts (splats of each level, 0 the finest), cells, files (numbers) and notes. Raises
    ValueError for a number that cannot be used, and OSError where a file cannot be read or written.
    """

def read_level(path: str, most: int) -> dict[str, Any]:
    """Read the finest level of a ``lod-meta.json`` that has at most so many splats.

    Returns ``SplatArrays``, antialiased (bool) and level (its number). Raises OSError where a file
    cannot be read, or the coarsest level has more.
    """

def splat_extent(
    means: Float32, opacities: Float32
) -> tuple[tuple[float, float, float], float, float]:
    """Center of visible splats, their radius, and the near plane of renders."""

def camera_extent(centers: Float64) -> float:
    """1.1 times the largest distance from the mean center, without outliers."""

def morton_order(points: Float32) -> npt.NDArray[np.int64]:
    """Ids of points [N, 3] along Morton's curve, as the writers order splats."""

def read_exr_depth(path: str, most: int) -> Float32:
    """Read channel Z of an EXR file, or its only channel, float32 [H, W].

    Raises OSError or ValueError where the file cannot be read.
    """

def write_exr(path: str, color: Float32, alpha: Float32, depth: Float32) -> None:
    """Write channels R, G, B, A, Z of [H, W] in 32-bit float.

    Raises OSError where the file cannot be written.
    """
