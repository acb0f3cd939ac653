"""Cameras that a caller gives for photos whose other cameras are to be found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from igsr.capture import Camera
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError


def check_given_cameras(cameras: Mapping[str, Camera], photos: Sequence[Photo]) -> None:
    """Refuse cameras of no photo, and of another size than their photo's.

    Raises:
        IgsrError: as said.
    """
    sizes = {photo.name: photo.image.shape[:2] for photo in photos}
    for name, camera in cameras.items():
        if name not in sizes:
            raise IgsrError(f"cameras has {name!r}, but no photo has this name")
        if sizes[name] != (camera.height, camera.width):
            height, width = sizes[name]
            raise IgsrError(
                f"the camera for {name} has {camera.width} x {camera.height} pixels, but the photo "
                f"has {width} x {height}; scale the intrinsics"
            )
