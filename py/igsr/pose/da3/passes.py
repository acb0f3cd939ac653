"""One pass of the network over photos: cameras, depths and confidences in the pass's own world."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch

from igsr.capture import Camera
from igsr.capture.memory_check import available_memory
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.da3.cameras import cameras_of_rays, decode_pose
from igsr.pose.da3.config import PATCH, NetworkConfig
from igsr.pose.da3.network import Da3Network, ViewPrediction
from igsr.pose.da3.preprocessing import Resampling, network_input, resampling_of
from igsr.pose.network_arrays import float32_array, half_precision
from igsr.pose.photo_samples import over_white, usable

Float64 = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]

#: Photos of one pass at most, for its time grows with their square: on a CPU, and elsewhere.
MOST_ON_CPU, MOST_ELSEWHERE = 32, 100
#: Floats that a pass holds per token and channel of the backbone: features for the head (8);
#: queries, keys and values before and after they are gathered (6); tokens (4).
PER_TOKEN = 18
#: Floats that the head holds per pixel and channel that it joins levels in, for one photo.
PER_PIXEL = 3
#: Part of the free memory that a pass may take.
USABLE = 0.8
#: Focal lengths outside this range, in units of the longer side, are no prediction.
SHORTEST, LONGEST = 0.2, 10.0
#: What weighs nothing.
NO_CONFIDENCE = 1.0
#: Where cameras are had from.
SOURCES = ("decoder", "rays")


class Predictor(Protocol):
    """What stands where the network stands."""

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """How many of the photos can go through one pass.

        Args:
            photos: all of them.

        Raises:
            IgsrError: not even two.
        """
        ...

    def __call__(
        self, photos: Sequence[Photo], cameras: Sequence[Camera] | None, seed: int
    ) -> list[AlignedPhoto | None]:
        """Cameras and depths of photos in one world frame of any unit.

        Args:
            photos: at least two.
            cameras: of all photos where they are known, in any world; the prediction is near them,
                not equal to them.
            seed: random seed.

        Returns:
            Per photo, or None where what is predicted is no camera.
        """
        ...


class Da3Predictor:
    """Depth Anything 3 as the predictor.

    The network runs where its weights are; on CUDA devices the backbone in half precision
    (bfloat16, or float16 where the device has no bfloat16), all else in float32 everywhere.

    Args:
        network: with weights, as ``load_network`` gives it.
        cameras_from: "decoder" or "rays".

    Raises:
        IgsrError: ``cameras_from`` is neither.
    """

    def __init__(self, network: Da3Network, cameras_from: str = SOURCES[0]) -> None:
        """Keep the network."""
        if cameras_from not in SOURCES:
            raise IgsrError(f"cameras_from is {cameras_from!r}; give {' or '.join(SOURCES)}")
        self.network = network
        self.cameras_from = cameras_from
        self.device = next(network.parameters()).device

    def most_photos(self, photos: Sequence[Photo]) -> int:
        """As ``Predictor``; by the free memory of the device, and by the time that a pass takes."""
        on_cpu = self.device.type == "cpu"
        free = available_memory() if on_cpu else torch.cuda.mem_get_info(self.device)[0]
        pixels = max(one.width * one.height for one in self._resamplings(photos))
        most = MOST_ON_CPU if on_cpu else MOST_ELSEWHERE
        while memory_of_pass(self.network.config, most, pixels) > USABLE * free:
            most -= 1
            if most < 2:
                needed = memory_of_pass(self.network.config, 2, pixels) / USABLE
                raise IgsrError(
                    f"Depth Anything 3 needs {needed / 1e9:.1f} GB for two photos and "
                    f"{free / 1e9:.1f} GB are free; end other programs, or name DA3-SMALL"
                )
        return most

    def __call__(
        self, photos: Sequence[Photo], cameras: Sequence[Camera] | None, seed: int
    ) -> list[AlignedPhoto | None]:
        """As ``Predictor``.

        Raises:
            IgsrError: the network gives what is not finite.
        """
        resamplings = self._resamplings(photos)
        inputs = [
            torch.from_numpy(network_input(over_white(photo.image), one)).to(self.device)
            for photo, one in zip(photos, resamplings, strict=True)
        ]
        viewmats = intrinsics = None
        if cameras is not None:
            pairs = zip(resamplings, cameras, strict=True)
            viewmats = torch.from_numpy(np.stack([camera.viewmat for camera in cameras]))
            intrinsics = torch.from_numpy(np.stack([one.intrinsics(c.K) for one, c in pairs]))
        with torch.inference_mode(), half_precision(self.device):
            views = self.network.predict(
                inputs, viewmats=viewmats, intrinsics=intrinsics, rays=self.cameras_from == "rays"
            )
        return [
            self._aligned(photo, one, view, seed)
            for photo, one, view in zip(photos, resamplings, views, strict=True)
        ]

    def _resamplings(self, photos: Sequence[Photo]) -> list[Resampling]:
        return resamplings_of(photos)

    def _aligned(
        self, photo: Photo, resampling: Resampling, view: ViewPrediction, seed: int
    ) -> AlignedPhoto | None:
        depth, confidence = float32_array(view.depth), float32_array(view.confidence)
        encoding = float32_array(view.pose_encoding)
        if not all(np.isfinite(one).all() for one in (depth, confidence, encoding)):
            raise IgsrError(
                f"The network gives numbers that are not finite for {photo.name}; its checkpoint "
                "is damaged, download it again"
            )
        size = resampling.height, resampling.width
        if view.rays is not None and view.ray_confidence is not None:
            try:
                w2c, K = cameras_of_rays(
                    view.rays[None], view.ray_confidence[None], *size, seed=seed
                )
            except IgsrError:
                return None
        else:
            w2c, K = decode_pose(encoding[None], *size)
        height, width = photo.image.shape[:2]
        grid = resampling.grid()
        in_photo = np.diag([grid.scale_x, grid.scale_y, 1.0]) @ K[0]
        in_photo[:2, 2] += grid.offset_x, grid.offset_y
        focals = in_photo[[0, 1], [0, 1]] / max(width, height)
        if not ((focals > SHORTEST) & (focals < LONGEST)).all():
            return None
        viewmat = np.vstack([w2c[0], [0.0, 0.0, 0.0, 1.0]])
        confidence = np.where(usable(photo, grid), confidence, np.float32(NO_CONFIDENCE))
        return AlignedPhoto(Camera(viewmat, in_photo, width, height), grid, depth, confidence)


def resamplings_of(photos: Sequence[Photo]) -> list[Resampling]:
    """How the photos of a scene come to the sizes that the network sees.

    Photos whose size differs from the commonest by a patch at most are brought to that: photos of
    almost one aspect look to the network like those it was trained with, all of one size.

    Args:
        photos: of any sizes.

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
    sizes = Counter((one.width, one.height) for one in resamplings)
    (width, height), _ = sizes.most_common(1)[0]
    return [
        one.resized(width, height)
        if max(abs(one.width - width), abs(one.height - height)) <= PATCH
        else one
        for one in resamplings
    ]


def memory_of_pass(config: NetworkConfig, photos: int, pixels: int) -> int:
    """Bytes that a pass takes beyond the weights, at most.

    Args:
        config: sizes of the network.
        photos: of the pass.
        pixels: of the largest photo, as the network sees it.
    """
    tokens = pixels // PATCH**2 + 1
    backbone = photos * tokens * config.embed_dim * PER_TOKEN
    results = photos * pixels * 5
    return 4 * (backbone + results + PER_PIXEL * config.features * pixels)
