"""The optimization of a fit: from its first splats or a checkpoint to its last step."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.event import Event, Listener
from igsr._internal.user_warning import warn_user
from igsr.capture import Camera, Exposure, View
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import CheckpointFile
from igsr.fitting.fitter import (
    camera_rows,
    fitted_cameras,
    fitted_exposures,
    fitter_of,
    initial_state,
    with_camera_rows,
    with_splats_after,
)
from igsr.fitting.inputs import FitInputs
from igsr.fitting.rough_cameras import with_rough_cameras
from igsr.fitting.settings import FitSettings
from igsr.fitting.time_estimate import work_done
from igsr.fitting.transient_masks import (
    Masks,
    any_masked,
    look_for_transients,
    mask_arrays,
    masked_fractions,
    masked_views,
    masks_from_arrays,
    steps_to_look,
    visible_splats,
)
from igsr.splats import PARAMETERS, Splats

#: A checkpoint is saved after this many steps or seconds, whichever comes first.
CHECKPOINT_STEPS = 500
CHECKPOINT_SECONDS = 20.0
#: Time that the renderer runs before Python looks at Ctrl-C and reports progress, seconds.
CHUNK_SECONDS = 0.2
#: Key of the cameras that a joint fit starts with, in checkpoints.
ROUGH_CAMERAS = "rough_cameras"

Arrays: TypeAlias = dict[str, npt.NDArray[Any]]
Origin: TypeAlias = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Trained:
    """The end of a fit's optimization.

    Attributes:
        splats: of the last step, frozen ones included.
        views: of the fit, with the cameras that they started with and without transient masks.
        cameras: of the views, as optimized.
        exposures: of the views; None where they are not optimized.
        masks: pixels of each view that show transient objects.
        started: initialization ("points", "hull" ...) and its number of splats.
        seconds: spent so far, earlier runs included.
        steps: number of steps taken.
        loss: of the last step; NaN if this run took none.
    """

    splats: Splats
    views: list[View]
    cameras: list[Camera]
    exposures: list[Exposure | None]
    masks: Masks
    started: tuple[str, int]
    seconds: float
    steps: int
    loss: float


@dataclass
class _Start:
    """Start of the optimization: the first step, or a checkpoint."""

    state: Arrays
    origin: Origin
    views: list[View]
    masks: Masks
    looked_at: int
    started: tuple[str, int]
    seconds: float


def train(
    inputs: FitInputs,
    file: CheckpointFile | None = None,
    *,
    resume: bool = False,
    report: Listener | None = None,
) -> Trained:
    """Optimize splats, and cameras and exposures if asked for.

    Transient objects are searched for after some of the steps. Where masks change, the fit
    continues with a new fitter; where the first masks are found, it starts over with them.

    Args:
        inputs: of ``prepare``.
        file: the checkpoint to save to every ``CHECKPOINT_STEPS`` steps, at the end, and when
            ``report`` or Ctrl-C ends the fit.
        resume: whether to continue from the checkpoint.
        report: called about five times a second; an exception ends the fit.

    Raises:
        IgsrError: the checkpoint or the photos cannot be used, or a step fails.
        RuntimeError: the GPU failed; the last checkpoint stays.
    """
    started_at = time.perf_counter()
    start = _resumed(inputs, file) if resume and file is not None else None
    if file is not None:
        file.check_writable()
    is_new = start is None
    if start is None:
        start = _new_start(inputs, report, started_at)
    settings, masks, looked_at = inputs.settings, start.masks, start.looked_at
    kept: Arrays = {
        "origin": start.origin,
        "frame": np.append(inputs.frame.origin, inputs.frame.unit),
    }
    if settings.moves_cameras:
        kept[ROUGH_CAMERAS] = camera_rows(start.views)

    def fitter_from(state: Arrays) -> _core.Fitter:
        views = masked_views(start.views, masks)
        values = {
            **settings.plain(),
            "first_step": settings.first_step,
            "frozen_splats": inputs.frozen_count,
        }
        try:
            return fitter_of(
                views, start.origin, state, values, inputs.backend, inputs.priors, inputs.exposures
            )
        except ValueError as error:
            raise IgsrError(f"{error}.") from error

    try:
        fitter = fitter_from(start.state)
    except IgsrError as error:
        if resume and file is not None:
            raise IgsrError(f"The checkpoint {file.path} cannot be used: {error}") from error
        raise

    looks = steps_to_look(settings, start.views)
    loop = _Loop(inputs, start, file, report)
    loop.at(fitter, masks, looked_at, kept)
    if is_new and settings.moves_cameras and inputs.initial is None:
        loop.save()  # finding the rough cameras took long
    try:
        while fitter.steps_done < settings.steps:
            step = int(fitter.steps_done)
            is_off = settings.transients == "auto" and looked_at >= 0 and not any_masked(masks)
            if step in looks and looked_at < step and not is_off:
                new_masks = look_for_transients(
                    fitter, start.views, start.origin, masks, settings, inputs.backend
                )
                state = _after_look(inputs, start, fitter, masks, new_masks, loop)
                masks, looked_at = new_masks, step
                if state is not None:
                    fitter = fitter_from(state)
                loop.at(fitter, masks, looked_at, kept)
            until = min((look for look in looks if look > fitter.steps_done), default=None)
            loop.step(until or settings.steps)
        loop.finish()
    except KeyboardInterrupt:
        loop.save_new()
        raise

    splats = Splats(**fitter.splats(), origin=start.origin, antialiased=False)
    cameras = [view.camera for view in start.views]
    if settings.moves_cameras:
        cameras = fitted_cameras(start.views, fitter, start.origin)
    exposures: list[Exposure | None] = [None] * len(start.views)
    if inputs.exposures is not None:
        exposures = fitted_exposures(start.views, fitter)
    return Trained(
        splats,
        start.views,
        cameras,
        exposures,
        masks,
        loop.started,
        loop.seconds,
        int(fitter.steps_done),
        loop.loss,
    )


def _new_start(inputs: FitInputs, report: Listener | None, started_at: float) -> _Start:
    """The first splats; joint fits first find the cameras roughly."""
    capture, settings = inputs.capture, inputs.settings
    if settings.moves_cameras and inputs.initial is None:

        def take_steps(fitter: _core.Fitter, rough: FitSettings) -> None:
            _rough(inputs, fitter, rough.steps, report)

        capture = with_rough_cameras(inputs, take_steps)
    state, started = initial_state(inputs.with_scene_colors(capture), settings, inputs.initial)
    if inputs.frozen is not None:
        state |= with_splats_after(state, inputs.frozen)
    origin = state.pop("origin")
    views = capture.train_views
    seconds = time.perf_counter() - started_at if settings.moves_cameras else 0.0
    return _Start(state, origin, views, [None] * len(views), -1, started, seconds)


def _rough(inputs: FitInputs, fitter: _core.Fitter, steps: int, report: Listener | None) -> None:
    """Take all steps of a rough fit, which are reported as step 0 of the fit."""
    chunk = 1
    while fitter.steps_done < steps:
        chunk, done, rate = _chunk(fitter, steps, chunk)
        if report is not None:
            size = _mean_size(inputs.views)
            report(fit_event(0, inputs.settings, size, done["loss"], done["splats"], rate))


def _resumed(inputs: FitInputs, file: CheckpointFile) -> _Start:
    """Where the checkpoint was saved.

    Raises:
        IgsrError: the checkpoint cannot be used.
    """
    state, started, seconds = file.load()
    state.pop("frame", None)
    origin = state.pop("origin", np.zeros(0))
    try:
        views = with_camera_rows(inputs.views, state.pop(ROUGH_CAMERAS, None))
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError("origin: must be three finite numbers")
        masks, looked_at = masks_from_arrays(views, state)
    except ValueError as error:
        raise IgsrError(f"The checkpoint {file.path} cannot be used: {error}.") from error
    return _Start(state, origin, views, masks, looked_at, started, seconds)


def _after_look(
    inputs: FitInputs,
    start: _Start,
    fitter: _core.Fitter,
    masks: Masks,
    new_masks: Masks,
    loop: _Loop,
) -> Arrays | None:
    """The state to continue from once masks changed; None if the fitter stays."""
    if not any_masked(new_masks) and not any_masked(masks):
        return None
    views = masked_views(start.views, new_masks)
    may_start_over = not inputs.settings.moves_cameras and inputs.initial is None
    if may_start_over and not any_masked(masks):
        try:
            capture = replace(inputs.capture, views=views)
            state, started = initial_state(inputs.with_scene_colors(capture), inputs.settings)
        except IgsrError:  # too little is left of the photos to initialize from
            pass
        else:
            origin = state.pop("origin")
            state["means"] = state["means"] + (origin - start.origin).astype(np.float32)
            loop.started = started
            return state
    splats = Splats(**fitter.splats(), origin=start.origin, antialiased=False)
    cameras = fitted_cameras(start.views, fitter, start.origin)
    keep = visible_splats(splats, cameras, new_masks, inputs.frozen_count, inputs.backend)
    return _selected(fitter.state(), keep)


def _selected(state: Arrays, keep: npt.NDArray[np.bool_]) -> Arrays:
    """A fitter's state with some of its splats."""
    of_splats = {prefix + name for name in PARAMETERS for prefix in ("", "first_", "second_")}
    of_splats |= {"stats_grad_sum", "stats_seen"}
    return {name: array[keep] if name in of_splats else array for name, array in state.items()}


