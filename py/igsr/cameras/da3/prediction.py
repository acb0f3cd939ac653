"""Run Depth Anything 3 on photos: cameras, depths and confidences in one world per pass.

The filters are OpenCV's, which the models were trained with: area means to shrink, cubic
convolution without antialiasing to enlarge. Each is two matrices in float64, for rows and columns.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from igsr._internal.available_memory import available_memory
from igsr.cameras.da3.backbone import PATCH, NetworkConfig
from igsr.cameras.da3.cameras import decode_pose
from igsr.cameras.da3.network import Da3Network, ViewPrediction
from igsr.cameras.depth_maps import AlignedPhoto
from igsr.cameras.grid import Grid, on_white
from igsr.cameras.networks import float32_array, half_precision
from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
UInt8 = npt.NDArray[np.uint8]

#: Pixels of the longer side of the network's input.
RESOLUTION = 504
#: Mean and standard deviation of the training photos' channels.
MEAN = (0.485, 0.456, 0.406)
DEVIATION = (0.229, 0.224, 0.225)
#: Parameter of the cubic convolution.
CUBIC = -0.75
#: Maximum number of photos in a pass, whose time grows with their square.
MAX_PHOTOS_ON_CPU = 32
MAX_PHOTOS_ON_GPU = 100
#: Floats of a pass per token and channel of the backbone: features for the head (8), queries, keys
#: and values before and after concatenation (6), tokens (4).
FLOATS_PER_TOKEN = 18
#: Floats of the head per pixel and fused channel, for one photo.
FLOATS_PER_PIXEL = 3
#: Fraction of the free memory that a pass may use.
USABLE_MEMORY = 0.8
#: Range of valid focal lengths, in units of the longer side.
MIN_FOCAL = 0.2
MAX_FOCAL = 10.0
#: Confidence of pixels that must not be used.
NO_CONFIDENCE = 1.0


@dataclass(frozen=True)
class Resampling:
    """How a photo is resampled for the network: scaled, then resized to multiples of 14."""

    photo_width: int
    photo_height: int
    scaled_width: int  # with the aspect of the photo
    scaled_height: int
    width: int
    height: int

    def grid(self) -> Grid:
        """Position of the network's pixels in the photo."""
        scale_x, scale_y = self.photo_width / self.width, self.photo_height / self.height
        return Grid(self.height, self.width, scale_x, scale_y, 0.0, 0.0)


