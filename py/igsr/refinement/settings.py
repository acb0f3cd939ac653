"""The settings of a refinement: one frozen dataclass, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from igsr._internal.choices import FitBackend
from igsr._internal.settings import about, validate
from igsr.errors import IgsrError
from igsr.fitting.presets import Quality
from igsr.fitting.settings import MAX_STEPS, ExposureMode, TransientMode

#: One round, or ``ALPHA_ROUNDS`` of photos with alpha.
AUTO = "auto"
#: By quality. Further rounds gain on objects, not on photographs (docs/research/refinement.md).
ALPHA_ROUNDS: dict[Quality, int] = {"draft": 1, "normal": 2, "high": 4}


def _read_rounds(name: str, value: Any) -> int | str:
    """Read a number of rounds or "auto"; command lines give both as text."""
    if isinstance(value, str):
        if value == AUTO:
            return AUTO
        if value.removeprefix("-").isdecimal():
            value = int(value)
    if not isinstance(value, int) or isinstance(value, bool):
        raise IgsrError(f'{name} must be a whole number or "auto", not {value!r}.')
    if value < 0:
        raise IgsrError(f"{name} must not be negative, not {value}.")
    return value


@dataclass(frozen=True, kw_only=True)
class RefineSettings:
    """Everything that decides a refinement, except the photos and the denoiser.

    ``igsr.refine`` describes each setting.

    Raises:
        IgsrError: a setting has an invalid value.
    """

    rounds: str | int = field(default=AUTO, metadata=about(read=_read_rounds))
    steps: int | None = field(default=None, metadata=about(limits=(1, MAX_STEPS)))
    quality: Quality = field(default="normal", metadata=about())
    backend: FitBackend = field(default="auto", metadata=about())
    seed: int = field(default=0, metadata=about(limits=(0, 2**63 - 1)))
    exposure: ExposureMode = field(default="off", metadata=about())
    transients: TransientMode = field(default="auto", metadata=about())

    def __post_init__(self) -> None:
        validate(self)

    def most_rounds(self, has_alpha: bool) -> int:
        """Maximum number of rounds, for photos with or without alpha."""
        if isinstance(self.rounds, str):
            return ALPHA_ROUNDS[self.quality] if has_alpha else 1
        return self.rounds
