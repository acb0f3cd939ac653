"""Selection of novel views and the weights of their pixels, without ground truth.

The denoiser estimates the remaining error of each pixel. The confidence weight of a pixel follows
from that error, relative to the error of a photo. A view's gain is its mean change by denoising,
weighted by confidence.
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

#: Error with which splats reproduce a photo's colors. A pixel with this expected error has a
#: confidence weight of one half.
PHOTO_ERROR = 0.06
#: Minimum mean confidence weight of a selected view.
MIN_CONFIDENCE = 0.15
#: Minimum gain of a selected view: with full confidence, an eighth of an 8-bit level.
MIN_GAIN = 0.0005


@dataclass(frozen=True, eq=False)
class Candidate:
    """A novel view, rendered and denoised.

    Attributes:
        view: its camera.
        render: uint8 [H, W, 3], render of the splats.
        denoised: uint8 [H, W, 3], the render after denoising.
        confidence: float32 [H, W] in [0, 1], weight of each pixel; photos have 1.
        gain: mean over the pixels of confidence weight times absolute change by denoising; colors
            are in [0, 1].
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
    """A candidate that was not selected, without its images."""

    view: NovelView
    mean_confidence: float
    gain: float


def rejected(candidate: Candidate) -> Rejected:
    """Remove the images of a candidate."""
    return Rejected(candidate.view, candidate.mean_confidence, candidate.gain)


def denoised_candidate(
    view: NovelView, buffers: Buffers, photos: Sequence[Source], denoiser: Denoiser | None = None
) -> Candidate:
    """Denoise a render; compute its confidence weights and gain.

    If photos have masks, weights are scaled by the photos' support: masked surfaces are not wanted.

    Args:
        view: the view of the render.
        buffers: from ``igsr.denoiser.render_buffers``.
        photos: from ``igsr.denoiser.photo_sources``.
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
    """Confidence weights [H, W] from a denoiser's confidence map.

    Least squares weights measurements by their inverse variance: s^2 / (s^2 + e^2) for the expected
    error e and the photos' error s.
    """
    error = error_of(certainty)
    return (PHOTO_ERROR**2 / (PHOTO_ERROR**2 + error**2)).astype(np.float32)


def select_views(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """Select up to ``count`` candidates with enough confidence and gain, largest gain first."""
    usable = [
        candidate
        for candidate in candidates
        if candidate.mean_confidence >= MIN_CONFIDENCE and candidate.gain >= MIN_GAIN
    ]
    return sorted(usable, key=lambda candidate: candidate.gain, reverse=True)[:count]


def _to_uint8(colors: Float32) -> npt.NDArray[np.uint8]:
    return np.rint(255.0 * colors).astype(np.uint8)
