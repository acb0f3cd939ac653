"""``synthesize``: synthetic captures, each a folder that appears when it is complete.

A capture has the NeRF-Synthetic layout, with intrinsics for each photo::

    scene_00007/
        transforms_train.json, transforms_test.json
        train/000.png, test/000.png         8-bit sRGB; with straight alpha for the family "object"
        depth/train/000.npy                 float32 [H, W], z along the camera's axis, NaN for none
        mask/train/000.png                  8-bit mask of the objects
        scene.json                          content of the scene, and its recipe
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from igsr._internal.atomic_write import atomic_folder, check_writable
from igsr.errors import IgsrError
from igsr_lab.resumable_jobs import execute
from igsr_lab.synth.cameras import Viewpoint, draw_rig
from igsr_lab.synth.mitsuba_scene import (
    LoadedScene,
    encode,
    first_hits,
    load_scene,
    one_threaded_mitsuba,
    take_photo,
)
from igsr_lab.synth.photographs import choose_viewpoints, exposure, viewpoints_at_angle
from igsr_lab.synth.surroundings import draw_description

#: Increased when a seed gives other scenes.
RECIPE_VERSION = 2
#: Fraction of the rig at its edges without test cameras, so that they lie between training cameras.
TEST_MARGIN = 0.12

Row = dict[str, Any]


@dataclass(frozen=True)
class CaptureSettings:
    """Photos of each scene.

    Attributes:
        size: longer side in pixels, 16 to 4096.
        views: number of train photos, at least 1.
        test_views: number of test photos.
        spp: light paths per pixel, a square number, 1 to 4096.
        angle: between train photos next to each other, as the objects see them, degrees, up to 60;
            None for photos from all sides.

    Raises:
        IgsrError: one is out of range.
    """

    size: int = 256
    views: int = 24
    test_views: int = 8
    spp: int = 16
    angle: float | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        _check_range("size", self.size, 16, 4096)
        _check_range("views", self.views, 1, 10_000)
        _check_range("test_views", self.test_views, 0, 10_000)
        _check_range("spp", self.spp, 1, 4096)
        if math.isqrt(self.spp) ** 2 != self.spp:
            raise IgsrError(f"spp must be a square such as 9, 16 or 36, not {self.spp}.")
        if self.angle is not None and not 0.0 < self.angle <= 60.0:
            raise IgsrError(f"angle must be above 0 and up to 60 degrees, not {self.angle}.")


def _check_range(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise IgsrError(f"{name} must be a whole number, not {value!r}.")
    if not low <= value <= high:
        raise IgsrError(f"{name} must be from {low} to {high}, not {value}.")


def synthesize(
    out: str | os.PathLike[str],
    scenes: int,
    *,
    seed: int = 0,
    first: int = 0,
    settings: CaptureSettings | None = None,
    jobs: int = 1,
    on_scene: Callable[[int, int, Row], None] | None = None,
    ray: bool = False,
) -> Row:
    """Make synthetic captures; finished ones are kept.

    Scene k of a seed does not depend on ``scenes``, ``first`` and ``jobs``: it has the same bits on
    one machine with one version of Mitsuba.

    Args:
        out: folder of the scenes' folders, ``scene_00000`` and on.
        scenes: number of scenes.
        seed: random seed.
        first: number of the first scene.
        settings: photos of each scene.
        jobs: number of parallel scenes, each in a process with one thread.
        on_scene: called with (done, total, row) after each scene.
        ray: make the scenes on a Ray cluster, whose machines see ``out`` at the same path
            (``pip install 'igsr[ray]'``).

    Returns:
        {"out", "seed", "settings", "scenes"}: a row per scene with name, family, kind, contents and
        seconds (None if it was finished before).

    Raises:
        IgsrError: a number is out of range, Mitsuba or Ray is not installed, the folder cannot be
            written, or it has a scene with other settings.
    """
    settings = settings or CaptureSettings()
    _check_range("scenes", scenes, 1, 100_000)
    _check_range("first", first, 0, 1_000_000)
    _check_range("seed", seed, 0, 2**63 - 1)
    _check_range("jobs", jobs, 1, 1024)
    with one_threaded_mitsuba():
        pass  # raises if it is not installed
    folder = Path(out)
    check_writable(folder / "scene.json")
    rows: dict[int, Row] = {}
    for index in range(first, first + scenes):
        row = _finished(folder / scene_name(index), _recipe(seed, index, settings))
        if row is not None:
            rows[index] = row
    missing = [index for index in range(first, first + scenes) if index not in rows]

    def keep(index: int, row: Row) -> None:
        rows[index] = row
        if on_scene is not None:
            on_scene(len(rows), scenes, row)

    make = partial(make_scene, folder.resolve(), seed, settings)
    processes = max(1, min(jobs, len(missing)))
    execute(make, missing, keep, jobs=processes, ray=ray, shared=folder)
    return {
        "out": str(folder),
        "seed": seed,
        "settings": asdict(settings),
        "scenes": [rows[index] for index in sorted(rows)],
    }


def scene_name(index: int) -> str:
    """Name of a scene's folder."""
    return f"scene_{index:05d}"


