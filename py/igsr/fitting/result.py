"""``FitResult``: what ``igsr.fit`` returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture import Capture, Exposure
from igsr.evaluation.scores import Scores
from igsr.fitting.settings import FitSettings
from igsr.splats import Splats


@dataclass(frozen=True, eq=False, repr=False)
class FitResult:
    """A finished fit.

    Attributes:
        splats: the scene.
        capture: photos with their cameras as optimized, their exposures (``View.exposure``) and
            masks that leave out transient objects.
        settings: of the fit.
        device: "backend", "device" and "instruction_set".
        started: initialization ("points", "hull" ...) and its number of splats.
        steps: number of steps taken.
        seconds: time spent on the steps and on rough cameras, earlier runs included.
        loss: of the last step, 0.8 L1 + 0.2 D-SSIM; NaN if a resumed fit had none left.
        removed: number of floaters removed, by kind.
        masked: masked fraction of each photo with transient objects, by name.
        not_placed: names of the photos whose cameras were not found.
        scores: of held-out photos, or of fitted ones if none is held out; None if ``out`` was not
            given.
        report: the content of ``report.json``; None if ``out`` was not given.
    """

    splats: Splats
    capture: Capture
    settings: FitSettings
    device: Mapping[str, str]
    started: tuple[str, int]
    steps: int
    seconds: float
    loss: float
    removed: Mapping[str, int] = field(default_factory=dict)
    masked: Mapping[str, float] = field(default_factory=dict)
    not_placed: tuple[str, ...] = ()
    scores: Scores | None = None
    report: dict[str, Any] | None = None

    @property
    def masks(self) -> dict[str, npt.NDArray[np.bool_]]:
        """bool [H, W] by name of the photo: pixels that count. Photos without a mask are absent."""
        views = self.capture.train_views
        return {view.name: view.mask for view in views if view.mask is not None}

    @property
    def exposures(self) -> dict[str, Exposure]:
        """Exposures by name of the photo; empty if they were not optimized."""
        views = self.capture.train_views
        return {view.name: view.exposure for view in views if view.exposure is not None}

    def __repr__(self) -> str:
        score = "" if self.scores is None else f", {self.scores.psnr:.2f} dB"
        return f"FitResult({len(self.splats)} splats, {self.steps} steps{score})"
