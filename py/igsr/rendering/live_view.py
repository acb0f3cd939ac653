"""Answers to the page of ``igsr view --web``: state, surroundings, models and photos."""

from __future__ import annotations

import contextlib
import io
import json
import os
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image

from igsr._internal.input_files import MAX_JSON_VALUES
from igsr.capture.image_files import load_pixels, open_image
from igsr.errors import IgsrError
from igsr.rendering.live_models import LiveModel, live_models
from igsr.rendering.run_folder import (
    CAMERAS,
    VIEW,
    Color,
    cameras_of,
    run_background,
    run_progress,
    run_scores,
)
from igsr.rendering.scene_model import embedded_model
from igsr.rendering.scene_page import PageCamera, described_model, live_page, surroundings

#: Number of packed models to keep: the page shows two, and may return to others.
MAX_PACKED_MODELS = 4
BLACK = (0.0, 0.0, 0.0)
PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png")
#: Maximum longest side of the photos that the page gets.
MAX_PHOTO_SIDE_PX = 1600
#: Maximum bytes of a photo while it is decoded: 4 per pixel, or 8 if it is converted. A progressive
#: JPEG has 6 more per pixel of the file, also if it is decoded at a part of its size. Decoders of
#: formats that may have these names too, as AVIF and WebP, take up to 16.
MAX_PHOTO_BYTES = 200_000_000
#: Longest wait for cameras; thousands appear on the page later.
READING_WAIT_S = 0.5
#: How often a waiting request looks whether its connection is open.
POLL_S = 0.1


@dataclass(frozen=True)
class _Surroundings:
    version: str
    photos: list[Path | None]  # of the cameras
    answer: bytes  # JSON


class LiveView:
    """A view of files and folders that may change.

    Args:
        paths: splat files, and folders of fits and refinements; at least one.
        cameras: a ``cameras.json`` to use instead of the paths' own, with photos in its folder.
    """

    def __init__(self, paths: Sequence[Path], cameras: Path | None = None) -> None:
        self._paths = list(paths)
        self._cameras = cameras
        self._surroundings = _Surroundings("", [], _json([], [], "", BLACK))
        self._reading: threading.Thread | None = None
        self._start_reading = threading.Lock()
        self._packed: OrderedDict[tuple[str, str], bytes] = OrderedDict()
        # Concurrent requests for a model pack it once.
        self._packing = threading.Lock()
        # Photos are decoded one at a time; each thread would keep memory for itself.
        self._decoder = ThreadPoolExecutor(max_workers=1)

    def close(self) -> None:
        """Drop the photos that are still to be decoded."""
        self._decoder.shutdown(wait=False, cancel_futures=True)

    @property
    def title(self) -> str:
        """The page's title."""
        return " and ".join(path.resolve().name or str(path) for path in self._paths)

    def page(self) -> str:
        """Return the page as HTML."""
        return live_page(self.title)

    def state(self) -> dict[str, Any]:
        """Return everything that may change; the page asks once a second."""
        models = self._models()
        folder = next((path for path in self._paths if path.is_dir()), None)
        return {
            "title": self.title,
            "run": None if folder is None else run_progress(folder),
            "scores": {"head": [], "rows": []} if folder is None else run_scores(folder),
            "models": [
                {"id": model.id, "label": model.label, "version": model.version} for model in models
            ],
            "newest": models[-1].id if models else "",
            "surroundings": self._current_surroundings().version,
        }

    def surroundings(self) -> bytes:
        """Return the surroundings of the state's version, as JSON.

        They are cameras, sorted by whether they have a photo, up axis and background.
        """
        return self._current_surroundings().answer

    def photo(self, number: int, is_open: Callable[[], bool] = lambda: True) -> bytes:
        """Return the photo of a camera as JPEG.

        Raises a KeyError if there is none, and a ConnectionError as ``model``.
        """
        photos = self._current_surroundings().photos
        path = photos[number] if 0 <= number < len(photos) else None
        if path is None:
            raise KeyError(number)
        decoding = self._decoder.submit(_jpeg, path)
        while not wait([decoding], timeout=POLL_S).done:
            if not is_open() and decoding.cancel():
                raise ConnectionError
        return decoding.result()

    def model(self, id: str, is_open: Callable[[], bool] = lambda: True) -> bytes:
        """Return a model for the page: the length of a JSON text (u32), the text, packed splats.

        Raises a KeyError if the id is unknown, and a ConnectionError if the connection is closed
        while other requests are answered.
        """
        model = {one.id: one for one in self._models()}[id]
        key = (model.id, model.version)
        with _turn(self._packing, is_open):
            packed = self._packed.pop(key, None) or _packed(model)
            self._packed[key] = packed
            while len(self._packed) > MAX_PACKED_MODELS:
                self._packed.popitem(last=False)
        return packed

    def _models(self) -> list[LiveModel]:
        if len(self._paths) == 1:
            return live_models(self._paths[0])
        models = []
        for number, path in enumerate(self._paths):
            name = path.resolve().name
            for model in live_models(path):
                label = f"{name}: {model.label}" if path.is_dir() else name
                models.append(replace(model, id=f"{number}-{model.id}", label=label))
        return models

    def _folders(self) -> list[Path]:
        return [path if path.is_dir() else path.parent for path in self._paths]

    def _camera_files(self) -> list[Path]:
        if self._cameras is not None:
            return [self._cameras]
        folders = self._folders()
        return [file for f in folders for file in (f / VIEW / CAMERAS, f / CAMERAS)]

    def _surroundings_version(self) -> str:
        stamps = []
        for file in self._camera_files():
            try:
                stamps.append(str(file.stat().st_mtime_ns))
            except OSError:
                stamps.append("")
        return "-".join([*stamps, *(f"{channel:g}" for channel in self._background())])

    def _background(self) -> Color:
        colors = (run_background(folder) for folder in self._folders())
        return next((color for color in colors if color is not None), BLACK)

    def _current_surroundings(self) -> _Surroundings:
        """The surroundings that were read last; after a change they are read in a thread."""
        version = self._surroundings_version()
        with self._start_reading:
            is_reading = self._reading is not None and self._reading.is_alive()
            if self._surroundings.version != version and not is_reading:
                self._reading = threading.Thread(target=self._read, args=(version,), daemon=True)
                self._reading.start()
        if self._reading is not None:
            self._reading.join(READING_WAIT_S)
        return self._surroundings

    def _read(self, version: str) -> None:
        found = [camera for file in self._camera_files() for camera in _cameras(file)]
        found.sort(key=lambda camera: camera[1] is None)
        cameras, photos = [camera for camera, _ in found], [photo for _, photo in found]
        answer = _json(cameras, photos, version, self._background())
        self._surroundings = _Surroundings(version, photos, answer)


