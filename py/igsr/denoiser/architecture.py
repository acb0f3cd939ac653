"""Settings of a denoiser's network. Free of torch, so that a command line can show its defaults."""

from __future__ import annotations

from dataclasses import dataclass

from igsr.errors import IgsrError

#: Pictures are padded to multiples of this: one step of pixel shuffle and two of the U-Net.
MULTIPLE = 8
MAX_WIDTH = 256
MAX_BLOCKS = 32


@dataclass(frozen=True)
class Architecture:
    """Settings of a network, stored in its file of weights.

    Attributes:
        width: channels at half resolution; doubled at each lower resolution.
        blocks: number of blocks at 1/2 (each way), 1/4 (each way) and 1/8 of the resolution.

    Raises:
        IgsrError: a setting cannot be used; the message names it.
    """

    width: int = 32
    blocks: tuple[int, int, int] = (2, 2, 4)

    def __post_init__(self) -> None:
        if type(self.width) is not int or self.width % 2 or not 2 <= self.width <= MAX_WIDTH:
            raise IgsrError(f"width must be even, from 2 to {MAX_WIDTH}, not {self.width!r}.")
        counts = [type(count) is int and 0 <= count <= MAX_BLOCKS for count in self.blocks]
        if len(counts) != 3 or not all(counts):
            raise IgsrError(f"blocks must be three from 0 to {MAX_BLOCKS}, not {self.blocks!r}.")
