"""Types of the Rust module: numpy arrays in, numpy arrays out.

Arrays are C-contiguous. ``Real`` is float32, or float64 for the backend "reference" (see
``working_dtype``). N is the number of splats, K of SH coefficients per splat, H x W the picture.
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

    Raises ValueError for another name, RuntimeError where "gpu" has no adapter.
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
    """Splats and one camera to 2D splats.

    ``colors`` is [N, 3], or [N, K, 3] SH coefficients with ``sh_degree``; ``raw_parameters`` says
    that scales are logs and opacities logits. ``viewmat`` [4, 4] is world-to-camera,
    ``intrinsics`` [4] fx, fy, cx, cy.

    Returns means2d [N, 2], factors [N, 3], covars2d [N, 3], depths [N], colors [N, 3],
    opacities [N], radii [N, 2]; a culled splat has zeros.
    """

def rasterize(
    projected: dict[str, Real],
    *,
    width: int,
    height: int,
    background: Real,
    backend: str,
) -> dict[str, Real]:
    """2D splats to color [H, W, 3], alpha, depth and transmittance [H, W]."""

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
    """Gradients v_means2d, v_covars2d, v_depths, v_colors, v_opacities and v_background [3].

    ``image`` is what ``rasterize`` returned for the same arguments.
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
    """Gradients v_means, v_quats, v_scales, v_opacities, v_colors, v_viewmat, v_intrinsics.

    The last two are float64 for every backend.
    """

def peak_multiply_add(seconds: float) -> float:
    """GFLOP/s of multiply-adds in registers on all threads, for about ``seconds``."""

def band_pixels(
    projected: dict[str, Real], *, width: int, height: int, alpha_band: float
) -> npt.NDArray[np.uint8]:
    """1 where an f32 implementation may rightly differ from the reference, [H, W].

    ``projected`` is float64. There a pair's alpha lies within ``alpha_band`` (relative) of the
    threshold, or the transmittance within 1e-4 of its own, or two depths within 1e-6.
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
    """Milliseconds [repeats] of "rasterize" and "rasterize_backward", arrays converted once."""

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
    """Milliseconds [repeats] of each of the four stages, arrays converted once."""

NEAR_PLANE: float  # what lies nearer than this, in world units, is not drawn
FAR_PLANE: float  # what lies farther than this, in world units, is not drawn
EPS2D: float  # variance in square pixels added to every projected Gaussian
ALPHA_MIN: float  # a pair fainter than this contributes nothing
ALPHA_MAX: float  # no pair is more opaque than this
TRANSMITTANCE_MIN: float  # a pixel stops before its transmittance falls below this
RIGID_TOLERANCE: float  # largest deviation of R R^T from the identity in a viewmat
TILE_SIZE: int  # side of a tile in pixels
SIDE_MAX: int  # largest side of a picture in pixels

def splats_from_points(points: Float32, colors: Float32, sh_degree: int) -> dict[str, Float32]:
    """One round splat per point [P, 3] with colours [P, 3] in 0..1.

    Returns means, quats, scales (logs of the mean distance to the three nearest neighbours),
    opacities (logits of 0.1) and sh, as ``SplatArrays`` has them.
    """

class Fitter:
    """A fit in progress; parameters and optimiser state stay where the kernels run."""

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
        """A fit to V photos.

        ``images`` are [H, W, 3] or [H, W, 4] with straight alpha, ``masks`` [H, W] or None,
        ``backgrounds`` RGB that stood behind an image without alpha, or None, ``schedule`` how many
        steps of a round are of it, at least 1, and the first step that is not of it any more, or
        None. ``viewmats`` are [V, 4, 4] relative to the splats' origin, ``intrinsics`` [V, 4].
        ``state`` is either the parameters to start from (``SplatArrays`` without origin) or what
        ``state()`` returned. ``config``: steps, first_step
        (where in the schedule a fit begins), seed, sh_degree, max_splats, density, dropout, hull,
        background; poses ("fixed", "joint"), focal ("fixed", "shared", "per-camera"), camera_rate
        (pixels a step), camera_decay, camera_warm_up (part of the steps), frozen (splats stay as
        they are); an absent or None entry takes the default. ``holds`` say where the cameras that
        are fitted are known to be, and how surely: viewmats [V, 4, 4] and intrinsics [V, 4] as
        above, information [V, 6, 6] (the inverse of the covariance of a turn, in radians, about and
        a move along the camera's axes) and focal_information [V] (of the focal length's logarithm),
        zero where nothing is known.
        """

    def step(self, count: int) -> dict[str, Any]:
        """Do ``count`` steps; ``step`` and ``splats`` afterwards and ``loss`` of the last one."""

    @property
    def steps_done(self) -> int:
        """Steps done, those of resumed runs included."""

    def splats(self) -> dict[str, Float32]:
        """The parameters as they are now, without origin."""

    def cameras(self) -> dict[str, Float64]:
        """The cameras as they are now: camera_viewmats [V, 4, 4] and camera_intrinsics [V, 4]."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """Everything needed to go on bit for bit."""

def read_splats(path: str) -> dict[str, Any]:
    """Read a splat file of any format, told by its content.

    ``SplatArrays``, antialiased (bool), format (its ending without a dot) and notes (list of
    sentences on what was passed over); OSError says what is wrong with the file.
    """

def write_splats(path: str, splats: dict[str, Any]) -> list[str]:
    """Write ``SplatArrays`` and antialiased in the format of the ending, whole or not at all.

    Returns a sentence for each thing that the format cannot hold; OSError where that fails.
    """

def write_exr(path: str, color: Float32, alpha: Float32, depth: Float32) -> None:
    """Write channels R, G, B, A, Z in 32-bit float; OSError where that fails."""
