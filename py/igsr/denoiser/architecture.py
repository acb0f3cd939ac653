"""Which network a denoiser has. Free of torch, so that the command line can show its defaults."""

from __future__ import annotations

from dataclasses import dataclass

from igsr.errors import IgsrError

#: Pictures are padded to multiples of this: one step of pixel shuffle and two of the U-Net.
MULTIPLE = 8
#: No wider or deeper network is built.
MOST_WIDTH, MOST_BLOCKS = 256, 32
#: Ways to look at the photos.
PHOTO_WAYS = ("concatenated", "attention", "none")


@dataclass(frozen=True)
class Architecture:
    """What distinguishes one network from another; stored beside its weights.

    Attributes:
        width: channels at half resolution; twice and four times as many below.
        blocks: blocks at a half (each way), a quarter (each way) and an eighth of the resolution.
        residual: add the output to a mean of the render and the warped photos, with weights that
            are predicted for each pixel. False takes the output as the picture.
        buffers: look at the rasterizer's buffers.
        photos: "concatenated", "attention" (per pixel over the photos, in place of a fixed order)
            or "none", which leaves the background alone to choose beside the render.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    width: int = 32
    blocks: tuple[int, int, int] = (2, 2, 4)
    residual: bool = True
    buffers: bool = True
    photos: str = "concatenated"

    def __post_init__(self) -> None:
        """Check what could be mistyped."""
        if self.photos not in PHOTO_WAYS:
            raise IgsrError(f"photos must be one of {', '.join(PHOTO_WAYS)}, not {self.photos!r}.")
        if type(self.width) is not int or self.width % 2 or not 2 <= self.width <= MOST_WIDTH:
            raise IgsrError(f"width must be even, from 2 to {MOST_WIDTH}, not {self.width!r}.")
        counts = [type(count) is int and 0 <= count <= MOST_BLOCKS for count in self.blocks]
        if len(counts) != 3 or not all(counts):
            raise IgsrError(f"blocks must be three from 0 to {MOST_BLOCKS}, not {self.blocks!r}.")
        for name in ("residual", "buffers"):
            if type(getattr(self, name)) is not bool:
                raise IgsrError(f"{name} must be True or False, not {getattr(self, name)!r}.")
