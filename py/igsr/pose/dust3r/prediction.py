"""Pairs of photos shown to the network, and what is kept of what it says.

Each photo is encoded once; the decoders run per pair. A prediction is kept as samples on a grid,
so that memory grows with the number of pairs slowly; only the surest pointmap of each photo is kept
at the network's resolution, for depths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.alignment.predictions import PairPrediction
from igsr.pose.dust3r.heads import PATCH
from igsr.pose.dust3r.network import Dust3rNetwork, NetworkConfig, Tokens
from igsr.pose.dust3r.preprocessing import Crop, crop_of, network_input
from igsr.pose.grid import Grid
from igsr.pose.network_arrays import float32_array, half_precision
from igsr.pose.photo_samples import usable

Float32 = npt.NDArray[np.float32]
Bool = npt.NDArray[np.bool_]

#: Samples along the longer side of a prediction's grid, at most.
LONGEST_GRID = 128
#: Ordered pairs that go through the decoders together: a pair and its mirror image.
TOGETHER = 2
#: Confidence of samples that may not be used: its logarithm, their weight, is 0.
NO_CONFIDENCE = np.float32(1.0)

# Bytes of a point and its confidence in float32. Half precision would round points by up to
# 1/2048, a quarter of a pixel at the edge of a photo of 512 pixels, where focal lengths are sought
# to 1/1000.
_SAMPLE = 4 * 4
# Bytes per pixel and ordered pair that the heads' maps take at once, as measured.
_WORK = 3000


@dataclass(frozen=True, eq=False)
class DensePrediction:
    """A photo's own pointmap at the network's resolution.

    Attributes:
        prediction: index of the ``PairPrediction`` that it belongs to, of those in which the photo
            is the first that of the highest product of mean confidences (the score by which
            alignment ranks pairs). Unit and frame are that prediction's.
        points: float32 [H, W, 3].
        confidence: float32 [H, W], raw; 1 where the photo may not be used.
        grid: how the map lies in the photo.
        rows, columns: the samples of which the prediction's grid consists:
            ``points[rows, columns]`` is its ``first_points``.
    """

    prediction: int
    points: np.ndarray
    confidence: np.ndarray
    grid: Grid
    rows: slice
    columns: slice


@dataclass(frozen=True)
class DenseGrid(Grid):
    """The grid of a photo with its pointmap at the network's resolution.

    Attributes:
        dense: None where the photo is the first of no pair.
    """

    dense: DensePrediction | None = None


class MemoryBound(NamedTuple):
    """Bytes that prediction needs at most.

    Attributes:
        device: where the network runs: its weights, encoded photos and a pair's maps.
        kept: in main memory: the predictions.
    """

    device: int
    kept: int


def memory_bound(
    config: NetworkConfig, photos: int, pairs: int, longest: int = LONGEST_GRID
) -> MemoryBound:
    """Bytes that predicting ``pairs`` ordered pairs of ``photos`` photos needs at most.

    With T tokens and S grid samples per photo, weights of W bytes and C channels of the encoder:
    device = W + 4 T C photos + 3000 * 256 T * 2 and kept = 32 S pairs + 16 * 256 T photos. Nothing
    grows faster than photos or pairs. The photos themselves and torch's own needs come on top.

    Args:
        config: the network's sizes.
        photos: how many are in pairs.
        pairs: ordered pairs.
        longest: as for ``DustPredictor``.
    """
    with torch.device("meta"):
        weights = sum(weight.numel() for weight in Dust3rNetwork(config).parameters())
    size = config.image_size
    # Photos that are nearly square have nearly so many.
    pixels = size * size
    samples = len(grid_samples(size, stride_for(size, longest))) ** 2
    return MemoryBound(
        device=4 * weights
        + photos * pixels // PATCH**2 * config.encoder_dim * 4
        + TOGETHER * pixels * _WORK,
        kept=pairs * 2 * samples * _SAMPLE + photos * pixels * _SAMPLE,
    )


class DustPredictor:
    """DUSt3R as the predictor of the alignment.

    The network runs where its weights are; on CUDA devices encoder and decoders in half precision
    (bfloat16, or float16 where the device has no bfloat16), the heads in float32 everywhere.

    Args:
        network: with weights, as ``load_network`` gives it.
        longest: samples along the longer side of a prediction's grid, at most.
    """

    def __init__(self, network: Dust3rNetwork, longest: int = LONGEST_GRID) -> None:
        """Keep the network."""
        if longest < 2:
            raise IgsrError(f"longest is {longest}; give at least 2 samples")
        self.network = network
        self.longest = longest

    def __call__(
        self,
        photos: Sequence[Photo],
        pairs: Sequence[tuple[int, int]],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[list[Grid], list[PairPrediction]]:
        """What the network sees in ordered pairs of photos.

        Confidence is 1, which weighs nothing, where a photo is masked or transparent.

        Args:
            photos: of any sizes.
            pairs: indices of photos; the points of both are in the first one's frame. A photo's
                features are kept from its first pair to its last, so sorted pairs need the least.
            progress: called with ("pairs", how many are done, of all).

        Returns:
            A ``DenseGrid`` per photo, and a prediction per pair, in the pairs' order.

        Raises:
            IgsrError: a pair is none of two photos, a photo is too narrow, or the network gives
                what is not finite.
        """
        for pair in pairs:
            if len(set(pair)) != 2 or not all(0 <= photo < len(photos) for photo in pair):
                raise IgsrError(
                    f"pairs holds {pair}; give two different indices of the {len(photos)} photos"
                )
        views = [_View(photo, self.network.config, self.longest) for photo in photos]
        encoded = _EncodedPhotos(self.network, views, pairs)
        predictions: list[PairPrediction] = []
        dense: list[DensePrediction | None] = [None] * len(photos)
        scores = [0.0] * len(photos)
        with torch.inference_mode(), half_precision(encoded.device):
            for batch in _batches(pairs, views):
                firsts, seconds = (encoded.batch([pair[side] for pair in batch]) for side in (0, 1))
                maps = self.network.decode(firsts, seconds)
                encoded.release(batch)
                whole = [
                    (float32_array(side.points), float32_array(side.confidence)) for side in maps
                ]
                for n, (first, second) in enumerate(batch):
                    points = [side[0][n] for side in whole]
                    confidences = [
                        views[i].masked(side[1][n])
                        for i, side in zip((first, second), whole, strict=True)
                    ]
                    if not all(np.isfinite(x).all() for x in (*points, *confidences)):
                        raise IgsrError(
                            f"The network gives numbers that are not finite for "
                            f"{photos[first].name} and {photos[second].name}; its checkpoint is "
                            "damaged, download it again"
                        )
                    score = float(confidences[0].mean()) * float(confidences[1].mean())
                    if score > scores[first]:
                        scores[first] = score
                        dense[first] = views[first].dense(
                            len(predictions), points[0], confidences[0]
                        )
                    predictions.append(
                        PairPrediction(
                            first,
                            second,
                            views[first].sampled(points[0]),
                            views[first].sampled(confidences[0]),
                            views[second].sampled(points[1]),
                            views[second].sampled(confidences[1]),
                        )
                    )
                if progress is not None:
                    progress("pairs", len(predictions), len(pairs))
        grids: list[Grid] = [view.grid(own) for view, own in zip(views, dense, strict=True)]
        return grids, predictions


class _View:
    """A photo's place in the network's input and the samples that are kept of it."""

    def __init__(self, photo: Photo, config: NetworkConfig, longest: int) -> None:
        self.photo = photo
        self.crop: Crop = crop_of(photo, config.image_size)
        stride = stride_for(max(self.crop.width, self.crop.height), longest)
        self.rows = grid_samples(self.crop.height, stride)
        self.columns = grid_samples(self.crop.width, stride)
        self.whole = self.crop.grid(range(self.crop.width), range(self.crop.height))
        self.hidden: Bool = ~usable(photo, self.whole)

    @property
    def shape(self) -> tuple[int, int]:
        return self.crop.height, self.crop.width

    def masked(self, confidence: Float32) -> Float32:
        return np.where(self.hidden, NO_CONFIDENCE, confidence)

    def sampled(self, array: Float32) -> Float32:
        # A copy: a view would keep the whole array.
        return array[_slice(self.rows), _slice(self.columns)].copy()

    def dense(self, prediction: int, points: Float32, confidence: Float32) -> DensePrediction:
        return DensePrediction(
            prediction,
            points.copy(),
            confidence,
            self.whole,
            _slice(self.rows),
            _slice(self.columns),
        )

    def grid(self, dense: DensePrediction | None) -> DenseGrid:
        kept = self.crop.grid(self.columns, self.rows)
        return DenseGrid(**vars(kept), dense=dense)


class _EncodedPhotos:
    """Photos' tokens from their first pair to their last."""

    def __init__(
        self, network: Dust3rNetwork, views: list[_View], pairs: Sequence[tuple[int, int]]
    ) -> None:
        self.network = network
        self.views = views
        self.device = next(network.parameters()).device
        self.pairs_left = Counter(photo for pair in pairs for photo in pair)
        self.tokens: dict[int, Tokens] = {}

    def batch(self, photos: list[int]) -> Tokens:
        tokens = [self._encoded(photo) for photo in photos]
        features = torch.cat([one.features for one in tokens])
        return Tokens(features, tokens[0].rows, tokens[0].columns)

    def _encoded(self, photo: int) -> Tokens:
        if photo not in self.tokens:
            view = self.views[photo]
            image = torch.from_numpy(network_input(view.photo, view.crop)[None])
            self.tokens[photo] = self.network.encode(image.to(self.device))
        return self.tokens[photo]

    def release(self, batch: list[tuple[int, int]]) -> None:
        for pair in batch:
            for photo in pair:
                self.pairs_left[photo] -= 1
                if self.pairs_left[photo] == 0:
                    del self.tokens[photo]


