"""Photos from a video: its sharpest frames, evenly spaced."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.errors import IgsrError

UInt8 = npt.NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi")
#: Longer side, in pixels, of the reduced frame whose sharpness is measured: noise and codec blocks
#: are finer than its pixels.
_JUDGED = 480


def sharpest_frames(path: Path, count: int) -> list[tuple[int, UInt8]]:
    """The sharpest frame of each of ``count`` equal spans of a video.

    Only the middle half of a span counts, so two frames are at least half a span apart. Sharpness
    is the variance of the Laplacian (Pech-Pacheco et al., ICPR 2000), which motion blur and
    defocus lower.

    Args:
        path: the video.
        count: number of frames, at least 1; a video with fewer frames gives all. A damaged video
            gives those of its readable part.

    Returns:
        (index in the video, uint8 [H, W, 3] RGB, upright), in order.

    Raises:
        IgsrError: the file cannot be read as a video.
    """
    length = _frame_count(path)
    spans = min(count, length)
    frames: list[tuple[int, UInt8]] = []
    best: tuple[float, int, Any] | None = None
    in_span = -1
    for index, frame in enumerate(_decoded(path)):
        place = (index + 0.5) * spans / length
        span = int(place)
        # The middle half of a span of a frame or two may hold no frame.
        if span >= spans or (length >= 4 * spans and abs(place - span - 0.5) > 0.25):
            continue
        if span != in_span and best is not None:
            frames.append((best[1], _pixels(best[2])))
            best = None
        in_span = span
        sharpness = _sharpness(frame)
        if best is None or sharpness > best[0]:
            best = (sharpness, index, frame)
    if best is not None:
        frames.append((best[1], _pixels(best[2])))
    if not frames:
        raise IgsrError(f"{path} has no frame that can be read; copy it again")
    return frames


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


def _frame_count(path: Path) -> int:
    """The number of frames that the file lists, without decoding any."""
    import av

    try:
        with av.open(str(path)) as container:
            count = sum(packet.size > 0 for packet in container.demux(container.streams.video[0]))
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise IgsrError(f"{path} cannot be read as a video; save it as MP4 again") from error
    if count == 0:
        raise IgsrError(f"{path} has no frame that can be read; copy it again")
    return count


def _decoded(path: Path) -> Iterator[Any]:
    """The frames in order, up to the first damaged one."""
    import av

    try:
        with av.open(str(path)) as container:
            container.streams.video[0].thread_type = "AUTO"
            yield from container.decode(video=0)
    except av.FFmpegError:
        return


def _sharpness(frame: Any) -> float:
    reduced = max(1.0, max(frame.width, frame.height) / _JUDGED)
    width, height = (max(3, round(side / reduced)) for side in (frame.width, frame.height))
    grey = frame.reformat(width=width, height=height, format="gray").to_ndarray()
    grey = grey.astype(np.int32)
    inner = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * inner
    return float(laplacian.var())


def _pixels(frame: Any) -> UInt8:
    pixels = frame.to_ndarray(format="rgb24")
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90.0)))
