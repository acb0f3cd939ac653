"""Models that a splat file or the folder of a run currently holds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from igsr._internal.untrusted_npz import DAMAGE, stored_arrays
from igsr.errors import IgsrError
from igsr.geometry.frame import Frame
from igsr.rendering.levels import INDEX, level_within
from igsr.rendering.run_folder import CAMERAS, SCENE, VIEW, round_labels
from igsr.splats import PARAMETERS, Splats

CHECKPOINT_SUFFIX = ".npz"


@dataclass(frozen=True)
class LiveModel:
    """A model in a file that may change.

    Attributes:
        id: its name in the page's requests; never used as a path.
        label: its name on the page.
        path: a splat file, an index of levels, or a checkpoint of a fit.
        version: changes with the file.
        changed: time of the last change, ns.
    """

    id: str
    label: str
    path: Path
    version: str
    changed: int

    def load(self) -> Splats:
        """Read the splats; of a scene in levels, the finest level that the page can hold."""
        if self.path.name == INDEX:
            return level_within(self.path)
        if self.path.suffix != CHECKPOINT_SUFFIX:
            return Splats.load(self.path)
        try:
            arrays: dict[str, Any] = stored_arrays(self.path)
            splats = Splats(**{name: arrays[name] for name in (*PARAMETERS, "origin")})
            *origin, unit = arrays["frame"]
            return Frame(np.array(origin), float(unit)).inverse.splats(splats)
        except DAMAGE as error:
            raise IgsrError(f"The checkpoint {self.path} cannot be read ({error}).") from error


def live_models(path: Path) -> list[LiveModel]:
    """Find the current models of a file or a folder, the newest last.

    Args:
        path: a splat file, or the folder of a fit, a refinement or a scene in levels. The models
            of a run are the rounds of a refinement, else ``scene.ply``, and then the checkpoint of
            the fit that is going on.
    """
    if not path.is_dir():
        return _existing([("scene", path.stem, path)])
    if (path / INDEX).is_file():
        return _existing([("scene", path.resolve().name, path / INDEX)])
    labels = round_labels(path)
    numbers = [
        int(scene.parent.name)
        for scene in path.glob(f"rounds/*/{SCENE}")
        if scene.parent.name.isdecimal()
    ]
    rounds = _existing(
        [
            (f"round-{k}", labels.get(k, f"round {k}"), path / "rounds" / str(k) / SCENE)
            for k in sorted(numbers)
        ]
    )
    models = rounds or [
        _earlier(model, path) for model in _existing([("scene", "scene", path / SCENE)])
    ]
    files = (path / "checkpoint.npz", *path.glob("checkpoints/whole*.npz"))
    checkpoints = _existing([("checkpoint", "being fitted", file) for file in files])
    newest = max(checkpoints, key=lambda model: model.changed, default=None)
    if newest is None or any(model.changed >= newest.changed for model in models):
        return models
    number = newest.path.stem.removeprefix("whole-round")
    if number.isdigit() and rounds:
        newest = replace(newest, label=f"round {number}, being fitted")
    return [*models, newest]


def _earlier(scene: LiveModel, folder: Path) -> LiveModel:
    """The scene, labeled if it is older than the run."""
    try:
        began = (folder / VIEW / CAMERAS).stat().st_mtime_ns
    except OSError:
        return scene
    return scene if scene.changed >= began else replace(scene, label="scene of an earlier run")


def _existing(named: list[tuple[str, str, Path]]) -> list[LiveModel]:
    models = []
    for id, label, path in named:
        try:
            status = path.stat()
        except OSError:
            continue  # deleted meanwhile, or not written yet
        if path.is_file():
            version = f"{status.st_mtime_ns}-{status.st_size}"
            models.append(LiveModel(id, label, path, version, status.st_mtime_ns))
    return models


def check_viewable(path: Path) -> None:
    """Check that a path can be shown, now or after a run has written to it."""
    if path.is_dir():
        return
    if not path.is_file():
        raise IgsrError(f"There is no file or folder {path}; name a splat file or a fit's folder.")
    for model in live_models(path):
        model.load()
