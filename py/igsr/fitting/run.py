"""``fit``: splats from the photos of a capture."""

from __future__ import annotations

import hashlib
import numbers
import os
import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import check_writable
from igsr.capture import Capture, View
from igsr.capture.downscaling import halved
from igsr.capture.photo_checks import check_photos
from igsr.capture.types import Tracks
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import load_checkpoint, save_checkpoint
from igsr.fitting.fitter import (
    camera_rows,
    fitted_cameras,
    fitter_of,
    with_camera_rows,
    with_train_cameras,
)
from igsr.fitting.initialization.initial_splats import STARTS, initial_splats
from igsr.fitting.pose_priors import CameraHolds, camera_holds
from igsr.fitting.presets import preset_settings
from igsr.splats import MAX_SH_DEGREE, Splats

#: A killed run loses at most this much work.
CHECKPOINT_STEPS = 500
CHECKPOINT_SECONDS = 20.0
#: What reports say of a fit that went on from splats that it was given.
GIVEN = "given"
#: Least and most of what is a whole number.
LIMITS = {
    "steps": (1, 10_000_000),
    "seed": (0, 2**63 - 1),
    "sh_degree": (0, MAX_SH_DEGREE),
    "max_splats": (1, 2**27),
}
#: Ways to control the number of splats.
DENSITIES = ("mcmc", "original", "fixed")
#: Whether cameras are fitted with the splats, and which of their focal lengths are.
POSES = ("fixed", "joint")
FOCALS = ("fixed", "shared", "per-camera")
#: Cameras are first looked for in photos of half the size, with this part of the steps and splats;
#: not in photos whose smaller side is then shorter than so many pixels.
ROUGH_STEPS, ROUGH_SPLATS = 0.375, 0.25
ROUGH_SIDE = 64
#: What checkpoints call the cameras that were found so.
ROUGH = "rough_cameras"
#: Most of the splats that a step may leave out.
MAX_DROPOUT = 0.9
#: How long the Rust side runs before Python may look at Ctrl-C and the progress callback.
CHUNK_SECONDS = 0.2


@dataclass(frozen=True)
class Progress:
    """Where a fit stands.

    Attributes:
        step: steps done, of ``steps``.
        steps: steps in all.
        loss: 0.8 L1 + 0.2 D-SSIM of the last step's photo, before that step.
        splats: number of splats now.
        started: what the first splats were made from ("points", "hull" ...) and their number.
        seconds: time spent fitting, earlier runs that were resumed included.
        steps_per_second: of the last chunk of steps.
        backend: what runs: "backend", "device" and "instruction_set".
    """

    step: int
    steps: int
    loss: float
    splats: int
    started: tuple[str, int]
    seconds: float
    steps_per_second: float
    backend: dict[str, str]


