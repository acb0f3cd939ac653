"""Write pictures as a video file."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr.capture.photo_files import OWN_TAG
from igsr.errors import IgsrError


def write_video(path: Path, frames: Iterable[npt.NDArray[np.uint8]], fps: int = 30) -> None:
    """Write frames, uint8 [H, W, 3], as H.264, or as MPEG-4 if H.264 is not available.

    The suffix of ``path`` sets the container. An odd last column or row is dropped, since 4:2:0
    video needs even sizes.
    """
    import av

    try:
        codec = av.codec.Codec("libx264", "w").name
    except (ValueError, av.error.FFmpegError):
        codec = "mpeg4"
    try:
        with atomic_write(path) as temporary, av.open(str(temporary), mode="w") as container:
            container.metadata["comment"] = OWN_TAG
            stream: av.VideoStream | None = None
            for frame in frames:
                height, width = (size - size % 2 for size in frame.shape[:2])
                if stream is None:
                    if min(height, width) < 2:
                        raise IgsrError("A video needs pictures of at least 2 x 2 pixels.")
                    stream = cast(av.VideoStream, container.add_stream(codec, rate=Fraction(fps)))
                    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                    # Visually lossless.
                    stream.options = {"crf": "16"} if codec == "libx264" else {"qscale": "2"}
                cropped = np.ascontiguousarray(frame[:height, :width])
                picture = av.VideoFrame.from_ndarray(cropped, format="rgb24")
                container.mux(stream.encode(picture))
            if stream is None:
                raise IgsrError("A video needs at least one frame.")
            container.mux(stream.encode())
    except av.error.FFmpegError as error:
        raise IgsrError(f"Cannot write the video {path}: {error.strerror or error}.") from error
    except ValueError as error:
        if isinstance(error, IgsrError):
            raise
        raise IgsrError(f"Cannot write the video {path}: {error}; name it .mp4.") from error
