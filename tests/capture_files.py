"""Small captures written to disk, for the tests of the readers."""

from __future__ import annotations

import json

import numpy as np
import pycolmap
import pytest
from PIL import Image

from igsr.errors import IgsrError

WIDTH, HEIGHT = 48, 32

# Parameters of every COLMAP model that igsr reads, for a 48x32 photo.
MODEL_PARAMS = {
    "SIMPLE_PINHOLE": [40.0, 23.0, 17.0],
    "PINHOLE": [40.0, 42.0, 23.0, 17.0],
    "SIMPLE_RADIAL": [40.0, 23.0, 17.0, -0.12],
    "RADIAL": [40.0, 23.0, 17.0, -0.12, 0.03],
    "OPENCV": [40.0, 42.0, 23.0, 17.0, -0.12, 0.03, 0.004, -0.006],
    "FULL_OPENCV": [40.0, 42.0, 23.0, 17.0, -0.12, 0.03, 0.004, -0.006, 0.01, 0.02, -0.01, 0.005],
    "OPENCV_FISHEYE": [30.0, 32.0, 23.0, 17.0, 0.05, -0.02, 0.01, -0.003],
    "SIMPLE_RADIAL_FISHEYE": [30.0, 23.0, 17.0, 0.05],
    "RADIAL_FISHEYE": [30.0, 23.0, 17.0, 0.05, -0.02],
    "THIN_PRISM_FISHEYE": [
        *(30.0, 32.0, 23.0, 17.0),
        *(0.05, -0.02, 0.004, -0.006, 0.01, -0.003, 0.002, -0.005),
    ],
    "SIMPLE_FISHEYE": [30.0, 23.0, 17.0],
    "FISHEYE": [30.0, 32.0, 23.0, 17.0],
}


def photo(seed=0, width=WIDTH, height=HEIGHT, channels=3):
    """uint8 [H, W, C] of noise."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (height, width, channels), dtype=np.uint8)


def save(path, pixels):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)
    return path


def random_viewmats(count, seed=0):
    """float64 [count, 4, 4], rigid."""
    rng = np.random.default_rng(seed)
    viewmats = np.tile(np.eye(4), (count, 1, 1))
    for viewmat in viewmats:
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        q = q * np.sign(np.diag(r))
        q[:, 0] *= np.sign(np.linalg.det(q))
        viewmat[:3, :3] = q
        viewmat[:3, 3] = rng.normal(size=3) * 3.0
    return viewmats


def opengl_pose(viewmat):
    """transform_matrix of a viewmat: camera to world, y up, z back."""
    return (np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def write_json(path, document):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(document))
    return path


def write_transforms(folder, count=3, frame=None, **fields):
    """Write a capture with a transforms.json and frames images/0.png, images/1.png, ...

    Args:
        frame: fields of the second frame (the first, if it is the only one).
        fields: fields of the document. A field ``...`` is left out.
    """
    viewmats = random_viewmats(count)
    for index in range(count):
        save(folder / f"images/{index}.png", photo(index))
    document = {"fl_x": 40.0, "fl_y": 42.0, "cx": 23.0, "cy": 17.0, "w": WIDTH, "h": HEIGHT}
    document["frames"] = [
        {"file_path": f"images/{index}.png", "transform_matrix": opengl_pose(viewmat)}
        for index, viewmat in enumerate(viewmats)
    ]
    for target, changes in (
        (document["frames"][min(1, count - 1)], frame or {}),
        (document, fields),
    ):
        target |= changes
        for key in [key for key, value in changes.items() if value is ...]:
            del target[key]
    write_json(folder / "transforms.json", document)
    return document


def write_colmap(folder, model="PINHOLE", *, text=False, viewmats=None, place="sparse/0"):
    """Write a capture with a COLMAP model through pycolmap: images 0.png ..., three points."""
    viewmats = random_viewmats(3) if viewmats is None else viewmats
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(7, model, 40.0, WIDTH, HEIGHT)
    if model in MODEL_PARAMS:
        camera.params = MODEL_PARAMS[model]
    reconstruction.add_camera_with_trivial_rig(camera)
    keypoints = np.array([[1.5, 2.5], [3.0, 4.0], [5.0, 6.0]])
    for index, viewmat in enumerate(viewmats):
        image = pycolmap.Image(
            name=f"{index}.png", keypoints=keypoints, camera_id=7, image_id=index + 1
        )
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(viewmat[:3, :3]), viewmat[:3, 3])
        reconstruction.add_image_with_trivial_frame(image, pose)
        save(folder / f"images/{index}.png", photo(index))
    for index in range(3):
        track = pycolmap.Track()
        for image_id in range(2, len(viewmats) + 1):
            track.add_element(image_id, index)
        color = np.array([index, 100, 255 - index], dtype=np.uint8)
        reconstruction.add_point3D(np.array([index, 0.5, -2.0]), track, color)
    (folder / place).mkdir(parents=True, exist_ok=True)
    (reconstruction.write_text if text else reconstruction.write_binary)(folder / place)
    return reconstruction


def assert_refused(words, load, *arguments, **options):
    """``load`` raises an error with these words."""
    with pytest.raises(IgsrError, match=words):
        load(*arguments, **options)


def assert_damage_is_refused(path, load, rng, count, choices):
    """Replace random bytes of a file: ``load`` reads it, or raises one printable sentence.

    Args:
        count: number of damaged files.
        choices: bytes to write; None is any.

    Returns:
        The number of refused files.
    """
    data = path.read_bytes()
    refused = 0
    for _ in range(count):
        damaged = bytearray(data)
        for _ in range(rng.randint(1, 4)):
            byte = rng.randrange(256) if choices is None else rng.choice(choices)
            damaged[rng.randrange(len(data))] = byte
        path.write_bytes(damaged)
        try:
            load()
        except IgsrError as error:
            refused += 1
            assert str(error).isprintable()
    return refused
