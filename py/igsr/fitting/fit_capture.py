"""``fit``: splats from the photos of a capture, from the check of what was asked to the result."""

from __future__ import annotations

import inspect
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from igsr import _core
from igsr._internal.choices import Backend, FitBackend
from igsr._internal.progress_bar import progress_or_bar
from igsr.capture import Capture, View
from igsr.capture.photo_checks import check_photos
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import CheckpointFile, recorded_settings
from igsr.fitting.depth_agreement import with_agreeing_depths
from igsr.fitting.depth_scales import with_scaled_depths
from igsr.fitting.exposures import StartingExposures, starting_exposures
from igsr.fitting.fingerprint import fingerprint, hash_of
from igsr.fitting.fitter import (
    camera_rows,
    check_fits,
    first_splats,
    fitted_cameras,
    fitted_exposures,
    fitter_of,
    initial_state,
    photos_among,
    splat_arrays,
    with_camera_rows,
    with_splats_after,
    with_train_cameras,
    with_train_exposures,
    without_exposures,
)
from igsr.fitting.photo_support import PhotoSupport, support_of
from igsr.fitting.pose_priors import pose_priors
from igsr.fitting.presets import Preset, Quality, settings_for
from igsr.fitting.rough_cameras import with_rough_cameras
from igsr.fitting.run import FitRun, Progress, Report, bar_state
from igsr.fitting.settings import (
    Density,
    ExposureMode,
    FitSettings,
    Focal,
    Initialization,
    Poses,
    TransientMode,
    check_whole_number,
)
from igsr.fitting.transient_search import TransientSearch, resumed_masks, with_train_masks
from igsr.floaters import remove_floaters as without_floaters
from igsr.rendering.backdrop import wants_backdrop, with_backdrop
from igsr.splats import Splats

__all__ = [
    "Progress",
    "check_fits",
    "check_whole_number",
    "fingerprint",
    "fit",
    "fit_with_cameras",
]

#: What checkpoints call the cameras that a joint fit begins with.
ROUGH = "rough_cameras"

P = ParamSpec("P")
T = TypeVar("T")


