"""``fit``: splats from the photos of a capture."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import _core
from .capture import Capture, View
from .checkpoint import State, load_checkpoint, save_checkpoint
from .errors import IgsrError
from .initialization import initial_splats
from .rendering import intrinsics_of, viewmat_about
from .splats import MAX_SH_DEGREE, Splats

#: A killed run loses at most this much work.
CHECKPOINT_STEPS = 500
CHECKPOINT_SECONDS = 20.0
#: How long the Rust side runs before Python may look at Ctrl-C and the progress callback.
CHUNK_SECONDS = 0.2


@dataclass(frozen=True)
class Progress:
    """Where a fit stands.

    Attributes:
        step: steps done, of ``steps``.
        steps: steps in all.
        loss: 0.8 L1 + 0.2 D-SSIM, averaged over the last chunk of steps.
        splats: number of splats now.
        seconds: time spent fitting, earlier runs that were resumed included.
        steps_per_second: of the last chunk of steps.
        backend: what runs: "backend", "device" and "instruction_set".
    """

    step: int
    steps: int
    loss: float
    splats: int
    seconds: float
    steps_per_second: float
    backend: dict[str, str]


def fit(
    capture: Capture,
    steps: int = 5000,
    progress: Callable[[Progress], bool | None] | None = None,
    backend: str = "auto",
    seed: int = 0,
    *,
    max_splats: int | None = None,
    sh_degree: int = 3,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    checkpoint: str | os.PathLike[str] | None = None,
    resume: bool = False,
) -> Splats:
    """Fit splats to the train views of ``capture``.

    The same capture, settings and seed give the same splats, bit for bit, on one backend and
    instruction set; a resumed fit ends with the same bits as one that was never interrupted.

    Args:
        capture: photos and cameras; masked pixels do not count, photos with alpha are fitted over
            a random background that changes with every step.
        steps: optimiser steps, each on one photo.
        progress: called about five times a second; returning False ends the fit early, with the
            splats as they are then.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu", "gpu".
        seed: of everything random.
        max_splats: most splats there may be; None takes the fitter's default.
        sh_degree: degree of the colours' spherical harmonics, 0-4.
        background: RGB in [0, 1] behind photos without alpha.
        checkpoint: ``.npz`` file to save to every 500 steps or 20 seconds, at the end, and on
            Ctrl-C (KeyboardInterrupt, which is raised again).
        resume: continue the fit that ``checkpoint`` holds.

    Raises:
        IgsrError: an argument cannot be used, the checkpoint cannot be written or belongs to
            another capture or other settings.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    _check_arguments(steps, seed, max_splats, sh_degree, checkpoint, resume)
    views = capture.train_views
    if not views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    for view in views:
        if view.mask is not None and not view.mask.any():
            raise IgsrError(f"{view.name}: its mask leaves no pixel to fit; leave the photo out.")
    info = _core.backend_info(_core.resolve_backend(backend))
    path = None if checkpoint is None else Path(checkpoint)
    settings: dict[str, Any] = {
        "steps": int(steps),
        "seed": int(seed),
        "max_splats": max_splats,
        "sh_degree": sh_degree,
        "background": [float(channel) for channel in background],
        "backend": info["backend"],
        "instruction_set": info["instruction_set"],
        "igsr": _core.__version__,
        "capture": fingerprint(views),
    }

    seconds_before = 0.0
    if resume and path is not None:
        state, saved = load_checkpoint(path)
        seconds_before = float(saved.pop("seconds", 0.0))
        _check_same_settings(path, saved, settings)
        fitter = _restored(views, settings, state, path)
    else:
        fitter = _started(capture, views, settings)
    return _run(fitter, settings, info, seconds_before, progress, path)


def fingerprint(views: list[View]) -> str:
    """SHA-256 over the photos, masks and cameras: a fit may only go on with the same ones."""
    digest = hashlib.sha256()
    for view in views:
        camera = view.camera
        for array in (camera.viewmat, camera.K, view.image, view.mask):
            if array is not None:
                digest.update(str((array.dtype.str, array.shape)).encode())
                digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _check_arguments(
    steps: object,
    seed: object,
    max_splats: object,
    sh_degree: object,
    checkpoint: object,
    resume: bool,
) -> None:
    limits: list[tuple[str, object, int, int]] = [
        ("steps", steps, 1, 10_000_000),
        ("seed", seed, 0, 2**63 - 1),
        ("sh_degree", sh_degree, 0, MAX_SH_DEGREE),
    ]
    if max_splats is not None:
        limits.append(("max_splats", max_splats, 1, 100_000_000))
    for name, value, low, high in limits:
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
            raise IgsrError(f"{name} must be a whole number, not {value!r}.")
        if not low <= value <= high:
            raise IgsrError(f"{name} must be from {low} to {high}, not {value}.")
    if resume and checkpoint is None:
        raise IgsrError("resume needs checkpoint, the file to continue from.")


def _check_same_settings(path: Path, saved: dict[str, Any], settings: dict[str, Any]) -> None:
    for name, value in settings.items():
        if saved.get(name) != value:
            if name == "capture":
                raise IgsrError(
                    f"{path} was made from other photos, masks, cameras or another split; "
                    "resume with the same or leave --resume out."
                )
            raise IgsrError(
                f"{path} was made with {name} {saved.get(name)!r}, not {value!r}; "
                "resume with the same or leave --resume out."
            )


def _fitter_views(views: list[View]) -> dict[str, Any]:
    """The train views as the Rust side takes them."""
    return {
        "images": [np.ascontiguousarray(view.image) for view in views],
        "masks": [None if view.mask is None else np.ascontiguousarray(view.mask) for view in views],
        "intrinsics": np.stack([intrinsics_of(view.camera.K) for view in views]),
    }


def _run(
    fitter: _core.Fitter,
    settings: dict[str, Any],
    info: dict[str, str],
    seconds_before: float,
    progress: Callable[[Progress], bool | None] | None,
    path: Path | None,
) -> Splats:
    """Step in chunks until done or told to stop, saving on the way."""
    steps = settings["steps"]
    started = time.perf_counter()
    step = saved_step = fitter.step_count
    saved_at = started
    chunk = 1

    def save() -> None:
        if path is not None:
            seconds = seconds_before + time.perf_counter() - started
            save_checkpoint(path, fitter.state(), {**settings, "seconds": seconds})

    try:
        while step < steps:
            chunk_started = time.perf_counter()
            done = fitter.step(min(chunk, steps - step))
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
    except KeyboardInterrupt:
        save()
        raise
    save()
    return Splats(**fitter.splats())