def _mean_size(views: Sequence[View]) -> tuple[float, float]:
    """Mean width and height of views, pixels."""
    width, height = np.mean([(view.camera.width, view.camera.height) for view in views], axis=0)
    return float(width), float(height)


class _Loop:
    """Steps in chunks, with progress, time and checkpoints."""

    def __init__(
        self,
        inputs: FitInputs,
        start: _Start,
        file: CheckpointFile | None,
        report: Listener | None,
    ) -> None:
        self.inputs, self.file, self.report = inputs, file, report
        self.started, self.loss = start.started, math.nan
        self._seconds_before = start.seconds
        self._began = self._saved_at = time.perf_counter()
        self._chunk = 1
        self._names = [view.name for view in start.views]
        self.size = _mean_size(start.views)
        self._views = start.views
        self._saved_step: int | None = None

    def at(self, fitter: _core.Fitter, masks: Masks, looked_at: int, kept: Arrays) -> None:
        """Continue with this fitter and these masks."""
        self.fitter, self.masks = fitter, masks
        self._kept = {**kept, **mask_arrays(self._views, masks, looked_at)}
        if self._saved_step is None:
            self._saved_step = int(fitter.steps_done)

    @property
    def seconds(self) -> float:
        """Time spent on the fit, earlier runs included."""
        return self._seconds_before + time.perf_counter() - self._began

    def step(self, until: int) -> None:
        """Take a chunk of steps, up to step ``until``, report it and save if that is due."""
        try:
            self._chunk, done, rate = _chunk(self.fitter, until, self._chunk)
        except RuntimeError as error:
            raise RuntimeError(f"{error}{self._kept_words()}") from error
        self.loss = done["loss"]
        if self.report is not None:
            event = fit_event(
                done["step"],
                self.inputs.settings,
                self.size,
                done["loss"],
                done["splats"],
                rate,
                masked=len(masked_fractions(self._names, self.masks)),
            )
            try:
                self.report(event)
            except BaseException:
                self.save()
                raise
        step, saved = int(self.fitter.steps_done), self._saved_step or 0
        is_late = time.perf_counter() - self._saved_at >= CHECKPOINT_SECONDS
        # A fit that started over has fewer steps than its checkpoint.
        if not 0 <= step - saved < CHECKPOINT_STEPS or is_late:
            self.save()

    def save(self) -> None:
        """Save a checkpoint, if there is a file for it.

        Raises:
            IgsrError: it cannot be written.
        """
        if self.file is not None:
            self.file.save({**self.fitter.state(), **self._kept}, self.started, self.seconds)
        self._saved_step, self._saved_at = int(self.fitter.steps_done), time.perf_counter()

    def save_new(self) -> None:
        """Save a checkpoint if steps were taken since the last one, or the fit started over."""
        if int(self.fitter.steps_done) != self._saved_step:
            self.save()

    def finish(self) -> None:
        """Save the last checkpoint; a failure only warns, since the splats are finished."""
        try:
            self.save_new()
        except IgsrError as error:
            warn_user(str(error))

    def _kept_words(self) -> str:
        if self.file is None or not self.file.path.is_file():
            return ""
        return f"; {self.file.path} has step {self._saved_step}, and resume continues from there"


