"""The settings of a refinement: one frozen dataclass, checked when it is made."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

from igsr._internal.settings import about, validate
from igsr.errors import IgsrError
from igsr.fitting.presets import Quality
from igsr.fitting.settings import ExposureMode, TransientMode

#: As many rounds as help, but at most ``MOST_ROUNDS``.
AUTO = "auto"
MOST_ROUNDS = 4


def _read_rounds(name: str, value: Any) -> int | str:
    """A number of rounds, or "auto"; on the command line both are text."""
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
    """What a refinement depends on, beside the photos and the denoiser.

    Attributes:
        rounds: most rounds, or "auto", which is 4. A round that is not accepted is the last one.
        steps: of each fit; None is the default preset's.
        quality: "draft", "normal" or "high", of the default preset.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        seed: of everything random. The result is deterministic for a given seed on one backend,
            instruction set and number of threads.
        exposure: whether the first fit finds exposures of photos: "off", "on" or "auto", as
            ``FitSettings.exposure``.
        transients: whether the first fit finds things that are in one photo alone, which are masked
            from then on: "off", "on" or "auto", as ``FitSettings.transients``.
        cross_validate: whether a round is done with all photos only if, done by folds, it improves
            the scores of the photos that they hold out.

    Raises:
        IgsrError: a setting cannot be used.
    """

    rounds: str | int = field(
        default=AUTO,
        metadata=about(
            f"Most rounds, or auto: until one does not help, at most {MOST_ROUNDS}.",
            read=_read_rounds,
        ),
    )
    steps: int | None = field(
        default=None,
        metadata=about(
            "Optimizer steps of each fit. Default: the default preset's.", limits=(1, 10_000_000)
        ),
    )
    quality: Quality = field(
        default="normal",
        metadata=about("Size of photos, steps and splats, where these options do not say."),
    )
    backend: Literal["auto", "cpu", "gpu"] = field(
        default="auto", metadata=about("auto: the GPU if there is a real one, else the CPU.")
    )
    seed: int = field(
        default=0,
        metadata=about(
            "Of everything random; the result is deterministic for a given seed.",
            limits=(0, 2**63 - 1),
        ),
    )
    exposure: ExposureMode = field(
        default="off",
        metadata=about(
            "Gain and offset per channel of each photo, found by the first fit and taken out of "
            "the photos: on, off, or auto (on where points that photos share, or EXIF, show other "
            "exposures)."
        ),
    )
    transients: TransientMode = field(
        default="auto",
        metadata=about(
            "Mask what one photo shows and the others do not, such as people and cars, from the "
            "first fit on: on, off, or auto (on where such things are large and plain to see)."
        ),
    )
    cross_validate: bool = field(
        default=True,
        metadata=about(
            "Do a round with all photos only if, done by folds of them first, it improves the "
            "scores of the photos that these hold out."
        ),
    )

    def __post_init__(self) -> None:
        validate(self)

    @property
    def most_rounds(self) -> int:
        """Most rounds, as a number."""
        return MOST_ROUNDS if isinstance(self.rounds, str) else self.rounds
