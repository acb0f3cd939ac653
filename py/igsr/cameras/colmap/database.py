"""Photos and cameras in COLMAP's database, with fixed ids."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.load_pycolmap import load_pycolmap
from igsr.capture.downscaling import resized_camera
from igsr.capture.photo_folder import Photo

#: Default focal length in units of the longer side (COLMAP's own; 45 degrees).
DEFAULT_FOCAL = 1.2


def photo_file(index: int) -> str:
    """The name of a photo in COLMAP's database."""
    return f"{index:06d}.png"


def image_id(index: int) -> int:
    """The id of a photo in COLMAP's database."""
    return index + 1


def list_photos(photos: Sequence[Photo], database: Path) -> None:
    """Write photos and cameras to the database; views of a panorama are a rig.

    Feature extraction would number them in the order in which its threads end.
    """
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        number = 0
        for rig, group in enumerate(_groups(photos), start=1):
            first = group[0]
            numbers = []
            for index in first:
                number += 1
                opened.write_camera(_camera(photos[index], number), use_camera_id=True)
                numbers.append(number)
            opened.write_rig(_rig(rig, [photos[k] for k in first], numbers), use_rig_id=True)
            for members in group:
                frame = pycolmap.Frame(frame_id=image_id(members[0]), rig_id=rig)
                for index, camera in zip(members, numbers, strict=True):
                    image = pycolmap.Image(
                        name=photo_file(index), camera_id=camera, image_id=image_id(index)
                    )
                    opened.write_image(image, use_image_id=True)
                    frame.add_data_id(image.data_id)
                opened.write_frame(frame, use_frame_id=True)


def _camera(photo: Photo, number: int) -> Any:
    pycolmap = load_pycolmap()
    height, width = photo.image.shape[:2]
    focal = photo.focal if photo.focal is not None else DEFAULT_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(number, "SIMPLE_RADIAL", focal, width, height)
    camera.has_prior_focal_length = photo.focal is not None
    if photo.place is not None:
        K = resized_camera(photo.place.camera, width, height).K
        camera.params = [K[0, 0], K[0, 2], K[1, 2], 0.0]
    return camera


def _rig(number: int, photos: Sequence[Photo], cameras: Sequence[int]) -> Any:
    """A rig of one camera, or of the views of a panorama."""
    pycolmap = load_pycolmap()
    rig = pycolmap.Rig(rig_id=number)
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera) for camera in cameras]
    rig.add_ref_sensor(sensors[0])
    rotations = [photo.place.camera.viewmat[:3, :3] for photo in photos if photo.place is not None]
    for rotation, sensor in zip(rotations[1:], sensors[1:], strict=True):
        relative = pycolmap.Rotation3d(rotation @ rotations[0].T)
        rig.add_sensor(sensor, pycolmap.Rigid3d(relative, np.zeros(3)))
    return rig


def known_cameras(database: Path) -> set[int]:
    """Ids of the cameras of panoramas' views, whose intrinsics are exact."""
    pycolmap = load_pycolmap()
    with pycolmap.Database.open(database) as opened:
        rigs = opened.read_all_rigs()
    return {int(sensor.id) for rig in rigs if rig.num_sensors() > 1 for sensor in rig.sensor_ids()}


def _groups(photos: Sequence[Photo]) -> list[list[list[int]]]:
    """Indices of photos with the same intrinsics, in groups of one rig."""
    rigs: dict[object, list[int]] = {}
    for index, photo in enumerate(photos):
        rigs.setdefault(index if photo.place is None else photo.place.rig, []).append(index)
    groups: dict[object, list[list[int]]] = {}
    for members in rigs.values():
        key = tuple(
            (photo.device, photo.image.shape[:2], photo.focal, photo.place and photo.place.camera)
            for photo in (photos[index] for index in members)
        )
        groups.setdefault(key, []).append(members)
    return list(groups.values())
