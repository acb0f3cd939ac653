"""Which novel views to add, and how much each of their pixels counts: without the true pictures.

The denoiser says how wrong it expects each colour to be still. A pixel counts as much as a
measurement of that error would beside a photo's: its confidence weight. A view's gain is how much
it would change, where its weights are high.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.denoiser import Buffers, Denoiser, Source, denoise
from igsr.denoiser.confidence import error_of
from igsr.refinement.novel_views import NovelView

Float32 = npt.NDArray[np.float32]

#: Error of a photo's colours as splats reproduce them: noise, and what the model cannot show. A
#: pixel with this expected error has a confidence weight of one half.
PHOTO_ERROR = 0.06
#: A view is selected only if its pixels' mean confidence weight is at least this.
LEAST_CONFIDENCE = 0.15
#: And if its gain is at least this: an eighth of an 8-bit level, with full confidence everywhere.
LEAST_GAIN = 0.0005


@dataclass(frozen=True, eq=False)
class Candidate:
    """A novel view, rendered and denoised, that may be added.

    Attributes:
        view: its camera.
        render: uint8 [H, W, 3], what the splats show.
        denoised: uint8 [H, W, 3], the same after denoising.
        confidence: float32 [H, W] in [0, 1], each pixel's weight beside a photo's pixel, which
            has 1.
        gain: mean over the pixels of confidence weight times absolute change by denoising, in
            units of the colours' range.
    """

    view: NovelView
    render: npt.NDArray[np.uint8]
    denoised: npt.NDArray[np.uint8]
    confidence: Float32
    gain: float

    @property
    def mean_confidence(self) -> float:
        """Mean confidence weight over all pixels."""
        return float(self.confidence.mean())


@dataclass(frozen=True, eq=False)
class Rejected:
    """A candidate that was not selected, without its pictures."""

    view: NovelView
    mean_confidence: float
    gain: float


def rejected(candidate: Candidate) -> Rejected:
    """A candidate without its pictures."""
    return Rejected(candidate.view, candidate.mean_confidence, candidate.gain)


def denoised_candidate(
    view: NovelView, buffers: Buffers, photos: Sequence[Source], denoiser: Denoiser | None = None
) -> Candidate:
    """Denoise a render, and find its confidence weights and gain.

    Where photos have masks, what no photo shows is no part of the scene that is wanted: a pixel's
    weight is scaled by how much of what it shows photos see inside their masks.

    Args:
        view: where it was rendered from.
        buffers: of ``igsr.denoiser.render_buffers``.
        photos: of ``igsr.denoiser.photo_sources``.
        denoiser: None is the one that comes with igsr.

    Raises:
        IgsrError: as ``igsr.denoise``.
    """
    denoised, certainty = denoise(buffers, photos, denoiser)
    confidence = confidence_weights(certainty)
    if buffers.support is not None and not all(photo.usable.all() for photo in photos):
        confidence = confidence * np.clip(buffers.support, 0.0, 1.0)
    render = np.clip(np.nan_to_num(buffers.color), 0.0, 1.0)
    gain = float((confidence * np.abs(denoised - render).mean(axis=-1)).mean())
    return Candidate(view, _to_uint8(render), _to_uint8(denoised), confidence, gain)


def confidence_weights(certainty: Float32) -> Float32:
    """Weights [H, W] of pixels beside a photo's, from the confidence map that a denoiser returns.

    Least squares weights measurements by their inverse variance. With the expected error e and the
    photos' own error s, that is s^2 / (s^2 + e^2).
    """
    error = error_of(certainty)
    return (PHOTO_ERROR**2 / (PHOTO_ERROR**2 + error**2)).astype(np.float32)


def select_views(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """At most ``count`` candidates of enough confidence and gain; the largest gain first."""
    usable = [
        candidate
        for candidate in candidates
        if candidate.mean_confidence >= LEAST_CONFIDENCE and candidate.gain >= LEAST_GAIN
    ]
    return sorted(usable, key=lambda candidate: candidate.gain, reverse=True)[:count]


def _to_uint8(colors: Float32) -> npt.NDArray[np.uint8]:
    return np.rint(255.0 * colors).astype(np.uint8)
