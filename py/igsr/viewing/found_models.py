"""The models that a splat file or the folder of a fit or a refinement holds at the moment."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from igsr.errors import IgsrError
from igsr.fitting.checkpoint import checkpoint_splats
from igsr.fitting.followed_run import CAMERAS, VIEW
from igsr.splats import Splats
from igsr.viewing.level_files import INDEX, level_within
from igsr.viewing.run_news import round_labels

#: Ending of checkpoints.
CHECKPOINT = ".npz"
SCENE = "scene.ply"


@dataclass(frozen=True)
class FoundModel:
    """A model in a file.

    Attributes:
        id: names it in addresses; it is never taken for a path.
        label: what the page calls it.
        path: a splat file or a checkpoint.
        version: changes whenever the file does.
        changed: time of the last change, ns.
    """

    id: str
    label: str
    path: Path
    version: str
    changed: int

    def load(self) -> Splats:
        """Its splats; of a scene in levels of detail those of the finest level that a page holds.

        Raises:
            IgsrError: the file cannot be read.
        """
        if self.path.suffix == CHECKPOINT:
            return checkpoint_splats(self.path)
        if self.path.name == INDEX:
            return level_within(self.path)
        return Splats.load(self.path)


def found_models(path: Path) -> list[FoundModel]:
    """The models of a splat file or a folder, the newest last; none where there is none yet.

    Args:
        path: a splat file, or the folder of a fit, a refinement or a scene in levels of detail. In
            that of a run these are the models of a refinement's rounds, else ``scene.ply``; and the
            checkpoint of the fit to all photos that is under way, until it has a scene.
    """
    if not path.is_dir():
        return _present([("scene", path.stem, path)])
    if (path / INDEX).is_file():
        return _present([("scene", path.resolve().name, path / INDEX)])
    found = _present([(f"round-{number}", label, file) for number, label, file in _rounds(path)])
    number_next = len(found)
    if not found:
        found = _present([("scene", "scene", path / SCENE)])
        found = [_as_earlier(one, path) for one in found]
    checkpoints = _present(
        [
            ("checkpoint", "being fitted", file)
            for file in (path / "checkpoint.npz", *path.glob("checkpoints/whole*.npz"))
        ]
    )
    newest = max(checkpoints, key=lambda one: one.changed, default=None)
    if newest is None or any(one.changed >= newest.changed for one in found):
        return found
    of_round = newest.path.stem.removeprefix("whole-round")
    if of_round.isdigit() and number_next > 0:
        newest = FoundModel(**{**vars(newest), "label": f"round {of_round}, being fitted"})
    return [*found, newest]


def _rounds(folder: Path) -> list[tuple[int, str, Path]]:
    numbers = [
        int(path.parent.name)
        for path in folder.glob(f"rounds/*/{SCENE}")
        if path.parent.name.isdecimal()
    ]
    labels = round_labels(folder)
    return [
        (number, labels.get(number, f"round {number}"), folder / "rounds" / str(number) / SCENE)
        for number in sorted(numbers)
    ]


def _as_earlier(found: FoundModel, folder: Path) -> FoundModel:
    """A scene that was there before the run began says so."""
    try:
        began = (folder / VIEW / CAMERAS).stat().st_mtime_ns
    except OSError:
        return found
    if found.changed >= began:
        return found
    return FoundModel(**{**vars(found), "label": "scene of an earlier run"})


def _present(named: list[tuple[str, str, Path]]) -> list[FoundModel]:
    found = []
    for id, label, path in named:
        try:
            status = path.stat()
        except OSError:
            continue  # it went, or is not there yet
        if not path.is_file():
            continue
        version = f"{status.st_mtime_ns}-{status.st_size}"
        found.append(FoundModel(id, label, path, version, status.st_mtime_ns))
    return found


def check_shown(path: Path) -> None:
    """Find out whether a path can be shown at all, now or once a run has written to it.

    Raises:
        IgsrError: there is no such file or folder, or the file is no model.
    """
    if path.is_dir():
        return
    if not path.is_file():
        raise IgsrError(f"There is no file or folder {path}; name a splat file or a fit's folder.")
    for found in found_models(path):
        found.load()
