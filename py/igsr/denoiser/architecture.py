"""Settings of a denoiser's network. Free of torch, so that a command line can show its defaults."""

from __future__ import annotations

from dataclasses import dataclass

from igsr.errors import IgsrError

#: Pictures are padded to multiples of this: one step of pixel shuffle and two of the U-Net.
MULTIPLE = 8
MAX_WIDTH = 256
MAX_BLOCKS = 32
#: Ways to combine the photos.
PHOTO_MODES = ("concatenated", "attention", "none")


@dataclass(frozen=True)
class Architecture:
    """Settings of a network, stored in its file of weights.

    Attributes:
        width: channels at half resolution; doubled at each lower resolution.
        blocks: number of blocks at 1/2 (each way), 1/4 (each way) and 1/8 of the resolution.
        residual: whether to add the output to a mean of the render and the warped photos, weighted
            per pixel by predicted weights. False takes the output as the picture.
        buffers: whether to use the rasterizer's buffers.
        photos: "concatenated", "attention" (over the photos of each pixel, without a fixed order)
            or "none", which uses only the render and the background.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    width: int = 32
    blocks: tuple[int, int, int] = (2, 2, 4)
    residual: bool = True
    buffers: bool = True
    photos: str = "concatenated"

    def __post_init__(self) -> None:
        if self.photos not in PHOTO_MODES:
            raise IgsrError(f"photos must be one of {', '.join(PHOTO_MODES)}, not {self.photos!r}.")
        if type(self.width) is not int or self.width % 2 or not 2 <= self.width <= MAX_WIDTH:
            raise IgsrError(f"width must be even, from 2 to {MAX_WIDTH}, not {self.width!r}.")
        counts = [type(count) is int and 0 <= count <= MAX_BLOCKS for count in self.blocks]
        if len(counts) != 3 or not all(counts):
            raise IgsrError(f"blocks must be three from 0 to {MAX_BLOCKS}, not {self.blocks!r}.")
        for name in ("residual", "buffers"):
            if type(getattr(self, name)) is not bool:
                raise IgsrError(f"{name} must be True or False, not {getattr(self, name)!r}.")