def _json(
    cameras: list[PageCamera], photos: list[Path | None], version: str, background: Color
) -> bytes:
    answer = surroundings(cameras, background)
    for number, photo in enumerate(photos):
        if photo is not None:
            answer["cameras"][number]["photo"] = f"photo?number={number}&version={version}"
    return json.dumps(answer, allow_nan=False).encode()


@contextlib.contextmanager
def _turn(lock: threading.Lock, is_open: Callable[[], bool]) -> Iterator[None]:
    """Wait for a lock, as long as the connection is open."""
    while not lock.acquire(timeout=POLL_S):
        if not is_open():
            raise ConnectionError
    try:
        yield
    finally:
        lock.release()


def _cameras(file: Path) -> list[tuple[PageCamera, Path | None]]:
    """The cameras of a ``cameras.json`` and their photos; none if it cannot be read."""
    try:
        cameras = cameras_of(file, MAX_JSON_VALUES) if file.is_file() else []
    except IgsrError:
        return []
    folder = os.path.realpath(file.parent)
    return [(camera, _photo(folder, camera.name)) for camera in cameras]


def _photo(folder: str, name: str) -> Path | None:
    """The photo of an untrusted name, only if it is inside ``folder``, a real path."""
    if not name.lower().endswith(PHOTO_SUFFIXES) or "\0" in name:
        return None
    try:
        path = os.path.realpath(os.path.join(folder, name))
        if os.path.commonpath([folder, path]) != folder or not os.path.isfile(path):
            return None
    except (OSError, ValueError):
        return None
    return Path(path)


def _jpeg(path: Path) -> bytes:
    size = (MAX_PHOTO_SIDE_PX, MAX_PHOTO_SIDE_PX)
    try:
        with open_image(path) as photo:
            width, height = photo.size
            photo.draft("RGB", size)
            if _bytes_to_decode(photo, width * height) > MAX_PHOTO_BYTES:
                raise IgsrError(f"it has {width}x{height} pixels, too many for a page")
            load_pixels(photo, path)
            small = photo if photo.mode == "RGB" else photo.convert("RGB")
            small.thumbnail(size)
        file = io.BytesIO()
        small.save(file, format="JPEG", quality=90)
    # Pillow raises many kinds of errors for damaged or large files.
    except Exception as error:
        raise IgsrError(f"{path} cannot be shown: {error}.") from error
    return file.getvalue()


def _bytes_to_decode(photo: Image.Image, stored: int) -> int:
    """Bytes that the decoding of a photo takes; ``stored`` is the pixels of its file."""
    each = 4 if photo.mode == "RGB" else 8
    if photo.format not in ("JPEG", "MPO", "PNG"):
        each = 16
    return each * photo.width * photo.height + 6 * stored * ("progressive" in photo.info)


def _packed(model: LiveModel) -> bytes:
    embedded = embedded_model(model.load())
    if embedded.count == 0:
        raise IgsrError(f"{model.path.name} has no splats.")
    described = json.dumps({"label": model.label, **described_model(embedded)}).encode()
    return len(described).to_bytes(4, "little") + described + embedded.packed
