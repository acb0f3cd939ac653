"""Photos as DUSt3R was trained to see them, and the way back to their pixels.

Wang et al., CVPR 2024, section 4, and the published models' inference: the longer side is brought
to the model's size and what is not a multiple of a patch is cut off all round.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.pose.dust3r.heads import PATCH
from igsr.pose.grid import Grid
from igsr.pose.photo_samples import over_white

Float32 = npt.NDArray[np.float32]

#: Image size of the model that was trained on squares alone.
SQUARE = 224


@dataclass(frozen=True)
class Crop:
    """The part of a resized photo that the network is given.

    Attributes:
        photo_width, photo_height: pixels of the photo.
        resized_width, resized_height: pixels that the photo is resized to.
        left, top: where the part begins, pixels of the resized photo.
        width, height: of the part, multiples of 16.
    """

    photo_width: int
    photo_height: int
    resized_width: int
    resized_height: int
    left: int
    top: int
    width: int
    height: int

    def grid(self, columns: range, rows: range) -> Grid:
        """How the network's pixels of these columns and rows lie in the photo."""
        scale_x = self.photo_width / self.resized_width
        scale_y = self.photo_height / self.resized_height
        # Where the sample in column 0 has its centre, 0.5, is the centre of the first of columns.
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
    """What a model of an image size sees of a photo.

    Args:
        photo: any photo.
        image_size: pixels; 224 takes a central square, others bring the longer side to it and cut
            square photos to 4:3.

    Raises:
        IgsrError: the image is no photo, or so narrow that its shorter side is less than a patch.
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
            f"{list(image.shape[:2])}, the photo's"
        )
    height, width = image.shape[:2]
    longer, shorter = max(width, height), min(width, height)
    if shorter * image_size < PATCH * longer:
        raise IgsrError(
            f"{photo.name} is {width}x{height} pixels, too narrow for DUSt3R; crop it or leave it "
            "out"
        )
    side = round(image_size * longer / shorter) if image_size == SQUARE else image_size
    resized_width, resized_height = round(width * side / longer), round(height * side / longer)
    half_width, half_height = resized_width // 2, resized_height // 2
    left, top = half_width, half_height
    if image_size == SQUARE:
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
    """The pixels [3, h, w] of a crop in [-1, 1]; what is transparent is white."""
    image = Image.fromarray(over_white(photo.image))
    # Resampling is that of the models' training: it shows in the predictions.
    shrinks = max(crop.photo_width, crop.photo_height) > max(
        crop.resized_width, crop.resized_height
    )
    filtered = Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC
    resized = np.asarray(image.resize((crop.resized_width, crop.resized_height), filtered))
    part = resized[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    values = part.transpose(2, 0, 1).astype(np.float32) / np.float32(255.0)
    return (values - np.float32(0.5)) / np.float32(0.5)
