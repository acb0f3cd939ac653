"""The example capture, which every installation of igsr has: photos of a tea table."""

from __future__ import annotations

import json
import os
from pathlib import Path

from igsr import _core
from igsr._internal.atomic_write import atomic_write


def write_example(folder: str | os.PathLike[str]) -> Path:
    """Write the example capture into a folder, in the layout of NeRF Synthetic.

    It has eight photos to fit, 256 x 256 pixels with alpha, and eight held-out ones. They are
    photos of ``examples/tea_table`` in igsr's source: those that ``igsr refine --photos 8`` takes.

    Args:
        folder: is made where it is missing; files that it has already stay as they are.

    Returns:
        The folder, for ``igsr.load_capture``.

    Raises:
        IgsrError: a file cannot be written; the message names it.
    """
    folder = Path(folder)
    files = _core.example_files()
    for name, contents in files.items():
        if name == "transforms_train.json":  # it names photos that are not brought along
            contents = _without_missing(contents, set(files))
        path = folder / name
        if not path.is_file() or path.read_bytes() != contents:
            with atomic_write(path) as temporary:
                temporary.write_bytes(contents)
    return folder


def _without_missing(transforms: bytes, names: set[str]) -> bytes:
    """A ``transforms.json`` with those frames whose photos are among ``names``."""
    described = json.loads(transforms)
    described["frames"] = [
        frame
        for frame in described["frames"]
        if f"{frame['file_path'].removeprefix('./')}.png" in names
    ]
    return json.dumps(described, indent=1).encode()
