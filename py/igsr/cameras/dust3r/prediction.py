"""Run DUSt3R on pairs of photos.

Each photo is encoded once; the decoders run per pair. Of a prediction, samples on a grid are kept,
so that memory grows slowly with the number of pairs. Only the most confident pointmap of each photo
is kept at the network's resolution, for its depths.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from igsr.cameras.alignment import PairPrediction
from igsr.cameras.dust3r.network import PATCH, Dust3rNetwork, Tokens
from igsr.cameras.grid import Grid, on_white
from igsr.cameras.networks import float32_array, half_precision
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

Float32 = npt.NDArray[np.float32]

#: Image size of the model that was trained on squares only.
SQUARE_SIZE = 224
#: Maximum number of samples along the longer side of a prediction's grid. Samples are float32:
#: float16 would round points by a quarter of a pixel at the edge of a photo of 512 pixels.
MAX_GRID_SIDE = 128
#: Ordered pairs in a batch of the decoders: a pair and its mirror image.
BATCH_PAIRS = 2
#: Confidence of samples that must not be used: their weight, its logarithm, is 0.
NO_CONFIDENCE = np.float32(1.0)


@dataclass(frozen=True)
class Crop:
    """The part of a resized photo that the network sees; all sizes in pixels."""

    photo_width: int
    photo_height: int
    resized_width: int
    resized_height: int
    left: int  # first column of the part in the resized photo
    top: int  # first row
    width: int  # of the part, a multiple of 16
    height: int

    def grid(self, columns: range, rows: range) -> Grid:
        """The grid of these columns and rows of the part."""
        scale_x = self.photo_width / self.resized_width
        scale_y = self.photo_height / self.resized_height
        # The center of the grid's first cell, 0.5, is the center of the first sampled pixel.
        left = self.left + columns.start + 0.5 - 0.5 * columns.step
        top = self.top + rows.start + 0.5 - 0.5 * rows.step
        return Grid(
            height=len(rows),
            width=len(columns),
            scale_x=columns.step * scale_x,
            scale_y=rows.step * scale_y,
            offset_x=left * scale_x,
            offset_y=top * scale_y,
        )


def crop_of(photo: Photo, image_size: int) -> Crop:
    """Choose what a model sees of a photo, as the published inference does.

    Args:
        photo: any photo.
        image_size: of the model, pixels. 224 takes a central square; others scale the longer side
            to it and crop square photos to 4:3. Both sides are cropped to multiples of a patch.

    Raises:
        IgsrError: image or mask have a wrong type or shape, or the photo is too narrow.
    """
    image = photo.image
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise IgsrError(
            f"{photo.name}: its image is {image.dtype} {list(image.shape)}; give uint8 [H, W, 3] "
            "or [H, W, 4]"
        )
    if photo.mask is not None and photo.mask.shape != image.shape[:2]:
        raise IgsrError(
            f"{photo.name}: its mask has shape {list(photo.mask.shape)}; give "
            f"{list(image.shape[:2])}, as the photo"
        )
    height, width = image.shape[:2]
    longer, shorter = max(width, height), min(width, height)
    if shorter * image_size < PATCH * longer:
        raise IgsrError(
            f"{photo.name} is {width}x{height} pixels, too narrow for DUSt3R; crop it or leave it "
            "out"
        )
    side = round(image_size * longer / shorter) if image_size == SQUARE_SIZE else image_size
    resized_width, resized_height = round(width * side / longer), round(height * side / longer)
    half_width, half_height = resized_width // 2, resized_height // 2
    left, top = half_width, half_height
    if image_size == SQUARE_SIZE:
        half_width = half_height = min(half_width, half_height)
    else:
        # Halves of multiples of 16.
        half_width, half_height = (half // 8 * 8 for half in (half_width, half_height))
        if resized_width == resized_height:
            half_height = half_width * 3 // 4 // 8 * 8
    return Crop(
        photo_width=width,
        photo_height=height,
        resized_width=resized_width,
        resized_height=resized_height,
        left=left - half_width,
        top=top - half_height,
        width=2 * half_width,
        height=2 * half_height,
    )


def network_input(photo: Photo, crop: Crop) -> Float32:
    """The pixels [3, h, w] of a crop in [-1, 1], transparency on white."""
    image = Image.fromarray(on_white(photo.image))
    # The filters of the models' training: others show in the predictions.
    shrinks = max(crop.photo_width, crop.photo_height) > max(
        crop.resized_width, crop.resized_height
    )
    filtered = Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC
    resized = np.asarray(image.resize((crop.resized_width, crop.resized_height), filtered))
    part = resized[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    values = part.transpose(2, 0, 1).astype(np.float32) / np.float32(255.0)
    return (values - np.float32(0.5)) / np.float32(0.5)


@dataclass(frozen=True, eq=False)
class DenseMap:
    """The most confident pointmap of a photo in its own frame, at the network's resolution.

    Of the pairs with this photo first, it has the highest product of mean confidences, the score by
    which the alignment ranks pairs.
    """

    depth: Float32  # [H, W], z of the points, in the unit of that pair
    confidence: Float32  # [H, W], raw; 1 for pixels that must not be used
    grid: Grid  # position of the map in the photo
    rows: range  # of the samples in the pair's prediction
    columns: range


@dataclass(frozen=True)
class DenseGrid(Grid):
    """The grid of a photo's predictions, with its dense map if it is the first of a pair."""

    dense: DenseMap | None = None


