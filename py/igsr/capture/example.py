"""The example capture that every installation of igsr contains: photos of a tea table."""

from __future__ import annotations

import json
import os
from pathlib import Path

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.input_files import read_file


def write_example(folder: str | os.PathLike[str]) -> Path:
    """Write the example capture into a folder, in the layout of NeRF Synthetic.

    It has eight photos to fit, 256 x 256 pixels with alpha, and eight held-out ones. They are
    photos of ``examples/tea_table`` in igsr's source, those of ``igsr refine --photos 8``.

    Args:
        folder: is created if it is missing; complete files in it are not written again.

    Returns:
        The folder, for ``igsr.load_capture``.

    Raises:
        IgsrError: a file cannot be written; the message names it.
    """
    folder = Path(folder)
    files = _core.example_files()
    for name, contents in files.items():
        if name == "transforms_train.json":
            # It also names photos of the source that are not installed.
            document = json.loads(contents)
            document["frames"] = [
                frame
                for frame in document["frames"]
                if f"{frame['file_path'].removeprefix('./')}.png" in files
            ]
            contents = json.dumps(document, indent=1).encode()
        path = folder / name
        if not path.is_file() or read_file(path) != contents:
            with atomic_write(path) as temporary:
                temporary.write_bytes(contents)
    return folder