def fit(
    capture: Capture,
    steps: int | None = None,
    progress: Callable[[Progress], bool | None] | None = None,
    backend: FitBackend = "auto",
    seed: int = 0,
    *,
    preset: Preset = "default",
    quality: Quality = "normal",
    max_splats: int | None = None,
    sh_degree: int | None = None,
    density: Density | None = None,
    learning_rate: float | None = None,
    dropout: float | None = None,
    coarse_to_fine: bool | None = None,
    depth_weight: float | None = None,
    start: Initialization | Splats | None = None,
    poses: Poses | None = None,
    focal: Focal | None = None,
    exposure: ExposureMode | None = None,
    transients: TransientMode | None = None,
    remove_floaters: bool | None = None,
    backdrop: bool | None = None,
    background: tuple[float, float, float] | None = None,
    frozen: Splats | None = None,
    whole_schedule: bool = False,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> Splats:
    """Fit splats to the train views of ``capture``.

    Where cameras are optimized too, ``fit_with_cameras`` also returns them.

    A fit is deterministic: the same capture, settings and seed give the same splats, bit for bit,
    on one backend and instruction set. A resumed fit ends with the same bits as one that was never
    interrupted.

    Args:
        capture: photos and cameras; masked pixels do not count. Pseudo-views (views with weights)
            are sampled less often: at least five steps are on photos for one on a pseudo-view, and
            so are the last fifth of all steps.
        steps: optimizer steps, each on one photo; None, here and below, is the preset's value.
        progress: called about five times a second, with step 0 while cameras are found roughly.
            Returning False ends the fit early, with the splats as they are then. In an interactive
            session, None shows a progress bar.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu".
        seed: of everything random.
        preset: "default" (by how many photos see the same place, from how far apart; pseudo-views
            do not count), "3dgs" or "instantsplat"; see ``igsr.fitting.presets``.
        quality: "draft", "normal" or "high": fewer or more steps and splats of the default preset.
        max_splats: most splats there may be.
        sh_degree: degree of the spherical harmonics of colors, 0-4.
        density: how splats are added and removed: "mcmc" (relocation and growth up to the maximum,
            Kheradmand et al. 2024), "original" (clone, split, prune, Kerbl et al. 2023), "fixed".
        learning_rate: what the first half of the steps multiplies the learning rates of 3DGS by; it
            falls to 1 in the second half. The default preset's is the square root of 30 000, the
            steps that those rates are for, over ``steps``, from 1 to 3, and 1 where cameras are
            optimized.
        dropout: fraction of the splats that a step leaves out at random, growing from 0 in the
            first step to this in the last, while the others' opacities are raised to make up for it
            (DropGaussian, Park et al. 2025); 0 to 0.9. Against overfitting few photos.
        coarse_to_fine: whether the first steps are on photos of an eighth to half of their size,
            which costs less and loses nothing (Chen et al., "DashGaussian", 2025); the last seven
            tenths of the steps have their whole size.
        depth_weight: what the relative difference to the depths that photos came with
            (``View.depth``, of a depth camera or a network) counts in the first step, beside the
            difference to the photos; each step it falls by the same factor, to a hundredth. They
            are brought to the unit of the capture's points where tracks say how far these are. 0:
            such depths are not used at all. Else fits start from them, too.
        start: the initialization: "auto", "points", "depths", "hull", "sift", "rays", "random" or
            "sfm"; see ``igsr.fitting.initialization``. Or splats that a fit to some of the photos
            ended with: learning rates and dropout then are those of the last ``steps`` of a fit of
            the preset.
        poses: "fixed", or "joint": each camera is rotated and moved with the splats. On average
            they stay where the given ones were: the scene keeps its place and size. Where the
            capture has tracks, these give each camera a pose prior.
        focal: "fixed", "shared" (one factor for all cameras' focal lengths is optimized) or
            "per-camera".
        exposure: "on": a gain and an offset per channel of each photo are optimized with the
            splats, which get the colors of the mean photo; "off"; or "auto": on where points that
            photos share, or EXIF, show that exposures differ (``igsr.fitting.exposures``).
        transients: "on": what one photo shows and the others do not, such as people, is masked
            after some of the steps (``igsr.transients``); "off"; or "auto": on where such things
            are large and plain to see, else the fit has the same bits as with "off".
        remove_floaters: whether splats that photos do not support are removed after the last step
            (``igsr.remove_floaters``); the last progress counts them. The checkpoint keeps them.
        backdrop: whether 200 splats are put behind the others in the end, on a sphere round the
            scene, with the colors of the photos in their direction (``igsr.rendering.backdrop``):
            what no photo shows is else the background, black. They come on top of ``max_splats``.
            Not for photos with alpha or masks that cut an object out, fits of fewer than 5 000
            splats, or beside ``frozen`` splats. The checkpoint has none.
        background: RGB in [0, 1] behind splats and photos with alpha; None is a new random color in
            every step for photos with alpha and black for photos without.
        frozen: splats that renders show beside those that are fitted, and that stay as they are:
            what is round a part of a scene whose other parts are known. They need ``start`` with
            splats of the same origin and SH degree, and do not count to ``max_splats``.
        whole_schedule: where ``start`` has splats, whether the fit takes the rates and the density
            control of all steps of a fit, as from points, and not those of its last ones.
        checkpoint: ``.npz`` file to save to every 500 steps or 20 seconds, at the end, and on
            Ctrl-C (KeyboardInterrupt, which is raised again); where cameras are optimized, from
            when they have been found roughly.
        resume: continue the fit that ``checkpoint`` holds.

    Raises:
        IgsrError: an argument cannot be used, the checkpoint cannot be written or belongs to
            another capture or other settings.
        UserWarning: the photos leave something open (see ``igsr.capture.photo_checks``); the last
            checkpoint cannot be written; the splats are returned all the same.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    splats, _ = _fitted(**locals())  # the arguments, each by its name
    return splats


def _with_arguments_of(
    model: Callable[P, Any],
) -> Callable[[Callable[..., T]], Callable[P, T]]:
    """A decorator: the function's arguments are ``model``'s, for help texts and type checkers."""

    def decorate(function: Callable[..., T]) -> Callable[P, T]:
        result = function.__annotations__["return"]
        signature = inspect.signature(model).replace(return_annotation=result)
        function.__signature__ = signature  # type: ignore[attr-defined]
        return function

    return decorate


@_with_arguments_of(fit)
def fit_with_cameras(*args: Any, **kwargs: Any) -> tuple[Splats, Capture]:
    """As ``fit``, with the same arguments; also returns cameras and exposures.

    Returns:
        The splats, without those that were frozen, and the capture with its train cameras and the
        exposures of its train views (``View.exposure``) as they were optimized, and with masks that
        leave out transient things; the capture itself where there are none of these.

    Raises:
        IgsrError, UserWarning, RuntimeError: as ``fit``.
    """
    given = inspect.signature(fit).bind(*args, **kwargs)
    given.apply_defaults()
    return _fitted(**given.arguments)


def _fitted(
    capture: Capture,
    preset: str,
    quality: Quality,
    start: str | Splats | None,
    backend: str,
    progress: Report | None,
    frozen: Splats | None,
    whole_schedule: bool,
    checkpoint: str | os.PathLike[str] | None,
    resume: bool,
    **given: Any,
) -> tuple[Splats, Capture]:
    """What ``fit`` and ``fit_with_cameras`` do; ``given`` are fields of ``FitSettings``."""
    # Check what was asked for, before any work. Warnings point to the caller of our caller.
    _check_capture(capture)
    views = capture.train_views
    if not views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    initial = start.without_backdrop() if isinstance(start, Splats) else None
    if initial is None:
        settings = settings_for(
            preset, support_of(photos_among(views)), quality, start=start, **given
        )
    else:
        settings = _settings_from_splats(
            preset, support_of(photos_among(views)), quality, initial, given, whole_schedule
        )
    if frozen is not None:
        _check_frozen(frozen, initial)
    still = 0 if frozen is None else len(frozen)
    if resume and checkpoint is None:
        raise IgsrError("resume needs checkpoint, the file to continue from.")
    check_photos(views)
    if settings.depth_weight > 0.0 and any(view.depth is not None for view in views):
        scaled = with_scaled_depths(capture.views, capture.points)
        capture = replace(capture, views=with_agreeing_depths(scaled))
        views = capture.train_views
    _check_focal(views, settings)
    device = check_fits(backend)
    exposures = starting_exposures(views, capture.points, settings.exposure)
    tracks = None
    if settings.moves_cameras and capture.points is not None:
        tracks = capture.points.tracks
    priors = None
    if settings.moves_cameras:
        # By the cameras as they were given, also where the fit goes on from others.
        poses = settings.poses != "fixed"
        priors = pose_priors(views, capture.points, poses=poses, focal=settings.focal)
    file = None
    if checkpoint is not None:
        given_splats = [one for one in (initial, frozen) if one is not None]
        arrays = [array for one in given_splats for array in splat_arrays(one).values()]
        splats_hash = hash_of(arrays) if arrays else None
        # What "auto" came to.
        decided = replace(settings, exposure="off" if exposures is None else "on")
        if all(view.depth is None for view in views):
            decided = replace(decided, depth_weight=0.0)
        recorded = recorded_settings(decided, device, fingerprint(views, tracks), splats_hash)
        file = CheckpointFile(Path(checkpoint), recorded)

    with progress_or_bar(progress, "fit", bar_state) as report:
        # Go on from the checkpoint, or initialize the splats; joint fits find the cameras first.
        seconds, rough, stopped = 0.0, False, False
        if resume and file is not None:
            state, started, seconds = file.load()
        if file is not None:
            file.check_writable()
        if not resume:
            if settings.moves_cameras and initial is None:
                rough, began = True, time.perf_counter()
                capture, stopped = with_rough_cameras(
                    capture, settings, device, priors, report, exposures
                )
                seconds = time.perf_counter() - began
            state, started = initial_state(_seen_alike(capture, exposures), settings, initial)
            if frozen is not None:
                state |= with_splats_after(state, frozen)

        # Make the fitter of views, splats and settings.
        origin = state.pop("origin", np.zeros(0))
        try:
            views = with_camera_rows(capture.train_views, state.pop(ROUGH, None))
            if origin.shape != (3,) or not np.isfinite(origin).all():
                raise ValueError("origin: must be three finite numbers")
            values = {**settings.plain(), "first_step": settings.first_step, "frozen_splats": still}
            masks, looked = resumed_masks(views, state)

            def make(views: Sequence[View], state: dict[str, Any]) -> _core.Fitter:
                backend = device["backend"]
                return fitter_of(views, origin, state, values, backend, priors, exposures)

            def beginning(views: Sequence[View]) -> tuple[dict[str, Any], tuple[str, int]]:
                masked = _seen_alike(replace(capture, views=list(views)), exposures)
                state, begun = initial_state(masked, settings)
                state["means"] = state["means"] + (state.pop("origin") - origin).astype(np.float32)
                return state, begun

            name = cast(Backend, device["backend"])
            again = None if settings.moves_cameras or initial is not None else beginning
            search = TransientSearch(
                views, settings, origin, name, make, masks, looked, still, again
            )
            fitter = make(search.masked_views(), state)
        except ValueError as error:
            if resume:
                raise IgsrError(f"The checkpoint {checkpoint} cannot be used: {error}.") from error
            raise IgsrError(f"{error}.") from error

        # Take the steps, with checkpoints.
        kept = {"origin": origin}
        if settings.moves_cameras:
            kept[ROUGH] = camera_rows(views)
        size = np.mean([(view.camera.width, view.camera.height) for view in views], axis=0)
        run = FitRun(
            fitter,
            settings,
            started,
            device,
            report,
            file,
            size=(float(size[0]), float(size[1])),
            kept=kept,
            seconds_before=seconds,
            transients=search,
        )
        if rough:
            run.save()  # the cameras that took so long to find are kept from here on
        if not stopped:
            run.optimize()

        # Take over masks, cameras and exposures, and leave out floaters.
        fitter = run.fitter
        capture = with_train_masks(capture, search.found)
        splats = Splats(**fitter.splats(), origin=origin, antialiased=False)
        if settings.moves_cameras:
            capture = with_train_cameras(capture, fitted_cameras(views, fitter, origin))
        if run.is_done:
            splats = search.without_ghosts(splats, capture.train_views)
        # Without a fit of them, exposures that views have of an earlier one are not these splats'.
        none = [None] * len(views)
        found = none if exposures is None else fitted_exposures(views, fitter)
        removed: dict[str, int] = {}
        if settings.remove_floaters and not stopped and run.is_done:
            cleaned = without_floaters(
                splats,
                replace(capture, views=without_exposures(capture.train_views, found)),
                background=settings.background,
                seed=settings.seed,
                backend=device["backend"],
                frozen=still,
            )
            splats, removed = cleaned.splats, cleaned.removed
        splats = first_splats(splats, len(splats) - still)
        wanted = settings.backdrop and frozen is None and not stopped and run.is_done
        if wanted and wants_backdrop(views, settings.background):
            photos = photos_among(without_exposures(capture.train_views, found))
            splats = with_backdrop(splats, photos, name)
        if not stopped:
            run.end(len(splats), removed)
    return splats, with_train_exposures(capture, found)


def _seen_alike(capture: Capture, start: StartingExposures | None) -> Capture:
    """The capture's train views with the scene's colors, as far as they are known before the fit.

    Initialization compares colors of photos.
    """
    if start is None:
        return capture
    return replace(capture, views=without_exposures(capture.train_views, start.exposures))


def _check_capture(capture: object) -> None:
    if not isinstance(capture, Capture):
        raise IgsrError(
            f"capture must be a Capture, not {type(capture).__name__}; igsr.load_capture(path) "
            "makes one."
        )


def _check_frozen(frozen: Splats, initial: Splats | None) -> None:
    if initial is None:
        raise IgsrError("frozen needs start, the splats that are fitted beside the frozen ones.")
    if frozen.antialiased:
        raise IgsrError("frozen has antialiased splats, which igsr does not fit; give others.")
    if frozen.sh_degree != initial.sh_degree:
        raise IgsrError(
            f"frozen has splats of SH degree {frozen.sh_degree} where start has degree "
            f"{initial.sh_degree}; give the same."
        )
    if not np.array_equal(frozen.origin, initial.origin):
        raise IgsrError("frozen and start have other origins; give splats of one scene.")


def _check_focal(views: list[View], settings: FitSettings) -> None:
    rigged = next((view for view in views if view.rig is not None), None)
    if rigged is not None and settings.focal != "fixed":
        raise IgsrError(
            f"{rigged.name} is a view of a panorama or wide fisheye photo, whose focal lengths "
            'follow from its size; leave focal "fixed".'
        )


def _settings_from_splats(
    preset: str,
    photos: PhotoSupport,
    quality: Quality,
    splats: Splats,
    given: dict[str, Any],
    whole_schedule: bool,
) -> FitSettings:
    """The settings of a fit that goes on from splats: the last steps of the preset's schedule.

    With ``whole_schedule``, all of them.

    Raises:
        IgsrError: the splats and the settings do not go together.
    """
    if given["sh_degree"] is None:
        given = given | {"sh_degree": splats.sh_degree}
    settings = settings_for(preset, photos, quality, **given)
    if splats.sh_degree != settings.sh_degree:
        raise IgsrError(
            f"start has splats of SH degree {splats.sh_degree}; sh_degree must be the same, not "
            f"{settings.sh_degree}."
        )
    if not 1 <= len(splats) <= settings.max_splats:
        raise IgsrError(
            f"start has {len(splats)} splats; give at least one, and no more than max_splats, "
            f"{settings.max_splats}."
        )
    if splats.antialiased:
        raise IgsrError("start has antialiased splats, which igsr does not fit; give others.")
    if whole_schedule:
        return settings
    usual = settings_for(preset, photos, quality, **(given | {"steps": None}))
    whole = max(settings.steps, usual.steps)
    schedule = settings_for(preset, photos, quality, **(given | {"steps": whole}))
    return replace(schedule, first_step=whole - settings.steps)
