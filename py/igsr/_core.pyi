"""Types of the Rust module. It takes and returns numpy arrays.

Arrays are C-contiguous. ``Real`` is float32, or float64 for the backend "reference" (see
``working_dtype``). N is the number of splats, K the number of spherical-harmonics coefficients per
splat, H x W the size of the picture in pixels. An argument that cannot be used raises ValueError,
whose message begins with its name.
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

    Raises:
        ValueError: ``name`` is another name.
        RuntimeError: "gpu" was asked for and no adapter answers.
    """

def backend_info(name: str) -> dict[str, str]:
    """``backend``, ``device`` and ``instruction_set`` of a resolved backend."""

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
    """Project splats to 2D Gaussians in the picture of one camera.

    Args:
        means: [N, 3], centres, in the frame that ``viewmat`` takes.
        quats: [N, 4], w x y z, of any length.
        scales: [N, 3], standard deviations, or their logarithms with ``raw_parameters``.
        opacities: [N], in [0, 1], or logits with ``raw_parameters``.
        colors: [N, 3], or [N, K, 3] spherical-harmonics coefficients with ``sh_degree``.
        sh_degree: degree to evaluate, 0-4, or None for direct colors.
        raw_parameters: whether scales are logarithms and opacities are logits.
        viewmat: [4, 4], world to camera, OpenCV axes.
        intrinsics: [4], fx, fy, cx, cy in pixels.
        width, height: of the picture, pixels.
        near, far: a splat whose centre has a camera-space z outside is not drawn.
        eps2d: variance in square pixels added to every projected Gaussian.
        antialiased: whether opacities are compensated for ``eps2d`` (Mip-Splatting).
        backend: a resolved backend.

    Returns:
        means2d [N, 2], factors [N, 3], covars2d [N, 3], depths [N], colors [N, 3], opacities [N]
        and radii [N, 2]. A culled splat has zeros.
    """

def rasterize(
    projected: dict[str, Real],
    *,
    width: int,
    height: int,
    background: Real,
    backend: str,
) -> dict[str, Real]:
    """Draw what ``project`` returned over a background [3].

    Returns:
        color [H, W, 3], and alpha, depth and transmittance [H, W].
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
    """Backward pass of ``rasterize``.

    ``image`` is what it returned for the same arguments; ``v_color``, ``v_alpha`` and ``v_depth``
    are the gradients of the loss with respect to it.

    Returns:
        v_means2d, v_covars2d, v_depths, v_colors, v_opacities and v_background [3]; with
        ``absolute`` also v_means2d_absolute [N, 2], sums of absolute values over pixels.
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
    """Backward pass of ``project``.

    ``projected`` is what it returned for the same arguments, ``v_projected`` what
    ``rasterize_backward`` returned.

    Returns:
        v_means, v_quats, v_scales, v_opacities, v_colors, v_viewmat and v_intrinsics. The last two
        are float64 for every backend.
    """

def peak_multiply_add(seconds: float) -> float:
    """GFLOP/s of multiply-adds in registers on all threads, measured for about ``seconds``."""

def band_pixels(
    projected: dict[str, Real], *, width: int, height: int, alpha_band: float
) -> npt.NDArray[np.uint8]:
    """Pixels [H, W] where a float32 implementation may differ from the reference: 1 there, else 0.

    There the alpha of a splat is within ``alpha_band`` (relative) of the threshold, or the
    transmittance within 1e-4 of its threshold, or two depths within 1e-6. ``projected`` is float64.
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

NEAR_PLANE: float  # splats nearer than this, in world units, are not drawn
FAR_PLANE: float  # splats farther than this, in world units, are not drawn
EPS2D: float  # variance in square pixels added to every projected Gaussian
ALPHA_MIN: float  # a splat whose alpha in a pixel is less does not contribute to it
ALPHA_MAX: float  # a splat's alpha in a pixel is at most this
TRANSMITTANCE_MIN: float  # a pixel stops before its transmittance falls below this
RIGID_TOLERANCE: float  # largest deviation of R R^T from the identity in a viewmat
TILE_SIZE: int  # side of a tile in pixels
SIDE_MAX: int  # largest side of a picture in pixels

def splats_from_points(points: Float32, colors: Float32, sh_degree: int) -> dict[str, Float32]:
    """One round splat per point [P, 3] with colors [P, 3] in [0, 1].

    Returns means, quats, scales (logs of the mean distance to the three nearest neighbours),
    opacities (logits of 0.1) and sh, as ``SplatArrays`` has them.
    """

class Fitter:
    """A fit in progress. Parameters and optimizer state stay where the kernels run."""

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
        holds: dict[str, Float64] | None = None,
    ) -> None:
        """Begin a fit to V photos, or continue one.

        Args:
            images: uint8 [H, W, 3], or [H, W, 4] with straight alpha.
            masks: [H, W] or None. bool: True for pixels that count; float32: confidence weights.
            backgrounds: RGB behind an image without alpha, or None.
            schedule: per image (count, end): it is sampled in ``count`` steps of a round, at least
                1, before step ``end``; None is no end.
            viewmats: [V, 4, 4], world to camera, relative to the splats' origin.
            intrinsics: [V, 4], fx, fy, cx, cy in pixels.
            state: the parameters to start from (``SplatArrays`` without origin), or what
                ``state()`` returned.
            config: steps, first_step (where in the schedule the fit begins), seed, sh_degree,
                max_splats, density, dropout, hull, background; poses ("fixed", "joint"), focal
                ("fixed", "shared", "per-camera"), camera_rate (pixels a step), camera_decay,
                camera_warm_up (part of the steps), frozen (splats stay as they are). A missing or
                None entry takes the default.
            backend: "cpu" or "gpu".
            holds: pose priors of the cameras that are fitted: viewmats [V, 4, 4] and intrinsics
                [V, 4] as above, information [V, 6, 6] (inverse covariance of a rotation about the
                camera's axes, in radians, and a translation along them) and focal_information [V]
                (of the logarithm of the focal length); zero where nothing is known.
        """

    def step(self, count: int) -> dict[str, Any]:
        """Do ``count`` steps. Returns ``step`` and ``splats`` after them, ``loss`` of the last."""

    @property
    def steps_done(self) -> int:
        """Steps done, including those before a resume."""

    def splats(self) -> dict[str, Float32]:
        """The current parameters, ``SplatArrays`` without origin."""

    def cameras(self) -> dict[str, Float64]:
        """The current cameras: camera_viewmats [V, 4, 4] and camera_intrinsics [V, 4]."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """The whole state: a fit that starts from it continues bit for bit."""

def read_splats(path: str) -> dict[str, Any]:
    """Read a splat file; its content decides the format.

    Returns:
        ``SplatArrays``, antialiased (bool), format (its ending without a dot) and notes (messages
        on what was ignored).

    Raises:
        OSError: the file cannot be read; the message says why.
    """

def write_splats(path: str, splats: dict[str, Any]) -> list[str]:
    """Write ``SplatArrays`` and antialiased in the format of the ending, whole or not at all.

    Returns:
        A message for each thing that the format cannot hold.

    Raises:
        OSError: the file cannot be written.
    """

def write_exr(path: str, color: Float32, alpha: Float32, depth: Float32) -> None:
    """Write an OpenEXR file with the channels R, G, B, A and Z as 32-bit floats.

    ``color`` is [H, W, 3], ``alpha`` and ``depth`` [H, W].

    Raises:
        OSError: the file cannot be written.
    """
