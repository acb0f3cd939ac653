"""``igsr render``: render images or a video of a scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import Backend
from igsr.capture import Camera, View, load_capture
from igsr.capture.downscaling import reduced_size, resized_camera
from igsr.capture.photo_files import OWN_TAG
from igsr.cli.error_messages import error_messages
from igsr.cli.options import (
    NAMED_COLORS,
    BackendOption,
    BackgroundOption,
    JsonOption,
    MaxSizeOption,
    SceneArgument,
    background_color,
    option,
    resolved,
)
from igsr.cli.output import output_console, print_json
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background
from igsr.geometry.camera_paths import orbit
from igsr.rendering.renders import render
from igsr.rendering.run_folder import CAMERAS, Color, background_beside, cameras_of
from igsr.rendering.scene_page import PageCamera
from igsr.splats import Splats


def render_command(
    scene: SceneArgument,
    out: Annotated[
        Path, option("--out", help="Folder for the images; with --orbit, an .mp4 file.")
    ],
    cameras: Annotated[
        Path | None,
        option(
            "--cameras",
            metavar="CAPTURE",
            help="Render from the cameras of a capture, or of the folder of a fit.",
        ),
    ] = None,
    orbit_frames: Annotated[
        int | None,
        option(
            "--orbit",
            metavar="FRAMES",
            help="Write a video of an orbit around the scene; with --cameras, at their distance.",
        ),
    ] = None,
    exr: Annotated[
        bool,
        option(
            "--exr",
            help="Write EXR instead of PNG: 32-bit floats R, G, B, A and Z (expected depth).",
        ),
    ] = False,
    background: BackgroundOption = None,
    max_size: MaxSizeOption = None,
    backend: BackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Render SCENE to PNG or EXR images, or to a video."""
    with error_messages():
        name = resolved(backend)
        splats = Splats.load(scene)
        views, default_color = _views(scene, cameras, max_size)
        color = background_color(background) or default_color
        if orbit_frames is not None:
            if exr:
                raise IgsrError("--exr writes images and --orbit writes a video; leave one out.")
            if out.suffix.lower() not in (".mp4", ".mkv", ".mov"):
                raise IgsrError(f"--out {out} must be a video file such as orbit.mp4 with --orbit.")
            path = orbit(splats, [view.camera for view in views], orbit_frames)
            files = [_write_orbit(splats, path, out, color, name)]
        elif views:
            files = _write_pictures(splats, views, out, color, name, exr)
        else:
            raise IgsrError("Give the cameras: --cameras CAPTURE, --orbit FRAMES, or both.")
    if as_json:
        print_json({"files": [str(file) for file in files], **_core.backend_info(name)})
    else:
        output_console().print(
            str(files[0]) if len(files) == 1 else f"{len(files)} images in {out}"
        )


def _views(
    scene: Path, cameras: Path | None, max_size: int | None
) -> tuple[Sequence[View | PageCamera], Color]:
    """Cameras with their names, and the default background."""
    black = NAMED_COLORS["black"]
    if cameras is None:
        return [], black
    if CAMERAS in (cameras.name, *(path.name for path in cameras.glob("*.json"))):
        views = []
        for view in cameras_of(cameras):
            size = reduced_size(view.camera.width, view.camera.height, max_size)
            views.append(PageCamera(view.name, resized_camera(view.camera, *size)))
        return views, background_beside(scene) or black
    capture = load_capture(cameras, max_size)
    return capture.views, default_background(capture)


def _write_orbit(
    splats: Splats,
    path_cameras: list[Camera],
    out: Path,
    background: Color,
    backend: Backend,
) -> Path:
    from igsr.rendering.video import write_video

    frames = (render(splats, camera, background, backend).to_uint8() for camera in path_cameras)
    write_video(out, frames)
    return out


def _write_pictures(
    splats: Splats,
    views: Sequence[View | PageCamera],
    out: Path,
    background: Color,
    backend: Backend,
    exr: bool,
) -> list[Path]:
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from igsr.capture.write_files import unique_stems

    suffix = ".exr" if exr else ".png"
    stems = unique_stems((view.name for view in views), suffix)
    files = [out / f"{stem}{suffix}" for stem in stems]
    for view, path in zip(views, files, strict=True):
        picture = render(splats, view.camera, background, backend)
        with atomic_write(path) as temporary:
            if exr:
                _core.write_exr(
                    str(temporary), picture.color, picture.alpha, picture.expected_depth
                )
            else:
                tag = PngInfo()
                tag.add_text("Software", OWN_TAG)
                Image.fromarray(picture.to_uint8()).save(temporary, format="PNG", pnginfo=tag)
    return files
