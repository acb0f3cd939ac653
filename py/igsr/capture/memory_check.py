"""Whether photos fit into memory, estimated from their sizes before any is decoded.

The constants are the bytes of the arrays that a load and a fit on the CPU hold; they were checked
against the memory of real runs.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from igsr._internal.available_memory import available_memory
from igsr.capture.downscaling import reduced_size
from igsr.errors import IgsrError

#: Per pixel of a photo that is decoded: Pillow's four bytes, copies, and memory that the allocator
#: keeps between photos (17 in total, measured on JPEGs of 12 megapixels).
DECODED_BYTES = 18
#: Per pixel of the largest photo during undistortion: the map, and the padded photo.
UNDISTORTED_BYTES = 24
#: Per pixel of the largest photo during a fit: render, photo, loss and gradients.
FITTED_BYTES = 110
#: Per pixel of the largest photo while it is scored: planes of SSIM, colors and edges of FLIP.
SCORED_BYTES = 740
#: Per splat at degree 3: parameters, two moments, gradients, statistics and entries in tiles (1850
#: in total), and copies for checkpoints and results.
SPLAT_BYTES = 3500
#: Of a fit of any size: libraries, and scratch memory of threads.
LIBRARY_BYTES = 650_000_000
#: Part of the available memory that photos may take.
USABLE_PART = 0.9
#: More threads only wait for the disk.
MAX_THREADS = 16
#: Suggested values of --max-size are multiples of this.
SIZE_STEP_PX = 50


@dataclass(frozen=True, kw_only=True)
class PhotoSizes:
    """Photos before they are decoded, and the memory that they need.

    Attributes:
        sizes: width and height in pixels of each photo as stored. Panoramas count as several
            photos, one per view, and videos as the largest number of frames that may be taken.
        channels: 3, or 4 if any photo has alpha.
        masked: whether photos have masks or lens distortion.
        depths: whether photos have depths.
        decoded: width and height in pixels of the files; empty if these are ``sizes``.
        views: number of ``sizes`` of each photo, sorted by name; empty if each is one view.
        plain: files that are one photo without a mask each.
    """

    sizes: list[tuple[int, int]]
    channels: int = 3
    masked: bool = False
    depths: bool = False
    decoded: list[tuple[int, int]] = field(default_factory=list)
    views: list[int] = field(default_factory=list)
    plain: list[Path] = field(default_factory=list)

    def needed_memory(self, max_size: int | None = None, splats: int | None = None) -> int:
        """Return the largest number of bytes that the photos take at one time.

        Args:
            max_size: longest side in pixels of photos as loaded; None keeps them as they are.
            splats: maximum number of splats of a fit to these photos; None if they are only loaded.
        """
        reduced = [reduced_size(width, height, max_size) for width, height in self.sizes]
        pixels = sum(width * height for width, height in reduced)
        largest = _largest_area(reduced)
        held = pixels * (self.channels + self.masked + 4 * self.depths)
        undistorted = UNDISTORTED_BYTES * largest if self.masked else 0
        loading = held + DECODED_BYTES * self._largest_file + undistorted
        if splats is None:
            return loading
        # A mask becomes float32 weights; depths are stacked with their confidence, and copied.
        copied = pixels * (self.channels + 4 * self.masked + 16 * self.depths)
        fitting = held + copied + FITTED_BYTES * largest + SPLAT_BYTES * splats
        scoring = held + SCORED_BYTES * largest
        return LIBRARY_BYTES + max(loading, fitting, scoring)

    def largest_size_that_fits(
        self, splats: int | None = None, available: int | None = None
    ) -> int | None:
        """Return the longest side in pixels at which photos fit into memory; None if none does."""
        usable = USABLE_PART * (available_memory() if available is None else available)
        longest = max((max(size) for size in self.sizes), default=1)
        if self.needed_memory(longest, splats) <= usable:
            return longest
        fits, too_large = 0, longest // SIZE_STEP_PX + 1  # in steps
        while too_large - fits > 1:
            middle = (fits + too_large) // 2
            is_enough = self.needed_memory(middle * SIZE_STEP_PX, splats) <= usable
            fits, too_large = (middle, too_large) if is_enough else (fits, middle)
        return fits * SIZE_STEP_PX or None

    def check_memory(self, max_size: int | None = None, splats: int | None = None) -> None:
        """Raise an IgsrError, with the size that fits, if the photos do not fit into memory."""
        available = available_memory()
        needed = self.needed_memory(max_size, splats)
        if needed <= USABLE_PART * available:
            return
        width, height = max(self.sizes, key=lambda size: size[0] * size[1])
        count = f"{len(self.sizes)} photos" if len(self.sizes) > 1 else "photo"
        up_to = "" if len(set(self.sizes)) == 1 else "up to "
        is_reduced = max_size is not None and max_size < max(width, height)
        at = f" at --max-size {max_size}" if is_reduced else ""
        problem = (
            f"The {count} of {up_to}{width}x{height}{at} would need {_gigabytes(needed)} "
            f"and {_gigabytes(available)} are free"
        )
        size = self.largest_size_that_fits(splats, available)
        if size is None:
            raise IgsrError(
                f"{problem}: give fewer photos, or free memory; no --max-size would do."
            )
        at_size = _gigabytes(self.needed_memory(size, splats))
        raise IgsrError(f"{problem}: give --max-size {size} ({at_size}).")

    def decoding_threads(self, max_size: int | None = None) -> int:
        """Return the number of photos that memory allows to decode at once, at least one."""
        alone = replace(self, masked=True, depths=False).needed_memory(max_size)
        left = USABLE_PART * available_memory() - alone
        more = int(max(0.0, left) / (DECODED_BYTES * max(1, self._largest_file)))
        return min(1 + more, os.cpu_count() or 1, MAX_THREADS)

    @property
    def _largest_file(self) -> int:
        return _largest_area(self.decoded or self.sizes)


def _largest_area(sizes: Sequence[tuple[int, int]]) -> int:
    return max((width * height for width, height in sizes), default=0)


def _gigabytes(count: float) -> str:
    return f"{count / 1e9:.1f} GB"
