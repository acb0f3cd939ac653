"""Transient things in a fit: looked for at a few of its steps, and masked from then on.

A fit is a function of its state and its views. Where masks change, the fitter is made anew from the
views with their new masks, and from the state so far, as where a checkpoint is resumed. Where the
first are found, the fit begins anew: what it made of such things by then would stay where they hide
the photos that tell against it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import Backend
from igsr.capture import Capture, View
from igsr.errors import IgsrError
from igsr.fitting.fitter import (
    fitted_cameras,
    fitted_exposures,
    without_exposures,
)
from igsr.fitting.settings import FitSettings
from igsr.floaters.photo_evidence import behind_masks
from igsr.splats import PARAMETERS, Splats, subset
from igsr.transients import PLAIN, find_transients

Bool = npt.NDArray[np.bool_]

#: Parts of the steps after which transient things are looked for.
MOMENTS = (0.3, 0.5, 0.7)
#: What checkpoints call the masks, packed bits of all photos, and the step of the last look.
MASKS, LOOKED = "transient_masks", "transients_looked"

MakeFitter: TypeAlias = Callable[[Sequence[View], dict[str, Any]], _core.Fitter]
#: Of some views: the state, and what its splats were made from, with their number.
BeginningOf: TypeAlias = Callable[[Sequence[View]], tuple[dict[str, Any], tuple[str, int]]]


def steps_to_look(settings: FitSettings, views: Sequence[View]) -> tuple[int, ...]:
    """After which steps transient things are looked for.

    Photos with alpha show what was cut out of them and nothing else: "auto" is off there.
    """
    photos = [view for view in views if view.weights is None]
    has_alpha = any(view.image.shape[2] == 4 for view in photos)
    is_off = settings.transients == "auto" and has_alpha
    # Two photos must see what a third one has alone.
    if settings.transients == "off" or is_off or len(photos) < 3:
        return ()
    first, all_steps = settings.first_step, settings.steps
    return tuple(sorted({first + round(part * (all_steps - first)) for part in MOMENTS}))


@dataclass
class TransientSearch:
    """The search in one fit.

    Attributes:
        views: of the fit, with the masks that they were given.
        settings: of the fit.
        origin: float64 [3] of the splats.
        backend: "cpu" or "gpu".
        make: makes the fitter of views and a state.
        found: for each view, bool [H, W], the pixels that show transient things; None where none.
        looked: the step of the last look; -1 before the first.
        frozen: so many splats, the last ones, stay in any case.
        beginning: what the fit of some views begins with; None where what was found so far, such as
            cameras, must not be lost: then the fit goes on from there.
        begun: what splats the fit began anew with, and their number; None where it did not.
    """

    views: Sequence[View]
    settings: FitSettings
    origin: npt.NDArray[np.float64]
    backend: Backend
    make: MakeFitter
    found: list[Bool | None] = field(default_factory=list)
    looked: int = -1
    frozen: int = 0
    beginning: BeginningOf | None = None
    begun: tuple[str, int] | None = None

    def __post_init__(self) -> None:
        """Begin without masks, unless some are given."""
        self.found = self.found or [None] * len(self.views)
        self._steps = steps_to_look(self.settings, self.views)

    def next_look(self, step: int) -> int | None:
        """The first step after ``step`` that is to be looked after; None after the last."""
        return min((at for at in self._steps if at > step), default=None)

    def is_due(self, step: int) -> bool:
        """Whether it is to be looked after this step, and was not.

        Where the first look finds nothing, "auto" is off.
        """
        is_off = self.settings.transients == "auto" and self.looked >= 0 and not any_of(self.found)
        return step in self._steps and self.looked < step and not is_off

    def masked_views(self) -> list[View]:
        """The views, with masks that leave out transient things."""
        return _masked(self.views, self.found)

    def look(self, fitter: _core.Fitter) -> _core.Fitter:
        """Look for transient things; the fitter to go on with, the same where nothing changed."""
        splats = Splats(**fitter.splats(), origin=self.origin, antialiased=False)
        cameras = fitted_cameras(self.views, fitter, self.origin)
        views = [
            replace(view, camera=camera) for view, camera in zip(self.views, cameras, strict=True)
        ]
        views = without_exposures(views, fitted_exposures(self.views, fitter))
        is_open = self.settings.transients == "auto" and not any_of(self.found)
        found = find_transients(
            splats,
            views,
            self.found,
            least=PLAIN if is_open else 0.0,
            background=self.settings.background or (0.0, 0.0, 0.0),
            backend=self.backend,
        )
        looked = int(fitter.steps_done)
        masked = _masked(self.views, found)
        anew = None if any_of(self.found) or not any_of(found) else self._beginning_of(masked)
        if anew is not None:
            state, self.begun = anew
            fitter = self.make(masked, state)
        elif any_of(found) or any_of(self.found):
            state = _selected(fitter.state(), self._kept(splats, views, found))
            fitter = self.make(masked, state)
        # Last: whoever is interrupted before saves a checkpoint of before the look.
        self.found, self.looked = found, looked
        return fitter

    def _beginning_of(self, views: Sequence[View]) -> tuple[dict[str, Any], tuple[str, int]] | None:
        """What a fit of the views begins with; None where it goes on from the splats so far."""
        if self.beginning is None:
            return None
        try:
            return self.beginning(views)
        except IgsrError:  # too little is left of the photos to start from
            return None

    def without_ghosts(self, splats: Splats, views: Sequence[View]) -> Splats:
        """The splats that a fit has ended with, without those that only masked pixels show.

        Args:
            splats: of the fit.
            views: with the cameras that they were fitted to.
        """
        if not any_of(self.found):
            return splats
        keep = self._kept(splats, views, self.found)
        return subset(splats, keep)

    def _kept(self, splats: Splats, views: Sequence[View], found: Sequence[Bool | None]) -> Bool:
        """Which splats other pixels show, too; what only masked ones show nothing would correct."""
        cameras = [view.camera for view in views]
        keep: Bool = ~behind_masks(splats, cameras, found, self.backend)
        keep[len(keep) - self.frozen :] = True
        return keep if keep[: len(keep) - self.frozen].any() else np.ones_like(keep)

    def kept(self) -> dict[str, npt.NDArray[Any]]:
        """What checkpoints keep of it, by name."""
        looked = {} if self.looked < 0 else {LOOKED: np.array([self.looked], np.int64)}
        if not any_of(self.found):
            return looked
        bits = [
            np.zeros((view.camera.height, view.camera.width), np.bool_) if found is None else found
            for view, found in zip(self.views, self.found, strict=True)
        ]
        return {**looked, MASKS: np.packbits(np.concatenate([one.reshape(-1) for one in bits]))}

    def parts(self) -> dict[str, float]:
        """What part of each photo is masked, by name; without those of which nothing is."""
        return {
            view.name: float(found.mean())
            for view, found in zip(self.views, self.found, strict=True)
            if found is not None
        }


def _masked(views: Sequence[View], found: Sequence[Bool | None]) -> list[View]:
    return [with_mask_less(*each) for each in zip(views, found, strict=True)]


def _selected(state: dict[str, Any], keep: Bool) -> dict[str, Any]:
    """A fitter's state with these splats alone."""
    of_splats = {prefix + name for name in PARAMETERS for prefix in ("", "first_", "second_")}
    of_splats |= {"stats_grad_sum", "stats_seen"}
    return {name: array[keep] if name in of_splats else array for name, array in state.items()}


