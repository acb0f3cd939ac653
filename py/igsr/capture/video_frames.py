"""Photos from a video: as many frames as its path needs, evenly spaced, and sharp."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.capture.video_motion import BLOCK, SIDE, CameraPath
from igsr.errors import IgsrError

UInt8 = npt.NDArray[np.uint8]
Float64 = npt.NDArray[np.float64]

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
#: Longer side, in pixels, of the reduced frame whose sharpness is measured: noise and codec blocks
#: are finer than its pixels.
_JUDGED = 480
#: Fewest frames of a video that has as many, and the path in steps below which it stands still.
FEWEST, STILL = 12, 1.0
#: Transfer characteristics of HDR video, by their number in ISO/IEC 23091-2.
HDR = {16: "PQ", 18: "HLG"}


def sharpest_frames(path: Path, most: int) -> list[tuple[int, UInt8]]:
    """As many frames of a video as its path needs, evenly spaced along it, and sharp.

    The path is how far the picture moves (``igsr.capture.video_motion``). It is divided into equal
    spans of at most a step, and the sharpest frame in the middle half of each is taken: a slow pan
    gives as many frames as a fast one, a stop gives one. Sharpness is the variance of the Laplacian
    (Pech-Pacheco et al., ICPR 2000), which motion blur and defocus lower. A video that does not
    move is divided by time.

    Args:
        path: the video.
        most: most frames, at least 1. A damaged video gives those of its readable part.

    Returns:
        (index in the video, uint8 [H, W, 3] RGB, upright), in order.

    Raises:
        IgsrError: the file cannot be read as a video, or is HDR.
    """
    camera_path = CameraPath()
    places: list[float] = []
    sharpness: list[float] = []
    size = (0, 0)
    for frame in _decoded(path):
        if not places:
            _refuse_hdr(path, frame)
            size = _reduced(frame, SIDE, BLOCK)
        places.append(camera_path.add(_gray(frame, size)))
        sharpness.append(_sharpness(frame))
    if not places:
        raise IgsrError(f"{path} has no frame that can be read; copy it again")
    chosen = set(evenly_sharp(np.array(places), np.array(sharpness), most))
    decoded = zip(range(max(chosen) + 1), _decoded(path), strict=False)
    return [(index, _pixels(frame)) for index, frame in decoded if index in chosen]


def evenly_sharp(places: Float64, sharpness: Float64, most: int) -> list[int]:
    """Frames to take: the sharpest in the middle half of each of equal spans of the path.

    Args:
        places: [F], length of the path up to each frame, in steps; does not fall.
        sharpness: [F].
        most: most frames, at least 1.

    Returns:
        Indices of frames, rising: one for each step of the path, but of at least ``FEWEST`` spans.
    """
    count, length = len(places), float(places[-1] - places[0])
    spans = min(most, max(FEWEST, math.ceil(length)))
    along = (places - places[0]) / max(length, STILL)
    if length < STILL:
        spans, along = min(spans, count), (np.arange(count) + 0.5) / count
    span = np.minimum((along * spans).astype(int), spans - 1)
    off = np.abs(along * spans - span - 0.5)
    chosen = []
    for one in range(spans):
        inside = np.flatnonzero(span == one)
        # A fast part of the path may have no frame in the middle half of a span, or none in it.
        middle = inside[off[inside] <= 0.25]
        if len(middle):
            inside = middle
        if len(inside):
            chosen.append(int(inside[np.argmax(sharpness[inside])]))
    return chosen


def video_size(path: Path) -> tuple[tuple[int, int], int]:
    """Width and height of a video's frames in pixels, and their number, by its header alone.

    The number is 0 where the header does not say.

    Raises:
        IgsrError: the file cannot be read as a video.
    """
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            return (int(stream.width), int(stream.height)), max(0, int(stream.frames))
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as a video; save it as MP4 again") from error


def _decoded(path: Path) -> Iterator[Any]:
    """The frames in order, up to the first damaged one.

    Raises:
        IgsrError: the file cannot be read as a video.
    """
    import av

    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            frames = container.decode(stream)
            while True:
                try:
                    frame = next(frames)
                except (StopIteration, av.FFmpegError):
                    return
                yield frame
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as a video; save it as MP4 again") from error


def _refuse_hdr(path: Path, frame: Any) -> None:
    """Raise an IgsrError for frames whose colors would come out flat and pale."""
    name = HDR.get(int(frame.color_trc))
    if name is not None:
        raise IgsrError(
            f"{path} is HDR video ({name}); save it as SDR, or record with HDR video turned off"
        )


def _reduced(frame: Any, longest: int, shortest: int) -> tuple[int, int]:
    """Width and height of the frame reduced to ``longest`` pixels, but not below ``shortest``."""
    reduced = max(1.0, max(frame.width, frame.height) / longest)
    return (
        max(shortest, round(frame.width / reduced)),
        max(shortest, round(frame.height / reduced)),
    )


def _gray(frame: Any, size: tuple[int, int]) -> UInt8:
    """The frame in gray, at a width and height in pixels."""
    gray: UInt8 = frame.reformat(width=size[0], height=size[1], format="gray").to_ndarray()
    return gray


def _sharpness(frame: Any) -> float:
    gray = _gray(frame, _reduced(frame, _JUDGED, 3)).astype(np.int32)
    inner = gray[1:-1, 1:-1]
    laplacian = gray[:-2, 1:-1] + gray[2:, 1:-1] + gray[1:-1, :-2] + gray[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def _pixels(frame: Any) -> UInt8:
    pixels = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90.0)))
