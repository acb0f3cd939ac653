"""The smallest model within a loss: prune, refine, judge, and choose the next size by that."""

from __future__ import annotations

import math
import numbers
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .. import _core
from ..capture import Capture
from ..errors import IgsrError
from ..splats import Splats
from .contribution import contribution
from .refinement import refined
from .yardstick import Yardstick, own_yardstick, photo_yardstick

#: What the first sizes have of the one before, until one of them loses too much.
SHRINK = 0.5
#: The search ends when the largest size that lost too much is nearer than this to the result.
NEAR = 1.2
DEFAULT_STEPS = 3000


@dataclass(frozen=True)
class CompactProgress:
    """Where a compaction stands.

    Attributes:
        trial: number of the size that is tried now, from 1.
        splats: that size.
        sh_degree: its SH degree.
        step: refinement steps done, of ``steps``.
        steps: refinement steps of each size.
    """

    trial: int
    splats: int
    sh_degree: int
    step: int
    steps: int


@dataclass(frozen=True)
class Compaction:
    """The smallest model found, and what else was tried.

    Attributes:
        splats: the model.
        report: "max_loss", "whole" and "result" (rows of "curve"), "curve" (a row per size tried,
            the whole model first: "splats", "sh_degree", "bytes", "loss", "psnr", "ssim",
            "seconds"), "protocol", "steps", "seed", "backend", "device", "instruction_set",
            "version". Losses and PSNR in dB.
    """

    splats: Splats
    report: dict[str, Any]