def fit(
    capture: Capture,
    steps: int | None = None,
    progress: Callable[[Progress], bool | None] | None = None,
    backend: str = "auto",
    seed: int = 0,
    *,
    preset: str = "default",
    max_splats: int | None = None,
    sh_degree: int | None = None,
    density: str | None = None,
    dropout: float | None = None,
    hull: bool | None = None,
    start: str | Splats | None = None,
    poses: str | None = None,
    focal: str | None = None,
    background: tuple[float, float, float] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> Splats:
    """Fit splats to the train views of ``capture``.

    Where cameras are fitted too, ``fit_with_cameras`` also returns them.

    The same capture, settings and seed give the same splats, bit for bit, on one backend and
    instruction set; a resumed fit ends with the same bits as one that was never interrupted.

    Args:
        capture: photos and cameras; masked pixels do not count. Views with weights are no photos:
            at least five steps are on photos for one on such a view, and the last fifth of all.
        steps: optimiser steps, each on one photo; None, here and below, is what the preset says.
        progress: called about five times a second, with step 0 while cameras are looked for
            roughly; returning False ends the fit early, with the splats as they are then.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu".
        seed: of everything random.
        preset: "default" (other settings for up to 20 photos than for more; views with weights are
            no photos), "3dgs" or "instantsplat"; see ``igsr.fitting.presets``.
        max_splats: most splats there may be.
        sh_degree: degree of the colours' spherical harmonics, 0-4.
        density: how splats are added and removed: "mcmc" (relocation and growth under the cap,
            Kheradmand et al. 2024), "original" (clone, split, prune, Kerbl et al. 2023), "fixed".
        background: RGB in [0, 1] behind the splats and photos with alpha; None is a new random
            colour in every step for photos with alpha and black for photos without.
        dropout: part of the splats that a step leaves out at random, growing from none in the first
            step to this in the last, while the others' opacities are raised to make up for it
            (DropGaussian, Park et al. 2025); 0 to 0.9. Against over-fitting few photos.
        hull: whether splats are removed whose centre a photo with alpha shows empty.
        start: what the first splats are made from: "auto", "points", "hull", "sift", "rays" or
            "random"; see ``igsr.fitting.initialization``. Or splats that a fit to some of the
            photos ended with: rates and dropout then are those of the last ``steps`` of a fit of
            the preset.
        poses: "fixed", or "joint": each camera is turned and moved with the splats. All together
            stay where the given ones were on the whole: the scene keeps its place and size. Where
            the capture has tracks, each camera is held to what these say of it.
        focal: "fixed", "shared" (one factor to all cameras' focal lengths is fitted) or
            "per-camera".
        checkpoint: ``.npz`` file to save to every 500 steps or 20 seconds, at the end, and on
            Ctrl-C (KeyboardInterrupt, which is raised again); where cameras are fitted, from when
            they have been found roughly.
        resume: continue the fit that ``checkpoint`` holds.

    Raises:
        IgsrError: an argument cannot be used, the checkpoint cannot be written or belongs to
            another capture or other settings.
        UserWarning: the photos leave something open (see ``igsr.capture.photo_checks``); the last
            checkpoint cannot be written; the splats are returned all the same.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    splats, _ = _fit(
        capture,
        progress,
        backend,
        seed,
        preset,
        {
            "steps": steps,
            "max_splats": max_splats,
            "sh_degree": sh_degree,
            "density": density,
            "dropout": dropout,
            "hull": hull,
            "start": start,
            "poses": poses,
            "focal": focal,
        },
        background,
        checkpoint,
        resume,
    )
    return splats


def fit_with_cameras(
    capture: Capture,
    steps: int | None = None,
    progress: Callable[[Progress], bool | None] | None = None,
    backend: str = "auto",
    seed: int = 0,
    *,
    preset: str = "default",
    max_splats: int | None = None,
    sh_degree: int | None = None,
    density: str | None = None,
    dropout: float | None = None,
    hull: bool | None = None,
    start: str | Splats | None = None,
    poses: str | None = None,
    focal: str | None = None,
    background: tuple[float, float, float] | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> tuple[Splats, Capture]:
    """As ``fit``, and the capture with its train cameras as they were fitted.

    Raises:
        IgsrError, UserWarning, RuntimeError: as ``fit``.
    """
    return _fit(
        capture,
        progress,
        backend,
        seed,
        preset,
        {
            "steps": steps,
            "max_splats": max_splats,
            "sh_degree": sh_degree,
            "density": density,
            "dropout": dropout,
            "hull": hull,
            "start": start,
            "poses": poses,
            "focal": focal,
        },
        background,
        checkpoint,
        resume,
    )


def _fit(
    capture: Capture,
    progress: Callable[[Progress], bool | None] | None,
    backend: str,
    seed: int,
    preset: str,
    given: dict[str, object],
    background: tuple[float, float, float] | None,
    checkpoint: str | os.PathLike[str] | None,
    resume: bool,
) -> tuple[Splats, Capture]:
    """What ``fit`` and ``fit_with_cameras`` do; warnings point to who called those."""
    views = capture.train_views
    if not views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    warm = given["start"] if isinstance(given["start"], Splats) else None
    if warm is not None:
        given = given | {"start": GIVEN}
        if given["sh_degree"] is None:
            given["sh_degree"] = warm.sh_degree
    photos = len(_photos(views))
    chosen = preset_settings(preset, photos, **given)
    _check_arguments(chosen, seed, background, checkpoint, resume, warm)
    check_photos(views)
    info = check_fits(backend)
    path = None if checkpoint is None else Path(checkpoint)
    settings: dict[str, Any] = {
        "steps": int(chosen["steps"]),
        "seed": int(seed),
        "max_splats": int(chosen["max_splats"]),
        "sh_degree": int(chosen["sh_degree"]),
        "density": chosen["density"],
        "dropout": float(chosen["dropout"]),
        "hull": chosen["hull"],
        "start": chosen["start"],
        "poses": chosen["poses"],
        "focal": chosen["focal"],
        "background": None if background is None else [float(channel) for channel in background],
        "backend": info["backend"],
        "instruction_set": info["instruction_set"],
        "igsr": _core.__version__,
    }
    moving = settings["poses"] != "fixed" or settings["focal"] != "fixed"
    if warm is not None:
        whole = max(settings["steps"], int(preset_settings(preset, photos)["steps"]))
        settings["first_step"] = whole - settings["steps"]
        settings["steps"] = whole
        settings["splats"] = _digest(_arrays(warm).values())
    tracks = capture.points.tracks if moving and capture.points is not None else None
    settings["capture"] = fingerprint(views, tracks)
    # By the cameras as they were given, also where the fit goes on from others.
    holds = None
    if tracks is not None:
        poses = settings["poses"] != "fixed"
        holds = camera_holds(views, capture.points, poses=poses, focal=settings["focal"])

    seconds_before = 0.0
    state: dict[str, Any] | None = None
    if resume and path is not None:
        state, saved = load_checkpoint(path)
        seconds_before = saved["seconds"]
        _check_same_settings(path, saved, settings)
        settings["started"] = saved["started"]
    if path is not None:
        check_writable(path)
    go_on = True
    rough = state is None and moving and warm is None
    if rough:

        def waiting(now: Progress) -> bool:
            # The fit itself has not begun: whoever stops it now stops it before its first step.
            nonlocal go_on
            now = replace(now, step=0, steps=settings["steps"])
            go_on = progress is None or progress(now) is not False
            return go_on

        began = time.perf_counter()
        capture = _with_rough_cameras(capture, settings, info, holds, waiting)
        seconds_before = time.perf_counter() - began
    if state is None:
        state, settings["started"] = _start(capture, settings, warm)
    origin = state.pop("origin", np.zeros(0))
    try:
        views = with_camera_rows(capture.train_views, state.pop(ROUGH, None))
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError("origin: must be three finite numbers")
        fitter = fitter_of(views, origin, state, settings, info["backend"], holds)
    except ValueError as error:
        if resume:
            raise IgsrError(f"The checkpoint {path} cannot be used: {error}.") from error
        raise IgsrError(f"{error}.") from error
    kept = {"origin": origin}
    if moving:
        kept[ROUGH] = camera_rows(views)
    if rough and path is not None:
        # The cameras that took so long to find are kept from here on.
        state = {**fitter.state(), **kept}
        save_checkpoint(path, state, {**settings, "seconds": seconds_before})
    if go_on:
        _run(fitter, kept, settings, info, seconds_before, progress, path)
    splats = Splats(**fitter.splats(), origin=origin, antialiased=False)
    if not moving:
        return splats, capture
    return splats, with_train_cameras(capture, fitted_cameras(views, fitter, origin))


def _photos(views: list[View]) -> list[View]:
    """What the settings and the first splats go by; all views where none is a photo.

    Others show what a fit to the photos made up.
    """
    return [view for view in views if view.weights is None] or views


def _arrays(splats: Splats) -> dict[str, Any]:
    names = ("means", "quats", "scales", "opacities", "sh", "origin")
    return {name: getattr(splats, name) for name in names}


def _start(
    capture: Capture, settings: dict[str, Any], warm: Splats | None = None
) -> tuple[dict[str, Any], list[str | int]]:
    """The splats that a fit with these settings starts from, by name of parameter.

    And what they were made from, with their number.
    """
    if warm is not None:
        return _arrays(warm), [GIVEN, len(warm)]
    splats, made_from = initial_splats(
        replace(capture, views=_photos(capture.train_views)),
        settings["seed"],
        settings["max_splats"],
        settings["sh_degree"],
        settings["start"],
        dense=settings["density"] == "fixed",
        exact_poses=settings["poses"] == "fixed",
    )
    state = {name: value for name, value in vars(splats).items() if name != "antialiased"}
    return state, [made_from, len(splats)]


def _with_rough_cameras(
    capture: Capture,
    settings: dict[str, Any],
    info: dict[str, str],
    holds: CameraHolds | None,
    progress: Callable[[Progress], bool | None] | None,
) -> Capture:
    """The capture with train cameras as a shorter fit to photos of half the size has them.

    Splats that have settled around wrong cameras hold them there: it is better to find the cameras
    roughly and to start again.
    """
    if len(capture.train_views) == 1 and settings["focal"] == "fixed":
        return capture  # a camera alone stays where it is
    views = [halved(view) for view in capture.train_views]
    if min(min(view.camera.width, view.camera.height) for view in views) < ROUGH_SIDE:
        return capture
    small = Capture(capture.path, views, capture.points)
    steps = max(1, round(ROUGH_STEPS * settings["steps"]))
    splats = max(1, round(ROUGH_SPLATS * settings["max_splats"]))
    rough = {**settings, "steps": steps, "max_splats": splats}
    try:
        state, rough["started"] = _start(small, rough)
        origin = state.pop("origin")
        if holds is not None:
            # What is known of turns, moves and logarithms holds for pictures of any size.
            holds = replace(holds, views=views)
        fitter = fitter_of(views, origin, state, rough, info["backend"], holds)
    except (IgsrError, ValueError):
        return capture  # what cannot be started from at half size may be at full size
    _run(fitter, {}, rough, info, 0.0, progress, None)
    found = fitted_cameras(views, fitter, origin)
    cameras = []
    for view, camera in zip(capture.train_views, found, strict=True):
        K = view.camera.K.copy()
        K[[0, 1], [0, 1]] = 2.0 * camera.K[[0, 1], [0, 1]]
        cameras.append(replace(view.camera, viewmat=camera.viewmat, K=K))
    return with_train_cameras(capture, cameras)


def fingerprint(views: list[View], tracks: Tracks | None = None) -> str:
    """SHA-256 over photos, masks, cameras and tracks: a fit may only go on with the same ones."""
    arrays: list[npt.NDArray[Any] | None] = []
    for view in views:
        camera = view.camera
        arrays += [camera.viewmat, camera.K, view.image, view.mask, view.weights]
        arrays.append(None if view.background is None else np.asarray(view.background))
    if tracks is not None:
        arrays += [tracks.view, tracks.point, tracks.xy]
    return _digest(arrays)


def _digest(arrays: Iterable[npt.NDArray[Any] | None]) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        if array is not None:
            digest.update(str((array.dtype.str, array.shape)).encode())
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def check_fits(backend: str) -> dict[str, str]:
    """What a backend is, which must be one that fits.

    Raises:
        IgsrError: there is none of that name, or it does not fit.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if backend == "reference":
        raise IgsrError("backend reference renders but does not fit; use auto, cpu or gpu.")
    try:
        return _core.backend_info(_core.resolve_backend(backend))
    except ValueError as error:
        raise IgsrError(f"{error}.") from error


def check_whole_number(name: str, value: object) -> None:
    """Find a setting of ``LIMITS`` that no fit can have.

    Raises:
        IgsrError: it is no whole number, or out of its range.
    """
    low, high = LIMITS[name]
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise IgsrError(f"{name} must be a whole number, not {value!r}.")
    if not low <= value <= high:
        raise IgsrError(f"{name} must be from {low} to {high}, not {value}.")


def _check_arguments(
    chosen: dict[str, Any],
    seed: object,
    background: object,
    checkpoint: object,
    resume: bool,
    warm: Splats | None,
) -> None:
    check_whole_number("seed", seed)
    for name in ("steps", "sh_degree", "max_splats"):
        check_whole_number(name, chosen[name])
    for name, choices in (
        ("density", DENSITIES),
        ("start", STARTS if warm is None else (GIVEN,)),
        ("poses", POSES),
        ("focal", FOCALS),
    ):
        if chosen[name] not in choices:
            raise IgsrError(f"{name} must be one of {', '.join(choices)}, not {chosen[name]!r}.")
    dropout = chosen["dropout"]
    real = isinstance(dropout, numbers.Real) and not isinstance(dropout, bool)
    if not real or not 0.0 <= dropout <= MAX_DROPOUT:
        raise IgsrError(f"dropout must be a number from 0 to {MAX_DROPOUT}, not {dropout!r}.")
    if not isinstance(chosen["hull"], bool):
        raise IgsrError(f"hull must be True or False, not {chosen['hull']!r}.")
    if background is not None:
        try:
            color = np.asarray(background, dtype=np.float64)
        except (TypeError, ValueError):
            color = np.zeros(0)
        if color.shape != (3,) or not ((color >= 0.0) & (color <= 1.0)).all():
            raise IgsrError(f"background must be three numbers in 0..1, not {background!r}.")
    if warm is not None and warm.sh_degree != chosen["sh_degree"]:
        raise IgsrError(
            f"start has splats of SH degree {warm.sh_degree}; sh_degree must be the same, not "
            f"{chosen['sh_degree']}."
        )
    if warm is not None and not 1 <= len(warm) <= chosen["max_splats"]:
        raise IgsrError(
            f"start has {len(warm)} splats; give at least one, and no more than max_splats, "
            f"{chosen['max_splats']}."
        )
    if warm is not None and warm.antialiased:
        raise IgsrError("start has antialiased splats, which igsr does not fit; give others.")
    if resume and checkpoint is None:
        raise IgsrError("resume needs checkpoint, the file to continue from.")


def _check_same_settings(path: Path, saved: dict[str, Any], settings: dict[str, Any]) -> None:
    for name, value in settings.items():
        if saved.get(name) != value:
            if name == "capture":
                raise IgsrError(
                    f"{path} was made from other photos, masks, cameras, tracks or another split; "
                    "resume with the same or leave --resume out."
                )
            raise IgsrError(
                f"{path} was made with {name} {saved.get(name)!r}, not {value!r}; "
                "resume with the same or leave --resume out."
            )


def _run(
    fitter: _core.Fitter,
    kept: dict[str, npt.NDArray[np.float64]],
    settings: dict[str, Any],
    info: dict[str, str],
    seconds_before: float,
    progress: Callable[[Progress], bool | None] | None,
    path: Path | None,
) -> None:
    """Step in chunks until done or told to stop, saving on the way, with what is ``kept``."""
    steps = settings["steps"]
    started = time.perf_counter()
    step = saved_step = fitter.steps_done
    saved_at = started
    chunk = 1

    def save() -> None:
        if path is not None:
            seconds = seconds_before + time.perf_counter() - started
            state = {**fitter.state(), **kept}
            save_checkpoint(path, state, {**settings, "seconds": seconds})

    try:
        while step < steps:
            chunk_started = time.perf_counter()
            try:
                done = fitter.step(min(chunk, steps - step))
            except ValueError as error:
                raise IgsrError(f"{error}.") from error
            now = time.perf_counter()
            advanced, step = done["step"] - step, done["step"]
            speed = advanced / max(now - chunk_started, 1e-9)
            # A step's time changes with the number of splats: follow it, a factor two at a time.
            chunk = max(1, min(2 * chunk, int(speed * CHUNK_SECONDS)))
            go_on = progress is None or progress(
                Progress(
                    step=step,
                    steps=steps,
                    loss=done["loss"],
                    splats=done["splats"],
                    started=(settings["started"][0], settings["started"][1]),
                    seconds=seconds_before + now - started,
                    steps_per_second=speed,
                    backend=info,
                )
            )
            if go_on is False:
                break
            if step - saved_step >= CHECKPOINT_STEPS or now - saved_at >= CHECKPOINT_SECONDS:
                save()
                saved_step, saved_at = step, time.perf_counter()
        try:
            if step > saved_step:
                save()
        except IgsrError as error:
            # The splats are finished: losing them to a full disk would be the greater harm.
            warnings.warn(str(error), stacklevel=4)
    except KeyboardInterrupt:
        save()
        raise
