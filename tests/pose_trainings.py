"""What a training of a pose network needs, made without Mitsuba: photos of rooms as captures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import rooms
from PIL import Image

from igsr.capture import View
from igsr.pose.da3.training.training_settings import PoseTraining
from igsr.synth import RECIPE_VERSION, CaptureSettings, scene_name

#: As small as a training may be.
SMALL = PoseTraining(
    steps=4, batch=2, photos=3, resolution=28, captures=2, validation=1, views=4, rate=1e-3
)
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def views(count: int = 4, seed: int = 0, width: int = 28, height: int = 28) -> list[View]:
    """Photos of a room with depth; the last column shows nothing."""
    made = []
    for number in range(count):
        angle = 0.25 * (number - count / 2) + 0.05 * seed
        camera = rooms.camera(angle, 0.9 * width, width, height)
        image, depth = rooms.picture(camera, seed), rooms.depth(camera)
        depth[:, -1] = 0.0
        made.append(View(f"{number}.png", camera, "train", image, depth=depth))
    return made


def write_captures(folder: Path, training: PoseTraining = SMALL) -> Path:
    """All captures of a training, as ``igsr synth`` leaves them."""
    settings = CaptureSettings(training.resolution, training.views, 0, training.spp)
    for index in range(training.validation + training.captures):
        at = folder / scene_name(index)
        (at / "train").mkdir(parents=True)
        frames = []
        for view in views(training.views, index, training.resolution, training.resolution):
            name = view.name.removesuffix(".png")
            Image.fromarray(view.image).save(at / "train" / view.name)
            np.save(at / "train" / f"{name}.npy", np.where(view.depth > 0, view.depth, np.nan))
            camera = view.camera
            frames.append(
                {
                    "file_path": f"./train/{name}",
                    "depth_file_path": f"./train/{name}.npy",
                    "w": camera.width,
                    "h": camera.height,
                    "fl_x": camera.K[0, 0],
                    "fl_y": camera.K[1, 1],
                    "cx": camera.K[0, 2],
                    "cy": camera.K[1, 2],
                    "transform_matrix": (np.linalg.inv(camera.viewmat) @ OPENGL).tolist(),
                }
            )
        (at / "transforms_train.json").write_text(json.dumps({"frames": frames}))
        recipe = {
            "version": RECIPE_VERSION, "seed": training.seed, "index": index, **vars(settings),
        }  # fmt: skip
        scene = {"family": "surroundings", "kind": "room", "contents": [], "recipe": recipe}
        (at / "scene.json").write_text(json.dumps(scene))
    return folder
