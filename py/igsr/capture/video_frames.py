"""Choose frames of a video as photos: evenly spaced along the camera's path, and sharp."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr._internal.input_files import open_file
from igsr.errors import IgsrError

UInt8 = npt.NDArray[np.uint8]
Float64 = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
#: Transfer characteristics of HDR video, by their number in ISO/IEC 23091-2.
HDR = {16: "PQ", 18: "HLG"}
#: Longer side of the reduced frame whose sharpness is measured: noise and codec blocks are finer
#: than its pixels.
_SHARPNESS_SIDE_PX = 480
#: Minimum number of frames taken, if the video has as many.
MIN_FRAMES = 12
#: A shorter path, in steps, counts as a still video.
_STILL_STEPS = 1.0

#: Longer side of the gray frames that are compared.
MOTION_SIDE_PX = 240
#: Side and spacing of the blocks in which motion is measured.
_BLOCK_PX = 64
_SPACING_PX = 32
#: Length of a step of the path: mean motion of the blocks, as a part of the longer side.
STEP_PART = 0.05
#: Steps after which the frame to compare with is replaced: motion stays under a fifth of a block.
_KEY_STEPS = 0.8
#: A block with less contrast (standard deviation, of 255) shows no motion.
_MIN_CONTRAST = 3.0
#: A lower peak of the phase correlation may be chance (of 64 x 64 values of standard deviation
#: 1/64, the largest is about 0.06): the block shows something else.
_MIN_PEAK = 0.1


def sharpest_frames(path: Path, max_frames: int) -> list[tuple[int, UInt8]]:
    """Choose frames of a video by the camera's path and by their sharpness.

    The path is how far the picture moves (``CameraPath``). It is divided into equal spans of at
    most a step, and the sharpest frame in the middle half of each is taken: a slow pan gives as
    many frames as a fast one, a stop gives one. Sharpness is the variance of the Laplacian
    (Pech-Pacheco et al., ICPR 2000), which motion blur and defocus lower. A still video is divided
    by time. Of a damaged video, the readable part counts.

    Returns:
        (index in the video, uint8 [H, W, 3] RGB, upright), in order; at most ``max_frames``.

    Raises:
        IgsrError: the file cannot be read as a video, or is HDR.
    """
    camera_path = CameraPath()
    places: list[float] = []
    sharpness: list[float] = []
    size = (0, 0)
    for frame in _frames(path):
        if not places:
            _refuse_hdr(path, frame)
            size = _reduced_size(frame, MOTION_SIDE_PX, _BLOCK_PX)
        places.append(camera_path.add(_gray(frame, size)))
        sharpness.append(_sharpness(frame))
    if not places:
        raise IgsrError(f"{path} has no frame that can be read; copy it again")
    chosen = set(evenly_sharp(np.array(places), np.array(sharpness), max_frames))
    frames = zip(range(max(chosen) + 1), _frames(path), strict=False)
    return [(index, _pixels(frame)) for index, frame in frames if index in chosen]


def evenly_sharp(places: Float64, sharpness: Float64, max_frames: int) -> list[int]:
    """Choose the sharpest frame in the middle half of each of equal spans of the path.

    There is a span per step of the path, but at least ``MIN_FRAMES`` and at most ``max_frames``.

    Args:
        places: [F], length of the path up to each frame, in steps; never decreases.
        sharpness: [F].
        max_frames: maximum number of frames, at least 1.

    Returns:
        Indices of frames, rising.
    """
    count, length = len(places), float(places[-1] - places[0])
    spans = min(max_frames, max(MIN_FRAMES, math.ceil(length)))
    along = (places - places[0]) / max(length, _STILL_STEPS)
    if length < _STILL_STEPS:
        spans, along = min(spans, count), (np.arange(count) + 0.5) / count
    span_of = np.minimum((along * spans).astype(int), spans - 1)
    from_middle = np.abs(along * spans - span_of - 0.5)
    chosen = []
    for span in range(spans):
        inside = np.flatnonzero(span_of == span)
        # A fast part of the path may have no frame in the middle half of a span, or none in it.
        middle = inside[from_middle[inside] <= 0.25]
        candidates = middle if len(middle) else inside
        if len(candidates):
            chosen.append(int(candidates[np.argmax(sharpness[candidates])]))
    return chosen


def video_size(path: Path) -> tuple[tuple[int, int], int]:
    """Read width and height in pixels of a video's frames, and their number (0 if unknown).

    Only the header is read. An unreadable video is an IgsrError.
    """
    with _opened(path) as container:
        stream = container.streams.video[0]
        return (int(stream.width), int(stream.height)), max(0, int(stream.frames))


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import av

    try:
        open_file(path).close()
        with av.open(str(path)) as container:
            yield container
    except (av.FFmpegError, IndexError, OSError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as a video; save it as MP4 again") from error


def _frames(path: Path) -> Iterator[Any]:
    """The frames in order, up to the first damaged one."""
    import av

    with _opened(path) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        frames = container.decode(stream)
        while True:
            try:
                frame = next(frames)
            except (StopIteration, av.FFmpegError):
                return
            yield frame


def _refuse_hdr(path: Path, frame: Any) -> None:
    """Raise an IgsrError for frames whose colors would be flat and pale."""
    name = HDR.get(int(frame.color_trc))
    if name is not None:
        raise IgsrError(
            f"{path} is HDR video ({name}); save it as SDR, or record with HDR video turned off"
        )


def _reduced_size(frame: Any, longest: int, shortest: int) -> tuple[int, int]:
    """Width and height of the frame reduced to ``longest`` pixels, but not below ``shortest``."""
    factor = max(1.0, max(frame.width, frame.height) / longest)
    width, height = (max(shortest, round(s / factor)) for s in (frame.width, frame.height))
    return width, height


def _gray(frame: Any, size: tuple[int, int]) -> UInt8:
    """The frame in gray, at a width and height in pixels."""
    gray: UInt8 = frame.reformat(width=size[0], height=size[1], format="gray").to_ndarray()
    return gray


def _sharpness(frame: Any) -> float:
    gray = _gray(frame, _reduced_size(frame, _SHARPNESS_SIDE_PX, 3)).astype(np.int32)
    inner = gray[1:-1, 1:-1]
    laplacian = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def _pixels(frame: Any) -> UInt8:
    pixels = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90.0)))


class CameraPath:
    """Measures how far the picture moves from frame to frame, in steps.

    Each frame is compared with a key frame most of a step back, not with the one before it, so that
    slow motion is not lost to rounding, and noise in a still picture does not add up. Two frames
    with nothing in common, as after a cut, are one step apart.
    """

    def __init__(self) -> None:
        self._key: list[Complex | None] = []
        self._at_key = self._at = 0.0

    def add(self, gray: UInt8) -> float:
        """Add the next frame, uint8 [H, W] in gray, of at least 64 pixels each way.

        Returns:
            Length of the path up to it, in steps; it never decreases.
        """
        blocks = _spectra(gray)
        if not self._key:
            self._key = blocks
            return 0.0
        moved = _motion(self._key, blocks) / (STEP_PART * max(gray.shape))
        self._at = max(self._at, self._at_key + moved)
        if moved >= _KEY_STEPS:
            self._key, self._at_key = blocks, self._at
        return self._at


def _spectra(gray: UInt8) -> list[Complex | None]:
    """The Fourier transform of each block under a Hann window; None without contrast."""
    window = np.outer(np.hanning(_BLOCK_PX), np.hanning(_BLOCK_PX))
    tops, lefts = (_block_starts(length) for length in gray.shape)
    spectra: list[Complex | None] = []
    for top in tops:
        for left in lefts:
            block = gray[top : top + _BLOCK_PX, left : left + _BLOCK_PX].astype(np.float64)
            has_contrast = block.std() >= _MIN_CONTRAST
            spectra.append(np.fft.rfft2((block - block.mean()) * window) if has_contrast else None)
    return spectra


def _block_starts(length: int) -> list[int]:
    """First pixels of evenly spaced blocks that cover both edges."""
    count = 1 + -(-(length - _BLOCK_PX) // _SPACING_PX)
    return [int(start) for start in np.linspace(0, length - _BLOCK_PX, count).round()]


def _motion(key: list[Complex | None], now: list[Complex | None]) -> float:
    """Mean motion of blocks in pixels, by phase correlation (Kuglin, Hines 1975).

    If at least half of the blocks with contrast lost their content, it is one step; 0 if no block
    has contrast.
    """
    distances, lost = [], 0
    for before, after in zip(key, now, strict=True):
        if before is None and after is None:
            continue
        if before is None or after is None:
            lost += 1
            continue
        product = after * before.conj()
        shape = (_BLOCK_PX, _BLOCK_PX)
        surface = np.fft.irfft2(product / np.maximum(np.abs(product), 1e-9), s=shape)
        peak = int(surface.argmax())
        if surface.flat[peak] < _MIN_PEAK:
            lost += 1
            continue
        offsets = [min(place, _BLOCK_PX - place) for place in divmod(peak, _BLOCK_PX)]
        distances.append(float(np.hypot(offsets[0], offsets[1])))
    if not distances and not lost:
        return 0.0
    if lost >= len(distances):
        return STEP_PART * MOTION_SIDE_PX
    return float(np.mean(distances))
