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
