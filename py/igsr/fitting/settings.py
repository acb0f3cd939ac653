"""The settings of a fit: one frozen dataclass, checked when it is made.

``igsr.fit`` takes them as keywords, ``igsr fit`` as options made from this class, and checkpoints
record them. ``igsr.fitting.presets`` has values for those that nobody gave.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from igsr._internal.settings import about, checked, settings_of, validate
from igsr.errors import IgsrError

Density: TypeAlias = Literal["mcmc", "original", "fixed"]
Initialization: TypeAlias = Literal[
    "auto", "points", "depths", "hull", "sift", "rays", "random", "sfm"
]
Poses: TypeAlias = Literal["fixed", "joint"]
Focal: TypeAlias = Literal["fixed", "shared", "per-camera"]
ExposureMode: TypeAlias = Literal["auto", "on", "off"]
TransientMode: TypeAlias = Literal["auto", "on", "off"]

#: Highest degree of spherical harmonics, as ``igsr.splats.MAX_SH_DEGREE``.
_MAX_SH_DEGREE = 4


def _color(name: str, value: Any) -> tuple[float, ...]:
    """RGB in [0, 1]: any three numbers, an array too."""
    try:
        color = tuple(float(channel) for channel in value)
    except (TypeError, ValueError):
        color = ()
    if len(color) != 3 or not all(0.0 <= channel <= 1.0 for channel in color):
        raise IgsrError(f"{name} must be three numbers in 0..1, not {value!r}.")
    return color


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Everything that decides the result of a fit, but for the photos and the backend.

    Each field says in its metadata what it means (``igsr._internal.settings``). Presets have values
    for all that have no default here.

    Attributes:
        first_step: steps of the schedule that count as done: a fit that goes on from splats enters
            it late.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    steps: int = field(
        metadata=about("Optimizer steps, each on one photo.", limits=(1, 10_000_000))
    )
    seed: int = field(
        default=0,
        metadata=about(
            "Random seed. Results are deterministic for a given seed.",
            limits=(0, 2**63 - 1),
        ),
    )
    max_splats: int = field(metadata=about("Most splats there may be.", limits=(1, 2**27)))
    sh_degree: int = field(
        metadata=about(
            "Degree of the spherical harmonics of colors, 0 to 4.", limits=(0, _MAX_SH_DEGREE)
        )
    )
    density: Density = field(
        metadata=about(
            "How splats are added and removed: mcmc (relocation and growth up to the maximum), "
            "original (clone, split, prune), fixed (neither).",
            aliases=("strategy",),
        )
    )
    learning_rate: float = field(
        metadata=about(
            "What the first half of the steps multiplies the learning rates of 3DGS by; in the "
            "second half it falls to 1. Short fits need larger steps.",
            limits=(0.01, 100.0),
        ),
    )
    dropout: float = field(
        metadata=about(
            "Fraction of the splats that a step leaves out at random, 0 to 0.9. It grows from 0 "
            "to this over the fit. Against overfitting few photos.",
            limits=(0.0, 0.9),
        )
    )
    start: Initialization = field(
        metadata=about(
            "Initialization: points (of the capture), depths (these and points of the photos' "
            "depth maps), hull (visual hull of photos with alpha), sift (triangulated features), "
            "rays (pixels at the depth where photos agree), random, sfm (points, else random, "
            "as 3DGS), or auto (chosen by the capture).",
            aliases=("init",),
        )
    )
    coarse_to_fine: bool = field(
        metadata=about(
            "Begin with photos of an eighth to half of their size; the last seven tenths of "
            "the steps have their whole size."
        )
    )
    depth_weight: float = field(
        metadata=about(
            "What the difference to the depths that photos came with counts in the first step, "
            "beside that to the photos; it falls to a hundredth. 0 does not use these depths.",
            limits=(0.0, 100.0),
        ),
    )
    poses: Poses = field(metadata=about("joint: optimize the cameras' poses with the splats."))
    focal: Focal = field(
        metadata=about(
            "Focal lengths that are optimized: none (fixed), one factor for all (shared), or "
            "each (per-camera)."
        ),
    )
    exposure: ExposureMode = field(
        metadata=about(
            "Gain and offset per channel of each photo, optimized with the splats: on, off, or "
            "auto (on where points that photos share, or EXIF, show other exposures)."
        ),
    )
    transients: TransientMode = field(
        metadata=about(
            "Mask what one photo shows and the others do not, such as people and cars: on, off, or "
            "auto (on where such things are large and plain to see)."
        ),
    )
    remove_floaters: bool = field(
        metadata=about(
            "In the end, remove splats that no photo shows, those that masks hide, and those far "
            "before the surface that at most one photo needs."
        )
    )
    backdrop: bool = field(
        metadata=about(
            "In the end, put a sphere of 200 large splats behind the scene, so that what no photo "
            "shows is not black; not for photos with alpha, or with masks that cut an object out."
        )
    )
    background: tuple[float, float, float] | None = field(
        default=None,
        metadata=about(
            "RGB in [0, 1] behind splats and photos with alpha. None: a new random color in each "
            "step for photos with alpha, black for photos without.",
            read=_color,
        ),
    )
    first_step: int = 0

    def __post_init__(self) -> None:
        """Check all settings."""
        validate(self)

    @property
    def moves_cameras(self) -> bool:
        """Whether poses or focal lengths are optimized with the splats."""
        return self.poses != "fixed" or self.focal != "fixed"

    def plain(self) -> dict[str, Any]:
        """The settings by name, as JSON has them, without ``first_step``."""
        values = dataclasses.asdict(self)
        del values["first_step"]
        if self.background is not None:
            values["background"] = list(self.background)
        return values


def check_whole_number(name: str, value: object) -> None:
    """Check one setting that is a whole number, such as "steps" or "seed".

    Raises:
        IgsrError: it is no whole number, or out of its range.
    """
    checked(settings_of(FitSettings)[name], value)
