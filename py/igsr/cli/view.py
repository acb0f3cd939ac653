"""``igsr view``: a scene in a window, or in the browser.

The viewer ``splat-view`` is a process of its own and reads cameras in one format, the
``cameras.json`` that igsr writes. This command reads any other capture for it.
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
from igsr.cli.error_messages import INTERRUPTED, error_messages, print_message
from igsr.cli.web_view import has_display, serve_web_view
from igsr.errors import IgsrError

#: The viewer.
PROGRAM = (sys.executable, "-m", "igsr.viewing.window")
#: Nothing in the folder that the command was typed in takes the place of a module.
ENVIRONMENT = {"PYTHONSAFEPATH": "1"}
#: Options of the viewer that open no window.
WITHOUT_WINDOW = ("--screenshot", "--frames", "--time", "--help", "-h", "--version")
#: The viewer's file of cameras.
CAMERAS = "cameras.json"
#: Where the browser view listens: nowhere that other computers reach.
OWN_HOST = "127.0.0.1"
#: The folder in that of a run which has photos and cameras for the page.
VIEW = "view"
#: Options that this command does not know are the viewer's.
PASSED_ON = {"ignore_unknown_options": True}
#: Longest side of the photos that the viewer lays over renders, pixels.
PHOTO_SIDE = 1600


def view_command(
    scenes: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENE...",
            help="Splat file, or the folder of a fit or a refinement; two are compared. "
            "Options of splat-view may follow.",
        ),
    ],
    cameras: Annotated[
        str | None,
        typer.Option(
            "--cameras",
            metavar="CAPTURE",
            help="Capture whose cameras and photos to show. Default: what lies beside SCENE.",
        ),
    ] = None,
    web: Annotated[
        bool,
        typer.Option(
            "--web",
            help="Show it in the browser, and follow a fit or a refinement that is running. "
            "Where there is no display this is the default.",
        ),
    ] = False,
    host: Annotated[
        str | None,
        typer.Option(
            "--host",
            metavar="ADDRESS",
            help="For --web: address to listen at; 0.0.0.0 opens it to other computers. "
            f"Default: {OWN_HOST}, this computer alone.",
        ),
    ] = None,
    port: Annotated[
        int | None,
        typer.Option(
            "--port",
            min=1,
            max=65535,
            help="For --web: port to listen at. Default: 8765, or the next free one.",
        ),
    ] = None,
) -> None:
    """Show splats in a window or in the browser, one scene alone or two beside each other."""
    with error_messages():
        if web or (not has_display() and not _asks_for_no_window(scenes)):
            if not web:
                _say_why_the_browser(scenes)
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
            try:
                code = subprocess.run(
                    words, check=False, env={**os.environ, **ENVIRONMENT}
                ).returncode
            except KeyboardInterrupt:
                code = INTERRUPTED
    raise typer.Exit(code if code >= 0 else 128 - code)


def _asks_for_no_window(scenes: list[str]) -> bool:
    return any(word.partition("=")[0] in WITHOUT_WINDOW for word in scenes)


def _say_why_the_browser(scenes: list[str]) -> None:
    """Say in a line that the browser stands in for a window.

    Raises:
        IgsrError: options are given that only the window has.
    """
    options = [word for word in scenes if word.startswith("-")]
    if options:
        raise IgsrError(
            f"{options[0]} is for the window, and there is no display; set DISPLAY, or leave it "
            "out for the browser view"
        )
    print_message("There is no display to open a window on; the browser shows the scene.")


def _cameras(named: str | None, scene: Path, folder: Path) -> Path | None:
    """The ``cameras.json`` to show: of the capture that is named, else of the one beside the scene.

    None where the viewer finds its own, or where there is none.
    """
    if named is not None:
        return _readable(Path(named), folder)
    capture = _beside(scene)
    if capture is None:
        return None
    try:
        return _readable(capture, folder)
    except IgsrError as error:
        # Nobody asked for them: the scene can be looked at without.
        print(f"{error}; no cameras are shown.", file=sys.stderr)
        return None


def _cameras_for_web(named: str | None, scene: Path, folder: Path) -> Path | None:
    """As ``_cameras``; None, too, where a run has left cameras and photos for the page."""
    if named is None and (scene / VIEW / CAMERAS).is_file():
        return None
    return _cameras(named, scene, folder)


def _beside(scene: Path) -> Path | None:
    """The capture that a scene lies in, or that igsr keeps beside it."""
    folder = scene if scene.is_dir() else scene.parent
    if (folder / CAMERAS).is_file():
        return None
    return next((path for path in (folder, folder / "capture") if holds_cameras(path)), None)


def _readable(capture: Path, folder: Path) -> Path:
    """A capture's own ``cameras.json``, or one that is made of the capture in ``folder``."""
    for path in (capture, capture / CAMERAS):
        if path.name == CAMERAS and path.is_file():
            return path
    print(f"Reading {capture} ...", file=sys.stderr, flush=True)
    write_for_viewer(load_capture(capture), folder)
    return folder / CAMERAS


def write_for_viewer(capture: Capture, folder: Path) -> None:
    """Write a capture's cameras, and its photos undistorted and at most 1600 pixels wide or high.

    Args:
        capture: cameras and photos.
        folder: where ``cameras.json`` goes, and the photos beside it under ``photos/``.

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
    photo.thumbnail((PHOTO_SIDE, PHOTO_SIDE))
    path.parent.mkdir(parents=True, exist_ok=True)
    # Read once and thrown away: speed counts, size does not.
    photo.save(path, compress_level=1)
