"""Denoise the renders of one fit, and score them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.denoiser.cleaning import NetworkDenoiser
from igsr.denoiser.weights import load_network
from igsr.evaluation.metrics import PSNR_CAP, score
from igsr_lab.denoiser.pair_files import Pairs, read_pairs, unpacked
from igsr_lab.denoiser.perceptual_distance import Distance, SqueezeNetDistance
from igsr_lab.study.scoring import Picture, known_means, masked_distance
from igsr_lab.study.study import Row

Float64 = npt.NDArray[np.float64]

#: Scores by name; None if a score is not defined.
Scores = dict[str, float | None]
#: Scores of the table; lower is better in the last two. "best_quarter" is the PSNR of the quarter
#: of each view's pixels that were nearest to the truth before denoising.
SCORES = ("psnr", "ssim", "ms_ssim", "best_quarter", "flip", "perceptual")
#: Edges of the bins of confidence.
CONFIDENCE_EDGES = np.linspace(0.0, 1.0, 21)


@dataclass(frozen=True)
class Cleaning:
    """Files of one denoiser (None scores the renders themselves) and of the renders of one fit."""

    pairs: str
    weights: str | None
    features: str | None


@dataclass(frozen=True, eq=False)
class ViewToClean:
    """Render and photo, uint8 [H, W, 3]; mask of known pixels; the network's input."""

    render: Picture
    truth: Picture
    mask: npt.NDArray[np.bool_]
    inputs: npt.NDArray[np.float32]

    @staticmethod
    def of_pairs(pairs: Pairs, number: int) -> ViewToClean:
        """One of the pairs."""
        channels = pairs.inputs[number]
        return ViewToClean(
            _picture(channels[:3]),
            _picture(pairs.truth[number]),
            pairs.masks[number],
            unpacked(channels),
        )


def run_cleaning(data: str, run: Cleaning) -> Row:
    """Denoise and score the renders of one fit; ``data`` is unused.

    Returns:
        The row: mean ``SCORES``, "views" with the scores of each, and, with a denoiser,
        "confidence" (see ``_ConfidenceBins``).
    """
    pairs = read_pairs(run.pairs)
    denoiser = None if run.weights is None else NetworkDenoiser(load_network(run.weights))
    distance = None if run.features is None else SqueezeNetDistance(run.features)
    bins = _ConfidenceBins()
    views: list[Scores] = []
    for number in range(len(pairs.truth)):
        view = ViewToClean.of_pairs(pairs, number)
        if not view.mask.any():
            continue
        after = view.render
        if denoiser is not None:
            picture, confidence = denoiser.clean(view.inputs)
            after = to_uint8(picture)
            error = np.abs(picture - view.truth / 255.0).mean(axis=-1)
            bins.add(confidence[view.mask].astype(np.float64), error[view.mask])
        views.append(_scored(view, after, distance))
    row: Row = {"views": views, **known_means(views, SCORES)}
    if denoiser is not None:
        row["confidence"] = bins.row()
    return row


def to_uint8(picture: npt.NDArray[np.float32]) -> Picture:
    """A picture in [0, 1] as uint8."""
    return np.rint(255.0 * picture).astype(np.uint8)


def _scored(view: ViewToClean, after: Picture, distance: Distance | None) -> Scores:
    scores: Scores = dict(score(after, view.truth, None if view.mask.all() else view.mask))
    scores["best_quarter"] = _best_quarter(view, after)
    if distance is not None:
        scores["perceptual"] = masked_distance(distance, after, view.truth, view.mask)
    return scores


def _best_quarter(view: ViewToClean, after: Picture) -> float:
    def squares(picture: Picture) -> Float64:
        difference = picture.astype(np.float64) - view.truth
        return np.square(difference / 255.0).mean(axis=-1)[view.mask]

    before = squares(view.render)
    best = before <= np.quantile(before, 0.25)
    error = float(squares(after)[best].mean())
    return PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * float(np.log10(error)))


def _picture(channels: Picture) -> Picture:
    return np.ascontiguousarray(np.moveaxis(channels, 0, -1))


class _ConfidenceBins:
    """Sums over the pixels of all views by bins of confidence: their number, confidence, error."""

    def __init__(self) -> None:
        self.pixels, self.confidence, self.error = np.zeros((3, len(CONFIDENCE_EDGES) - 1))
        self.views, self.mean_errors, self.weighted_errors = 0.0, 0.0, 0.0

    def add(self, confidence: Float64, error: Float64) -> None:
        """Add the pixels of one view: confidence [N] and absolute error [N]."""
        bins = len(self.pixels)
        at = np.clip(np.digitize(confidence, CONFIDENCE_EDGES) - 1, 0, bins - 1)
        self.pixels += np.bincount(at, minlength=bins)
        self.confidence += np.bincount(at, confidence, minlength=bins)
        self.error += np.bincount(at, error, minlength=bins)
        self.views += 1.0
        self.mean_errors += float(error.mean())
        self.weighted_errors += float(np.sum(confidence * error) / np.sum(confidence))

    def row(self) -> Row:
        """The sums by bin, and the mean error of a view, also weighted by confidence."""
        return {
            "pixels": self.pixels.tolist(),
            "confidence": self.confidence.tolist(),
            "error": self.error.tolist(),
            "mean_error": self.mean_errors / max(self.views, 1.0),
            "weighted_error": self.weighted_errors / max(self.views, 1.0),
        }