class DustPredictor:
    """DUSt3R as the predictor of the alignment.

    On CUDA devices encoder and decoders run in half precision (bfloat16, else float16), the heads
    in float32."""

    def __init__(self, network: Dust3rNetwork) -> None:
        self.network = network

    def __call__(
        self,
        photos: Sequence[Photo],
        pairs: Sequence[tuple[int, int]],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> tuple[list[Grid], list[PairPrediction]]:
        """As ``Predictor``: a ``DenseGrid`` per photo, and a prediction per pair, in that order.

        Masked and transparent pixels have confidence 1, that is no weight. Sorted pairs take the
        least memory, since photos are forgotten after their last pair.

        Raises:
            IgsrError: a photo is too narrow, or the predictions are not finite.
        """
        views = [_View(photo, self.network.config.image_size) for photo in photos]
        encoded = _EncodedPhotos(self.network, views, pairs)
        predictions: list[PairPrediction] = []
        dense: list[DenseMap | None] = [None] * len(photos)
        scores = [0.0] * len(photos)
        with torch.inference_mode(), half_precision(encoded.device):
            for batch in _batches(pairs, views):
                firsts, seconds = (encoded.batch([pair[side] for pair in batch]) for side in (0, 1))
                maps = self.network.decode(firsts, seconds)
                encoded.release(batch)
                whole = [
                    (float32_array(side.points), float32_array(side.confidence)) for side in maps
                ]
                for n, pair in enumerate(batch):
                    pair_views = [views[i] for i in pair]
                    points = [side[0][n] for side in whole]
                    confidences = [
                        np.where(view.hidden, NO_CONFIDENCE, side[1][n])
                        for view, side in zip(pair_views, whole, strict=True)
                    ]
                    if not all(np.isfinite(x).all() for x in (*points, *confidences)):
                        names = " and ".join(photos[i].name for i in pair)
                        raise IgsrError(
                            f"The predictions for {names} are not finite, so the checkpoint is "
                            "damaged; download it again"
                        )
                    first = pair[0]
                    score = float(confidences[0].mean()) * float(confidences[1].mean())
                    if score > scores[first]:
                        scores[first] = score
                        depth = points[0][..., 2].copy()
                        view = pair_views[0]
                        dense[first] = DenseMap(
                            depth, confidences[0], view.whole, view.rows, view.columns
                        )
                    samples = (
                        array[np.ix_(view.rows, view.columns)]
                        for view, *arrays in zip(pair_views, points, confidences, strict=True)
                        for array in arrays
                    )
                    predictions.append(PairPrediction(*pair, *samples))
                if progress is not None:
                    progress("pairs", len(predictions), len(pairs))
        grids: list[Grid] = [
            DenseGrid(**vars(view.crop.grid(view.columns, view.rows)), dense=own)
            for view, own in zip(views, dense, strict=True)
        ]
        return grids, predictions


class _View:
    """A photo's crop, and the samples of it that are kept."""

    def __init__(self, photo: Photo, image_size: int) -> None:
        self.photo = photo
        self.crop = crop_of(photo, image_size)
        self.shape = self.crop.height, self.crop.width
        stride = stride_for(max(self.shape))
        self.rows, self.columns = (grid_samples(side, stride) for side in self.shape)
        self.whole = self.crop.grid(range(self.crop.width), range(self.crop.height))
        self.hidden = ~self.whole.usable(photo)


class _EncodedPhotos:
    """Tokens of photos, kept from their first pair to their last."""

    def __init__(
        self, network: Dust3rNetwork, views: list[_View], pairs: Sequence[tuple[int, int]]
    ) -> None:
        self.network = network
        self.views = views
        self.device = next(network.parameters()).device
        self.pairs_left = Counter(photo for pair in pairs for photo in pair)
        self.tokens: dict[int, Tokens] = {}

    def batch(self, photos: list[int]) -> Tokens:
        for photo in set(photos) - self.tokens.keys():
            view = self.views[photo]
            image = torch.from_numpy(network_input(view.photo, view.crop)[None])
            self.tokens[photo] = self.network.encode(image.to(self.device))
        first = self.tokens[photos[0]]
        features = torch.cat([self.tokens[photo].features for photo in photos])
        return Tokens(features, first.rows, first.columns)

    def release(self, batch: list[tuple[int, int]]) -> None:
        for pair in batch:
            for photo in pair:
                self.pairs_left[photo] -= 1
                if self.pairs_left[photo] == 0:
                    del self.tokens[photo]


def stride_for(side: int) -> int:
    """Pixels between samples, so that at most ``MAX_GRID_SIDE`` lie along ``side`` pixels.

    It is odd, so that samples can lie symmetrically about the center of an even number of pixels,
    and below 16, so that every side of a crop has samples.
    """
    stride = 1
    while len(grid_samples(side, stride)) > MAX_GRID_SIDE and stride < PATCH - 1:
        stride += 2
    return stride


def grid_samples(side: int, stride: int) -> range:
    """Sampled pixels of an even ``side``: an even number, symmetric about the center.

    So the center of a grid is the center of the input, its principal point.
    """
    count = ((side - 1) // stride + 1) // 2 * 2
    start = (side - 1 - (count - 1) * stride) // 2
    return range(start, start + count * stride, stride)


def _batches(
    pairs: Sequence[tuple[int, int]], views: list[_View]
) -> Iterator[list[tuple[int, int]]]:
    """Group consecutive pairs whose photos have the same two shapes."""
    batch: list[tuple[int, int]] = []
    for pair in pairs:
        if batch and (
            len(batch) == BATCH_PAIRS
            or any(views[a].shape != views[b].shape for a, b in zip(pair, batch[0], strict=True))
        ):
            yield batch
            batch = []
        batch.append(pair)
    if batch:
        yield batch