def _chunk(fitter: _core.Fitter, until: int, count: int) -> tuple[int, dict[str, Any], float]:
    """Take steps; return the next chunk's size, the renderer's report and steps per second.

    The time of a step follows the number of splats, so chunks grow by at most a factor of two.
    """
    before, began = int(fitter.steps_done), time.perf_counter()
    try:
        done: dict[str, Any] = fitter.step(min(count, until - before))
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    rate = (done["step"] - before) / max(time.perf_counter() - began, 1e-9)
    return max(1, min(2 * count, int(rate * CHUNK_SECONDS))), done, rate


def fit_event(
    step: int,
    settings: FitSettings,
    size: tuple[float, float],
    loss: float,
    splats: int,
    rate: float,
    masked: int = 0,
) -> Event:
    """The progress of a fit.

    Args:
        step: steps done.
        settings: of the fit.
        size: mean width and height of the photos, pixels.
        loss: of the last step: 0.8 L1 + 0.2 D-SSIM.
        splats: number of splats.
        rate: steps per second.
        masked: number of photos with transient objects.
    """
    parts = [f"loss {loss:.4f}", f"{splats} splats", f"{rate:.0f} steps/s"]
    if masked:
        parts.append(f"{masked} photos masked")
    values: Mapping[str, float] = {"loss": loss, "splats": splats, "steps_per_second": rate}
    part = work_done(settings, *size, step)
    return Event("fit", step, settings.steps, "  ".join(parts), part, values=values)