def _recipe(seed: int, index: int, settings: CaptureSettings) -> Row:
    """Everything that a scene depends on, except Mitsuba's version."""
    recipe = {"version": RECIPE_VERSION, "seed": seed, "index": index, **asdict(settings)}
    if settings.angle is None:
        del recipe["angle"]  # scenes made before there were angles stay finished
    return recipe


def _finished(folder: Path, recipe: Row) -> Row | None:
    """The row of a finished scene, or None."""
    if not folder.exists():
        return None
    path = folder / "scene.json"
    try:
        document = json.loads(path.read_bytes())
        row = {key: document[key] for key in ("family", "kind", "contents")}
        made_from = {key: document["recipe"].get(key) for key in recipe}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise IgsrError(
            f"{path} cannot be read, so {folder} is not a finished scene; delete the folder to "
            "make the scene again."
        ) from error
    for key, value in recipe.items():
        if made_from[key] != value:
            raise IgsrError(
                f"{folder} was made with {key} {made_from[key]!r}, not {value!r}; give another "
                "--out, or delete the folder."
            )
    return {"name": folder.name, **row, "seconds": None}


def make_scene(folder: Path, seed: int, settings: CaptureSettings, index: int) -> Row:
    """Make one scene in a temporary folder, then rename that; return the row."""
    started = time.monotonic()
    final = folder / scene_name(index)
    # Another process may make the same scene, with the same bits, at the same time.
    try:
        with atomic_folder(final, replace=True) as unfinished:
            with one_threaded_mitsuba() as mitsuba:
                document = _photograph(unfinished, seed, index, settings)
                document["mitsuba"] = mitsuba.__version__
            document["pyoidn"] = version("pyoidn")
            _write_json(unfinished / "scene.json", document)
    except IgsrError:
        finished = _finished(final, _recipe(seed, index, settings))
        if finished is None:
            raise
        return finished
    row = {key: document[key] for key in ("family", "kind", "contents")}
    return {"name": final.name, **row, "seconds": round(time.monotonic() - started, 1)}


def _photograph(folder: Path, seed: int, index: int, settings: CaptureSettings) -> Row:
    """Write the photos and cameras of a scene; return the content of scene.json."""
    # Scene and photos have separate random numbers: other settings give the same scene.
    description = draw_description(np.random.default_rng([seed, index, 0]))
    loaded = load_scene(description)
    rng = np.random.default_rng([seed, index, 1])
    rig = draw_rig(rng, description, settings.size)
    counts = {"train": settings.views, "test": settings.test_views}
    viewpoints = {
        split: choose_viewpoints(
            loaded,
            description,
            rig,
            np.random.default_rng([seed, index, stream]),
            counts[split],
            TEST_MARGIN if split == "test" else 0.0,
        )
        for stream, split in enumerate(counts, start=2)
    }
    if settings.angle is not None:
        viewpoints["train"] = viewpoints_at_angle(
            *(loaded, description, rig, np.random.default_rng([seed, index, 2])),
            *(settings.views, math.radians(settings.angle)),
        )
    gain = exposure(loaded, viewpoints["train"][:3], rng)
    taken = 0
    for split, cameras in viewpoints.items():
        frames = []
        for number, viewpoint in enumerate(cameras):
            name = f"{split}/{number:03d}"
            _write_view(folder, name, loaded, viewpoint, settings.spp, taken, gain)
            frames.append(_frame(name, viewpoint))
            taken += 1
        if frames:
            _write_json(folder / f"transforms_{split}.json", {"frames": frames})
    return {
        "recipe": _recipe(seed, index, settings),
        "family": description.family,
        "kind": description.kind,
        "contents": description.contents,
        "cameras": rig.kind,
        "lamps": len(description.lights),
        "exposure": gain,
        "center": description.center.tolist(),
        "radius": description.radius,
    }


def _write_view(
    folder: Path,
    name: str,
    loaded: LoadedScene,
    viewpoint: Viewpoint,
    samples: int,
    seed: int,
    gain: float,
) -> None:
    linear = take_photo(loaded, viewpoint, samples, seed)
    linear[..., :3] *= gain
    photo = encode(linear)
    depth, is_object = first_hits(loaded, viewpoint)
    mask = photo[..., 3] if loaded.transparent else np.where(is_object, 255, 0).astype(np.uint8)
    for kind in ("", "depth/", "mask/"):
        (folder / f"{kind}{name}").parent.mkdir(parents=True, exist_ok=True)
    image = photo if loaded.transparent else np.ascontiguousarray(photo[..., :3])
    Image.fromarray(image).save(folder / f"{name}.png")
    np.save(folder / f"depth/{name}.npy", depth)
    Image.fromarray(mask).save(folder / f"mask/{name}.png", optimize=True)


def _frame(name: str, viewpoint: Viewpoint) -> Row:
    return {
        "file_path": f"./{name}",
        "depth_file_path": f"./depth/{name}.npy",
        "object_mask_path": f"./mask/{name}.png",
        "w": viewpoint.width,
        "h": viewpoint.height,
        "fl_x": viewpoint.focal,
        "fl_y": viewpoint.focal,
        "cx": 0.5 * viewpoint.width,
        "cy": 0.5 * viewpoint.height,
        "transform_matrix": viewpoint.camera_to_world.tolist(),
    }


def _write_json(path: Path, document: Row) -> None:
    text = json.dumps(document, indent=1, allow_nan=False)
    path.write_text(text + "\n", encoding="utf-8")
