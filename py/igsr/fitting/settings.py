"""The settings of a fit: one frozen dataclass, checked when it is made."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias

from igsr._internal.settings import about, validate
from igsr.errors import IgsrError

Density: TypeAlias = Literal["mcmc", "original", "fixed"]
Initialization: TypeAlias = Literal["auto", "points", "depths", "hull", "rays", "random"]
Poses: TypeAlias = Literal["fixed", "joint"]
Focal: TypeAlias = Literal["fixed", "shared", "per-camera"]
ExposureMode: TypeAlias = Literal["auto", "on", "off"]
TransientMode: TypeAlias = Literal["auto", "on", "off"]

#: Highest degree of spherical harmonics, as ``igsr.splats.MAX_SH_DEGREE``.
_MAX_SH_DEGREE = 4
MAX_STEPS = 10_000_000


def _color(name: str, value: Any) -> tuple[float, ...]:
    """RGB in [0, 1] from any three numbers, also from an array."""
    try:
        color = tuple(float(channel) for channel in value)
    except (TypeError, ValueError):
        color = ()
    if len(color) != 3 or not all(0.0 <= channel <= 1.0 for channel in color):
        raise IgsrError(f"{name} must be three numbers in 0..1, not {value!r}.")
    return color


@dataclass(frozen=True, kw_only=True)
class FitSettings:
    """Everything that decides the result of a fit, except the photos and the backend.

    ``igsr.fit`` describes each setting.

    Attributes:
        first_step: number of steps of the schedule that count as done. A fit that starts from
            splats enters the schedule late.

    Raises:
        IgsrError: a setting has an invalid value; the message names the setting.
    """

    steps: int = field(metadata=about(limits=(1, MAX_STEPS)))
    seed: int = field(default=0, metadata=about(limits=(0, 2**63 - 1)))
    max_splats: int = field(metadata=about(limits=(1, 2**27)))
    sh_degree: int = field(metadata=about(limits=(0, _MAX_SH_DEGREE)))
    density: Density = field(metadata=about())
    learning_rate: float = field(metadata=about(limits=(0.01, 100.0)))
    dropout: float = field(metadata=about(limits=(0.0, 0.9)))
    start: Initialization = field(metadata=about())
    coarse_to_fine: bool = field(metadata=about())
    depth_weight: float = field(metadata=about(limits=(0.0, 100.0)))
    poses: Poses = field(metadata=about())
    focal: Focal = field(metadata=about())
    exposure: ExposureMode = field(metadata=about())
    transients: TransientMode = field(metadata=about())
    remove_floaters: bool = field(metadata=about())
    backdrop: bool = field(metadata=about())
    background: tuple[float, float, float] | None = field(default=None, metadata=about(read=_color))
    first_step: int = 0

    def __post_init__(self) -> None:
        """Check all settings."""
        validate(self)

    @property
    def moves_cameras(self) -> bool:
        """Whether poses or focal lengths are optimized with the splats."""
        return self.poses != "fixed" or self.focal != "fixed"

    def plain(self) -> dict[str, Any]:
        """The settings by name, as JSON values, without ``first_step``."""
        values = dataclasses.asdict(self)
        del values["first_step"]
        if self.background is not None:
            values["background"] = list(self.background)
        return values
