"""``igsr view``: show a scene in a window or in the browser.

The viewer ``splat-view`` runs in its own process and reads cameras from ``cameras.json`` only; this
command converts other captures.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from PIL import Image

from igsr.capture import Capture, View, load_capture
from igsr.capture.load import holds_cameras
from igsr.capture.write_files import png_names
from igsr.capture.write_transforms import write_cameras
from igsr.cli.error_messages import error_messages, print_message
from igsr.cli.web_view import has_display, serve_web_view
from igsr.errors import IgsrError
from igsr.rendering.run_folder import CAMERAS, VIEW

PROGRAM = (sys.executable, "-m", "igsr.rendering.window")
#: Do not import modules from the current folder.
ENVIRONMENT = {"PYTHONSAFEPATH": "1"}
#: Options of the viewer that open no window.
WITHOUT_WINDOW = ("--screenshot", "--frames", "--time", "--help", "-h", "--version")
OWN_HOST = "127.0.0.1"
#: Unknown options are the viewer's.
#: Longest side of the photos for the viewer.
MAX_PHOTO_SIDE_PX = 1600


def view_command(
    scenes: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENE...",
            help="Splat file or folder of a fit or refinement; two are compared. Options of "
            "splat-view may follow.",
        ),
    ],
    cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras",
            metavar="CAPTURE",
            help="Capture whose cameras and photos to show. Default: that in SCENE's folder.",
        ),
    ] = None,
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="Show the scene in the browser, and follow a running fit or refinement. Default "
            "without a display.",
        ),
    ] = False,
    host: Annotated[
        str | None,
        typer.Option(
            "--host",
            metavar="ADDRESS",
            help="For --web: address to listen on; 0.0.0.0 allows other computers. "
            f"Default: {OWN_HOST}.",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            "--port",
            min=1,
            max=65535,
            help="For --web: port to listen on. Default: 8765, or the next free one.",
        ),
    ] = None,
) -> None:
    """Show one scene, or two side by side, in a window or in the browser."""
    with error_messages():
        opens_window = not any(word.partition("=")[0] in WITHOUT_WINDOW for word in scenes)
        if web or (opens_window and not has_display()):
            if not web:
                _announce_browser(scenes)
            serve_web_view(
                scenes,
                lambda folder: _cameras_for_web(cameras, Path(scenes[0]), folder),
                host or OWN_HOST,
                port,
            )
            return
        for option, value in (("--host", host), ("--port", port)):
            if value is not None:
                raise IgsrError(f"{option} is for the browser view; add --web or leave it out")
        with tempfile.TemporaryDirectory(prefix="igsr-view-") as folder:
            words = [*PROGRAM, *scenes]
            readable = _cameras(cameras, Path(scenes[0]), Path(folder))
            if readable is not None:
                words += ["--cameras", str(readable)]
            code = subprocess.run(words, check=False, env={**os.environ, **ENVIRONMENT}).returncode
    raise typer.Exit(code if code >= 0 else 128 - code)


def _announce_browser(scenes: list[str]) -> None:
    """Print that the browser is used instead of a window.

    Raises:
        IgsrError: options of the window are given.
    """
    options = [word for word in scenes if word.startswith("-")]
    if options:
        raise IgsrError(
            f"{options[0]} needs a window, and there is no display; set DISPLAY, or leave it out "
            "to use the browser"
        )
    print_message("There is no display; the scene is shown in the browser.")


def _cameras(named: str | None, scene: Path, folder: Path) -> Path | None:
    """``cameras.json`` of the named capture, or of a capture in the scene's folder.

    None if there is none, or if the viewer finds it.
    """
    if named is not None:
        return _readable(Path(named), folder)
    capture = scene if scene.is_dir() else scene.parent
    if (capture / CAMERAS).is_file() or not holds_cameras(capture):
        return None
    try:
        return _readable(capture, folder)
    except IgsrError as error:  # the scene can be shown without cameras
        print_message(f"{error}; no cameras are shown")
        return None


def _cameras_for_web(named: str | None, scene: Path, folder: Path) -> Path | None:
    """As ``_cameras``; also None if a run has written cameras and photos for the page."""
    if named is None and (scene / VIEW / CAMERAS).is_file():
        return None
    return _cameras(named, scene, folder)


def _readable(capture: Path, folder: Path) -> Path:
    """The capture's ``cameras.json``, or one written into ``folder``."""
    for path in (capture, capture / CAMERAS):
        if path.name == CAMERAS and path.is_file():
            return path
    print_message(f"Reading {capture} ...")
    write_for_viewer(load_capture(capture), folder)
    return folder / CAMERAS


def write_for_viewer(capture: Capture, folder: Path) -> None:
    """Write ``cameras.json`` and ``photos/``, undistorted and at most ``MAX_PHOTO_SIDE_PX``.

    Args:
        capture: cameras and photos.
        folder: to write to.

    Raises:
        IgsrError: the file of cameras cannot be written.
        OSError: a photo cannot be written.
    """
    views = [
        replace(view, name=f"photos/{name}")
        for view, name in zip(capture.views, png_names(capture.views), strict=True)
    ]
    folder.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        list(pool.map(lambda view: _write_photo(view, folder / view.name), views))
    write_cameras(folder / CAMERAS, views)


def _write_photo(view: View, path: Path) -> None:
    photo = Image.fromarray(view.image)
    photo.thumbnail((MAX_PHOTO_SIDE_PX, MAX_PHOTO_SIDE_PX))
    path.parent.mkdir(parents=True, exist_ok=True)
    # A temporary file: fast to write rather than small.
    photo.save(path, compress_level=1)