def compact(
    splats: Splats,
    max_loss: float = 0.1,
    capture: Capture | None = None,
    *,
    psnr: float | None = None,
    steps: int = DEFAULT_STEPS,
    seed: int = 0,
    background: Sequence[float] | None = None,
    backend: str = "auto",
    progress: Callable[[CompactProgress], None] | None = None,
) -> Compaction:
    """The smallest model whose pictures are as good as those of ``splats``, but for ``max_loss``.

    Sizes are halved until one loses too much, then the sizes between are tried. Each is made from
    the smallest good one: splats that contribute least (``igsr.compaction.contribution``) are
    removed and the others refined. At the size found, lower SH degrees are tried in the same way.
    The same arguments give the same bits on one backend and instruction set.

    Args:
        splats: the whole model; splats that are not finite, which are never drawn, do not count.
        max_loss: dB of PSNR that may be lost, above 0. With a capture the loss is the whole
            model's PSNR less the smaller one's, on photos that judge and are not refined to: the
            test views, or every eighth train view where there are none. Without a capture it is
            10 log10(1 + MSE of the change / MSE of the model), on pictures of the model from
            cameras around it.
        capture: the photos that the model was fitted to.
        psnr: without a capture, what the model's own PSNR is taken to be, dB; 30 if None.
        steps: refinement steps of each size.
        seed: of everything random.
        background: RGB in [0, 1] behind judged pictures; None is white where photos have alpha,
            black where they have none, grey without a capture.
        backend: "auto" (a real GPU if one answers, else "cpu"), "cpu" or "gpu".
        progress: called every few refinement steps.

    Raises:
        IgsrError: an argument cannot be used; the message names it.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    _check_arguments(max_loss, capture, psnr, steps, seed, background)
    if backend == "reference":
        raise IgsrError("backend reference renders but does not fit; use auto, cpu or gpu.")
    try:
        info = _core.backend_info(_core.resolve_backend(backend))
    except ValueError as error:
        raise IgsrError(f"{error}.") from error
    name = info["backend"]
    whole = _chosen(splats, np.flatnonzero(splats.finite))
    if len(whole) == 0:
        raise IgsrError("The scene has no finite splats to make fewer.")
    if capture is None:
        yardstick = own_yardstick(whole, background, psnr, name)
    else:
        yardstick = photo_yardstick(whole, capture, background, name)
    search = _Search(yardstick, max_loss, steps, seed, name, progress)
    best, row = search.run(whole)
    return Compaction(
        best,
        {
            "max_loss": float(max_loss),
            "whole": search.curve[0],
            "result": row,
            "curve": search.curve,
            "protocol": yardstick.protocol,
            "steps": int(steps),
            "seed": int(seed),
            **info,
            "version": _core.__version__,
        },
    )


class _Search:
    """The sizes tried so far and what is the same for all of them."""

    def __init__(
        self,
        yardstick: Yardstick,
        max_loss: float,
        steps: int,
        seed: int,
        backend: str,
        progress: Callable[[CompactProgress], None] | None,
    ) -> None:
        self.yardstick = yardstick
        self.max_loss = max_loss
        self.steps = steps
        self.seed = seed
        self.backend = backend
        self.progress = progress
        self.curve: list[dict[str, Any]] = []

    def run(self, whole: Splats) -> tuple[Splats, dict[str, Any]]:
        """The smallest model within the loss and its row of the curve."""
        best, row = whole, self._judged(whole, time.perf_counter())
        too_few = 0
        while True:
            if too_few == 0:
                count = math.ceil(SHRINK * len(best))
            else:
                count = round(math.sqrt(len(best) * too_few))
            if count >= len(best) or count <= too_few or len(best) < NEAR * too_few:
                break
            tried, tried_row = self._tried(best, count, best.sh_degree)
            if tried_row["loss"] <= self.max_loss:
                best, row = tried, tried_row
            else:
                too_few = count
        for degree in reversed(range(best.sh_degree)):
            tried, tried_row = self._tried(best, len(best), degree)
            if tried_row["loss"] > self.max_loss:
                break
            best, row = tried, tried_row
        return best, row

    def _tried(self, model: Splats, count: int, degree: int) -> tuple[Splats, dict[str, Any]]:
        """``model`` with ``count`` splats of SH degree ``degree``, refined, and its row."""
        started = time.perf_counter()
        trial = len(self.curve)

        def on_steps(step: int) -> None:
            if self.progress is not None:
                self.progress(CompactProgress(trial, count, degree, step, self.steps))

        on_steps(0)
        if count < len(model):
            cameras = [view.camera for view in self.yardstick.refine_views]
            importance = contribution(model, cameras, self.seed, self.backend).importance
            # Stable: equal importance must not depend on the sorting of one machine.
            most = np.argsort(-importance, kind="stable")[:count]
            model = _chosen(model, np.sort(most))
        model = Splats(
            model.means,
            model.quats,
            model.scales,
            model.opacities,
            np.ascontiguousarray(model.sh[:, : (degree + 1) ** 2]),
            model.origin,
        )
        model = refined(
            model, self.yardstick.refine_views, self.steps, self.seed, self.backend, on_steps
        )
        return model, self._judged(model, started)

    def _judged(self, model: Splats, started: float) -> dict[str, Any]:
        verdict = self.yardstick.judge(model, self.backend)
        row = {
            "splats": len(model),
            "sh_degree": model.sh_degree,
            "bytes": _bytes(model),
            "loss": verdict.loss,
            "psnr": verdict.psnr,
            "ssim": verdict.ssim,
            "seconds": round(time.perf_counter() - started, 3),
        }
        self.curve.append(row)
        return row


def _chosen(splats: Splats, indices: npt.NDArray[np.intp]) -> Splats:
    return Splats(
        splats.means[indices],
        splats.quats[indices],
        splats.scales[indices],
        splats.opacities[indices],
        splats.sh[indices],
        splats.origin,
    )


def _bytes(splats: Splats) -> int:
    """Size of the file that ``splats`` are saved as."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.ply"
        splats.save(path)
        return path.stat().st_size


def _check_arguments(
    max_loss: object,
    capture: Capture | None,
    psnr: object,
    steps: object,
    seed: object,
    background: object,
) -> None:
    numbers_above_zero = [("max_loss", max_loss)] + ([] if psnr is None else [("psnr", psnr)])
    for name, value in numbers_above_zero:
        real = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if not real or not 0.0 < float(value) < 100.0:  # type: ignore[arg-type]
            raise IgsrError(f"{name} must be a number of dB above 0 and below 100, not {value!r}.")
    if psnr is not None and capture is not None:
        raise IgsrError("psnr is measured on the capture's photos; leave psnr or capture out.")
    for name, value, low, high in (("steps", steps, 1, 10_000_000), ("seed", seed, 0, 2**63 - 1)):
        whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
        if not whole or not low <= int(value) <= high:  # type: ignore[call-overload]
            raise IgsrError(f"{name} must be a whole number from {low} to {high}, not {value!r}.")
    if background is not None:
        try:
            color = np.asarray(background, dtype=np.float64)
        except (TypeError, ValueError):
            color = np.zeros(0)
        if color.shape != (3,) or not ((color >= 0.0) & (color <= 1.0)).all():
            raise IgsrError(f"background must be three numbers in 0..1, not {background!r}.")
