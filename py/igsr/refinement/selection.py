"""Which rendered views to trust, and where: without the true pictures.

The denoiser says how wrong it expects each colour to be still. A pixel counts as much as a
measurement of that error would beside a photo's; a view is worth what it would change where it can
be trusted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from igsr.denoiser import Buffers, Denoiser, Source, denoise
from igsr.denoiser.cleaning import HALF_CONFIDENCE_ERROR
from igsr.refinement.novel_views import UnseenView

Float32 = npt.NDArray[np.float32]

#: Error of a photo's colours as splats see them: noise, and what the model cannot show. A pixel
#: that is expected to be as wrong counts half.
PHOTO_ERROR = 0.06
#: A view whose pixels count less than this on average is not one to learn from.
LEAST_TRUST = 0.15
#: Nor is one that is worth less than this: an eighth of a level of 8 bits, trusted everywhere.
LEAST_WORTH = 0.0005


@dataclass(frozen=True, eq=False)
class Candidate:
    """An unseen view, rendered and cleaned.

    Attributes:
        view: where from.
        render: uint8 [H, W, 3], before.
        picture: uint8 [H, W, 3], after.
        trust: float32 [H, W] in [0, 1]: how much each pixel counts beside a photo's.
        worth: mean over the pixels of trust times what cleaning changed, in units of the colours'
            range.
    """

    view: UnseenView
    render: npt.NDArray[np.uint8]
    picture: npt.NDArray[np.uint8]
    trust: Float32
    worth: float

    @property
    def mean_trust(self) -> float:
        """Over all pixels."""
        return float(self.trust.mean())


@dataclass(frozen=True, eq=False)
class Passed:
    """An unseen view that was not added: where from, and what ``Candidate`` says of it."""

    view: UnseenView
    mean_trust: float
    worth: float


def passed(one: Candidate) -> Passed:
    """A candidate without its pictures."""
    return Passed(one.view, one.mean_trust, one.worth)


def candidate(
    view: UnseenView, buffers: Buffers, photos: Sequence[Source], denoiser: Denoiser | None = None
) -> Candidate:
    """Clean a render and say how far it can be trusted.

    Where photos have masks, what no photo shows is not of the scene that is asked for: a pixel
    counts by how much of it photos show.

    Args:
        view: where it was rendered from.
        buffers: of ``render_buffers``.
        photos: of ``photo_sources``.
        denoiser: what cleans; None is the one that comes with igsr.

    Raises:
        IgsrError: as ``igsr.denoise``.
    """
    cleaned, confidence = denoise(buffers, photos, denoiser)
    trust = trust_of(confidence)
    if buffers.support is not None and not all(photo.usable.all() for photo in photos):
        trust *= np.clip(buffers.support, 0.0, 1.0)
    seen = np.clip(np.nan_to_num(buffers.color), 0.0, 1.0)
    change = np.abs(cleaned - seen).mean(axis=-1)
    worth = float((trust * change).mean())
    return Candidate(view, _bytes(seen), _bytes(cleaned), trust, worth)


def trust_of(confidence: Float32) -> Float32:
    """Weights [H, W] of pixels beside a photo's, from the denoiser's confidence.

    Least squares weights measurements by the inverse of their variance: with the expected error e
    and a photo's own, s, that is s^2 / (s^2 + e^2).
    """
    sure = np.clip(confidence, 1e-6, 1.0)
    error = HALF_CONFIDENCE_ERROR * (1.0 / sure - 1.0)
    return (PHOTO_ERROR**2 / (PHOTO_ERROR**2 + error**2)).astype(np.float32)


def select(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """The ``count`` views that are worth most, of those that can be trusted; the best first."""
    some = [one for one in candidates if one.mean_trust >= LEAST_TRUST and one.worth >= LEAST_WORTH]
    return sorted(some, key=lambda one: one.worth, reverse=True)[:count]


def _bytes(colors: Float32) -> npt.NDArray[np.uint8]:
    return np.rint(255.0 * colors).astype(np.uint8)