def any_of(found: Sequence[Bool | None]) -> bool:
    """Whether something was found in any view."""
    return any(one is not None for one in found)


def with_mask_less(view: View, found: Bool | None) -> View:
    """The view without the pixels that were found."""
    if found is None:
        return view
    return replace(view, mask=~found if view.mask is None else view.mask & ~found)


def with_train_masks(capture: Capture, found: Sequence[Bool | None]) -> Capture:
    """The capture whose train views' masks leave out what was found, given in their order."""
    if not any_of(found):
        return capture
    each = iter(found)
    views = [
        with_mask_less(view, next(each)) if view.split == "train" else view
        for view in capture.views
    ]
    return Capture(capture.path, views, capture.points)


def resumed_masks(
    views: Sequence[View], state: dict[str, npt.NDArray[Any]]
) -> tuple[list[Bool | None], int]:
    """Take what ``TransientSearch.kept`` gave out of a checkpoint's state.

    Args:
        views: of the fit.
        state: of the checkpoint; the arrays are removed from it.

    Raises:
        ValueError: the arrays cannot be these views'.
    """
    bits, looked = state.pop(MASKS, None), state.pop(LOOKED, np.array([-1], np.int64))
    if looked.dtype != np.int64 or looked.shape != (1,) or looked[0] < -1:
        raise ValueError(f"{LOOKED}: must be a step")
    if bits is None:
        return [None] * len(views), int(looked[0])
    sizes = [view.camera.width * view.camera.height for view in views]
    if bits.dtype != np.uint8 or bits.shape != (-(-sum(sizes) // 8),):
        raise ValueError(f"{MASKS}: must be a bit for each pixel of {len(views)} views")
    each = np.split(np.unpackbits(bits, count=sum(sizes)).astype(np.bool_), np.cumsum(sizes)[:-1])
    shapes = [(view.camera.height, view.camera.width) for view in views]
    masks = [one.reshape(shape) for one, shape in zip(each, shapes, strict=True)]
    return [one if one.any() else None for one in masks], int(looked[0])