def stride_for(side: int, longest: int) -> int:
    """Pixels from sample to sample of a grid with at most ``longest`` along ``side`` pixels.

    It is odd, so that samples can lie symmetrically about the centre of an even number of pixels,
    and under 16, so that no side of a crop is left without.
    """
    stride = 1
    while len(grid_samples(side, stride)) > longest and stride < PATCH - 1:
        stride += 2
    return stride


def grid_samples(side: int, stride: int) -> range:
    """Pixels of an even ``side`` that a grid has: as many as fit, an even number about the centre.

    So the middle of a grid is the middle of what the network sees, where it takes the principal
    point to be.
    """
    count = ((side - 1) // stride + 1) // 2 * 2
    start = (side - 1 - (count - 1) * stride) // 2
    return range(start, start + count * stride, stride)


def _slice(samples: range) -> slice:
    return slice(samples.start, samples.stop, samples.step)


def _batches(
    pairs: Sequence[tuple[int, int]], views: list[_View]
) -> Iterator[list[tuple[int, int]]]:
    """Pairs that follow each other and have photos of the same two shapes."""
    batch: list[tuple[int, int]] = []
    for pair in pairs:
        if batch and (
            len(batch) == TOGETHER
            or any(views[a].shape != views[b].shape for a, b in zip(pair, batch[0], strict=True))
        ):
            yield batch
            batch = []
        batch.append(pair)
    if batch:
        yield batch
