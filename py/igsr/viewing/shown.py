"""What the page of ``igsr view --web`` asks for: the state, surroundings, models and photos."""

from __future__ import annotations

import json
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igsr.errors import IgsrError
from igsr.rendering.scene_model import embedded_model
from igsr.rendering.scene_page import described_model, live_page, surroundings
from igsr.viewing.found_models import FoundModel, found_models
from igsr.viewing.photos import SeenCamera, camera_files, jpeg_of, seen_cameras
from igsr.viewing.run_news import Scores, run_background, run_progress, run_scores

#: Models that are kept packed: the page shows two, and may go back to others.
KEPT = 4
BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class _Surroundings:
    version: str
    cameras: list[SeenCamera]
    background: tuple[float, float, float]


class Shown:
    """Files and folders that are shown; every answer is of what they hold at the moment."""

    def __init__(self, paths: Sequence[Path], cameras: Path | None = None) -> None:
        """Take splat files and folders of fits and refinements.

        Args:
            paths: what to show; at least one.
            cameras: a ``cameras.json`` to use in place of those that lie beside; photos are looked
                for beside it.
        """
        self._paths = list(paths)
        self._cameras = cameras
        self._last: _Surroundings | None = None
        self._packed: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        # A hundred requests for one model pack it once.
        self._packing = threading.Lock()

    @property
    def title(self) -> str:
        """The page's title."""
        return " and ".join(path.resolve().name or str(path) for path in self._paths)

    def page(self) -> str:
        """The page, as HTML."""
        return live_page(self.title)

    def state(self) -> dict[str, Any]:
        """What changes while a run goes on; the page asks for it once a second."""
        models = self._models()
        folder = next((path for path in self._paths if path.is_dir()), None)
        scores = Scores() if folder is None else run_scores(folder)
        return {
            "title": self.title,
            "run": None if folder is None else run_progress(folder),
            "scores": {"head": scores.head, "rows": scores.rows},
            "models": [
                {"id": one.id, "label": one.label, "version": one.version} for one in models
            ],
            "newest": models[-1].id if models else "",
            "surroundings": self._surroundings_version(),
        }

    def surroundings(self) -> dict[str, Any]:
        """Cameras, those with photos first, up axis and background."""
        now = self._surroundings()
        found = surroundings([one.shown for one in now.cameras], now.background)
        for number, (one, seen) in enumerate(zip(found["cameras"], now.cameras, strict=True)):
            if seen.photo is not None:
                one["photo"] = f"photo?number={number}&version={now.version}"
        return found

    def photo(self, number: int) -> bytes:
        """The photo of a camera, as a JPEG.

        Raises:
            KeyError: there is none of this number.
            IgsrError: it cannot be read.
        """
        cameras = self._surroundings().cameras
        photo = cameras[number].photo if 0 <= number < len(cameras) else None
        if photo is None:
            raise KeyError(number)
        return jpeg_of(photo)

    def model(self, id: str) -> bytes:
        """A model as the page reads it: the length of a JSON text (u32), the text, packed splats.

        Raises:
            KeyError: there is no model of this id.
            IgsrError: it cannot be read.
        """
        found = {one.id: one for one in self._models()}[id]
        key = (found.id, found.version)
        with self._packing:
            packed = self._packed.pop(key, None) or _packed(found)
            self._packed[key] = packed
            while len(self._packed) > KEPT:
                self._packed.popitem(last=False)
        return packed

    def _models(self) -> list[FoundModel]:
        if len(self._paths) == 1:
            return found_models(self._paths[0])
        models = []
        for number, path in enumerate(self._paths):
            name = path.resolve().name
            for one in found_models(path):
                label = f"{name}: {one.label}" if path.is_dir() else name
                models.append(replace(one, id=f"{number}-{one.id}", label=label))
        return models

    def _camera_files(self) -> list[Path]:
        if self._cameras is not None:
            return [self._cameras]
        return [file for path in self._paths for file in camera_files(path)]

    def _surroundings_version(self) -> str:
        stamps = []
        for file in self._camera_files():
            try:
                stamps.append(str(file.stat().st_mtime_ns))
            except OSError:
                stamps.append("")
        return "-".join([*stamps, *(f"{channel:g}" for channel in self._background())])

    def _background(self) -> tuple[float, float, float]:
        folders = (path if path.is_dir() else path.parent for path in self._paths)
        found = (run_background(folder) for folder in folders)
        return next((color for color in found if color is not None), BLACK)

    def _surroundings(self) -> _Surroundings:
        version = self._surroundings_version()
        if self._last is not None and self._last.version == version:
            return self._last
        cameras = [seen for file in self._camera_files() for seen in seen_cameras(file)]
        cameras.sort(key=lambda one: one.photo is None)
        self._last = _Surroundings(version, cameras, self._background())
        return self._last


def _packed(found: FoundModel) -> bytes:
    model = embedded_model(found.load())
    if model.count == 0:
        raise IgsrError(f"{found.path.name} has no splats.")
    described = json.dumps({"label": found.label, **described_model(model)}).encode()
    return len(described).to_bytes(4, "little") + described + model.packed