def resampling_of(width: int, height: int, resolution: int = RESOLUTION) -> Resampling:
    """Choose the resampling of a photo.

    The longer side is scaled to the resolution; then both sides are resized to the nearest
    multiples of 14, which changes the aspect.

    Raises:
        IgsrError: the photo is too narrow.
    """
    side = max(width, height)
    scale = resolution / side
    scaled_width, scaled_height = width, height
    if side != resolution:
        scaled_width, scaled_height = (max(1, round(n * scale)) for n in (width, height))
    resized_width, resized_height = (
        (n + PATCH // 2) // PATCH * PATCH for n in (scaled_width, scaled_height)
    )
    if min(resized_width, resized_height) < PATCH:
        raise IgsrError(
            f"a photo of {width}x{height} pixels is too narrow for Depth Anything 3; crop it or "
            "leave it out"
        )
    return Resampling(width, height, scaled_width, scaled_height, resized_width, resized_height)


def resamplings_of(photos: Sequence[Photo]) -> list[Resampling]:
    """Choose the resamplings of the photos of a scene.

    Sizes that differ from the most common one by at most a patch are replaced by it, since the
    network was trained with views of one size.

    Raises:
        IgsrError: a photo is too narrow.
    """
    resamplings = []
    for photo in photos:
        height, width = photo.image.shape[:2]
        try:
            resamplings.append(resampling_of(width, height))
        except IgsrError as error:
            raise IgsrError(f"{photo.name}: {error}") from error
    (width, height), _ = Counter((one.width, one.height) for one in resamplings).most_common(1)[0]
    return [
        replace(one, width=width, height=height)
        if max(abs(one.width - width), abs(one.height - height)) <= PATCH
        else one
        for one in resamplings
    ]


def network_input(image: UInt8, resampling: Resampling) -> Float32:
    """Resample and normalize a photo uint8 [H, W, 3] to float32 [3, h, w]."""
    levels = resampled(image, resampling).astype(np.float32) / np.float32(255.0)
    normalized = (levels - np.array(MEAN, np.float32)) / np.array(DEVIATION, np.float32)
    return np.ascontiguousarray(normalized.transpose(2, 0, 1))


def resampled(image: UInt8, resampling: Resampling) -> UInt8:
    """Resample a photo uint8 [H, W, 3] to uint8 [h, w, 3]."""
    for width, height in (
        (resampling.scaled_width, resampling.scaled_height),
        (resampling.width, resampling.height),
    ):
        rows, columns = image.shape[:2]
        if (rows, columns) == (height, width):
            continue
        matrix = cubic_matrix if height > rows or width > columns else area_matrix
        down, across = matrix(rows, height), matrix(columns, width)
        channels = [down @ image[..., c].astype(np.float64) @ across.T for c in range(3)]
        # float32, so that rounding errors of float64 do not decide which way a half is rounded.
        levels = np.stack(channels, axis=-1).astype(np.float32)
        image = np.clip(np.rint(levels), 0.0, 255.0).astype(np.uint8)
    return image


def area_matrix(size: int, wanted: int) -> Float64:
    """[wanted, size]: each output pixel is the mean of the input pixels that it covers."""
    edges = np.arange(wanted + 1)[:, None] * (size / wanted)
    covered = np.clip(edges - np.arange(size), 0.0, 1.0)
    weights: Float64 = np.diff(covered, axis=0) * (wanted / size)
    return weights


def cubic_matrix(size: int, wanted: int) -> Float64:
    """[wanted, size]: each output pixel is a cubic convolution of its four nearest input pixels."""
    position = (np.arange(wanted) + 0.5) * (size / wanted) - 0.5
    first = np.floor(position).astype(np.int64)
    matrix = np.zeros((wanted, size))
    for tap in range(-1, 3):
        distance = np.abs(position - first - tap)
        near = ((CUBIC + 2.0) * distance - (CUBIC + 3.0)) * distance**2 + 1.0
        far = CUBIC * (((distance - 5.0) * distance + 8.0) * distance - 4.0)
        weight = np.where(distance <= 1.0, near, np.where(distance < 2.0, far, 0.0))
        np.add.at(matrix, (np.arange(wanted), np.clip(first + tap, 0, size - 1)), weight)
    return matrix


class Predictor(Protocol):
    """Predicts cameras and depths of photos, as the network does."""

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """Maximum number of photos in one pass."""
        ...

    def __call__(self, photos: Sequence[Photo], seed: int) -> list[AlignedPhoto | None]:
        """Predict cameras and depths of photos in one world of an arbitrary unit.

        Args:
            photos: at least two.
            seed: random seed.

        Returns:
            Per photo; None if the prediction is not a valid camera.
        """
        ...


class Da3Predictor:
    """Depth Anything 3 as the predictor.

    On CUDA devices the backbone runs in half precision (bfloat16, else float16), the rest in
    float32.
    """

    def __init__(self, network: Da3Network) -> None:
        self.network = network
        self.device = next(network.parameters()).device

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """Maximum number of photos by the device's free memory, and by the time of a pass.

        Raises:
            IgsrError: two photos do not fit into memory.
        """
        on_cpu = self.device.type == "cpu"
        free = available_memory() if on_cpu else torch.cuda.mem_get_info(self.device)[0]
        pixels = max(one.width * one.height for one in resamplings_of(photos))
        most = MAX_PHOTOS_ON_CPU if on_cpu else MAX_PHOTOS_ON_GPU
        while memory_of_pass(self.network.config, most, pixels) > USABLE_MEMORY * free:
            most -= 1
            if most < 2:
                needed = memory_of_pass(self.network.config, 2, pixels) / USABLE_MEMORY
                raise IgsrError(
                    f"Depth Anything 3 needs {needed / 1e9:.1f} GB for two photos, but only "
                    f"{free / 1e9:.1f} GB are free; close other programs, or use DA3-SMALL"
                )
        return most

    def __call__(self, photos: Sequence[Photo], seed: int) -> list[AlignedPhoto | None]:
        resamplings = resamplings_of(photos)
        inputs = [
            torch.from_numpy(network_input(on_white(photo.image), one)).to(self.device)
            for photo, one in zip(photos, resamplings, strict=True)
        ]
        with torch.inference_mode(), half_precision(self.device):
            views = self.network.predict(inputs)
        return [
            self._aligned(photo, one, view)
            for photo, one, view in zip(photos, resamplings, views, strict=True)
        ]

    def _aligned(
        self, photo: Photo, resampling: Resampling, view: ViewPrediction
    ) -> AlignedPhoto | None:
        depth, confidence = float32_array(view.depth), float32_array(view.confidence)
        encoding = float32_array(view.pose_encoding)
        if not all(np.isfinite(one).all() for one in (depth, confidence, encoding)):
            raise IgsrError(
                f"The predictions for {photo.name} are not finite, so the checkpoint is damaged; "
                "download it again"
            )
        size = resampling.height, resampling.width
        w2c, K = decode_pose(encoding[None], *size)
        height, width = photo.image.shape[:2]
        grid = resampling.grid()
        in_photo = np.diag([grid.scale_x, grid.scale_y, 1.0]) @ K[0]
        focals = in_photo[[0, 1], [0, 1]] / max(width, height)
        if not ((focals > MIN_FOCAL) & (focals < MAX_FOCAL)).all():
            return None
        viewmat = np.vstack([w2c[0], [0.0, 0.0, 0.0, 1.0]])
        confidence = np.where(grid.usable(photo), confidence, np.float32(NO_CONFIDENCE))
        return AlignedPhoto(Camera(viewmat, in_photo, width, height), grid, depth, confidence)


def memory_of_pass(config: NetworkConfig, photos: int, pixels: int) -> int:
    """Maximum bytes of a pass of photos with at most so many pixels, without the weights."""
    tokens = pixels // PATCH**2 + 1
    backbone = photos * tokens * config.embed_dim * FLOATS_PER_TOKEN
    results = photos * pixels * 5
    return 4 * (backbone + results + FLOATS_PER_PIXEL * config.features * pixels)
