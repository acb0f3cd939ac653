"""Photos and cameras in COLMAP's database, by numbers that do not depend on threads."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from igsr.capture.photo_folder import Photo

#: Where nothing is known: the focal length over the longer side; 42 degrees, COLMAP's own.
GUESSED_FOCAL = 1.2


def photo_file(index: int) -> str:
    """The name of a photo in COLMAP's database: COLMAP is never given the users' file names."""
    return f"{index:06d}.png"


def image_id(index: int) -> int:
    """The number of a photo in COLMAP's database."""
    return index + 1


def list_photos(photos: Sequence[Photo], database: Path) -> None:
    """Number photos and cameras in the database.

    Left to feature extraction, they are numbered as its threads end, and nothing after comes out
    the same twice.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        for number, group in enumerate(_groups(photos), start=1):
            first = photos[group[0]]
            height, width = first.image.shape[:2]
            focal = first.focal if first.focal is not None else GUESSED_FOCAL * max(width, height)
            camera = pycolmap.Camera.create_from_model_name(
                number, "SIMPLE_RADIAL", focal, width, height
            )
            camera.has_prior_focal_length = first.focal is not None
            opened.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=number)
            rig.add_ref_sensor(camera.sensor_id)
            opened.write_rig(rig, use_rig_id=True)
            for index in group:
                image = pycolmap.Image(
                    name=photo_file(index), camera_id=number, image_id=image_id(index)
                )
                opened.write_image(image, use_image_id=True)
                frame = pycolmap.Frame(frame_id=image_id(index), rig_id=number)
                frame.add_data_id(image.data_id)
                opened.write_frame(frame, use_frame_id=True)


def _groups(photos: Sequence[Photo]) -> list[list[int]]:
    """Indices of photos that share their intrinsics."""
    groups: dict[object, list[int]] = {}
    for index, photo in enumerate(photos):
        key = (photo.device, photo.image.shape[:2], photo.focal)
        groups.setdefault(key, []).append(index)
    return list(groups.values())
