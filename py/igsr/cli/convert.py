"""``igsr convert``: a splat file in another format, or a page that shows it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from igsr._internal.atomic_write import check_writable
from igsr.cli.error_messages import error_messages, print_message, warning_messages
from igsr.cli.shared import (
    JsonOption,
    SceneArgument,
    background_color,
    output_console,
    print_json,
)
from igsr.errors import IgsrError
from igsr.splats import Splats

#: Ending of pages.
PAGE = ".html"


def convert_command(
    scene: SceneArgument,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="File to write. Its ending sets the format: .ply, .compressed.ply, .splat, .spz, "
            ".sog, .glb or .gltf; or .html, a page that shows the scene in a browser.",
        ),
    ],
    *,
    cameras: Annotated[
        Path | None,
        typer.Option(
            "--cameras",
            metavar="CAPTURE",
            help="For .html: the capture, or cameras.json, whose cameras to jump to. "
            "Default: the cameras.json of the fit that SCENE is of.",
        ),
    ] = None,
    background: Annotated[
        str | None,
        typer.Option(
            "--background",
            metavar="COLOR",
            help="For .html: color behind the splats: white, black, grey, or R,G,B from 0 to 1. "
            "Default: as in the report.json of its fit, else black.",
        ),
    ] = None,
    lod: Annotated[
        int | None,
        typer.Option(
            "--lod",
            metavar="N",
            help="Write TARGET as a folder of N levels of detail by cells, each level a quarter of "
            "the next finer one: streamed SOG, whose lod-meta.json lists them. SCENE may be larger "
            "than memory if it is a .ply.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write SCENE in the format of TARGET; name what that format cannot hold."""
    with error_messages(lambda: "Interrupted; nothing is written."), warning_messages():
        if lod is not None:
            if cameras is not None or background is not None:
                raise IgsrError("--cameras and --background are for pages, not for --lod")
            _write_levels(scene, target, lod, as_json)
            return
        is_page = target.suffix.lower() == PAGE
        for option, value in (("--cameras", cameras), ("--background", background)):
            if value is not None and not is_page:
                raise IgsrError(f"{option} is for pages; end {target} in {PAGE} or leave it out")
        check_writable(target)
        color = background_color(background)
        splats = Splats.load(scene)
        if is_page:
            notes = _write_page(target, scene, splats, cameras, color)
        else:
            notes = splats.save(target)
    size = target.stat().st_size
    if as_json:
        print_json(
            {
                "scene": str(scene),
                "target": str(target),
                "splats": len(splats),
                "sh_degree": splats.sh_degree,
                "antialiased": splats.antialiased,
                "bytes_before": scene.stat().st_size,
                "bytes": size,
                "notes": notes,
            }
        )
        return
    for note in notes:
        print_message(note)
    before = scene.stat().st_size
    output_console().print(
        f"{len(splats)} splats in {target}, {size} bytes ({size / max(before, 1):.2f} of {scene})"
    )


def _write_levels(scene: Path, target: Path, levels: int, as_json: bool) -> None:
    from igsr.rendering.levels import INDEX, write_levels

    if target.resolve() == Path.cwd().resolve():
        raise IgsrError(f"{target} is the folder that the command runs in; name another")
    written = write_levels(scene, target, levels)
    if as_json:
        print_json({"scene": str(scene), "target": str(target), **asdict(written)})
        return
    for note in written.notes:
        print_message(note)
    console = output_console()
    for level, count in enumerate(written.counts):
        console.print(f"level {level}: {count} splats")
    cells = "1 cell" if written.cells == 1 else f"{written.cells} cells"
    files = "1 file" if written.files == 1 else f"{written.files} files"
    console.print(f"{cells} in {files}, {target / INDEX}")


def _write_page(
    target: Path,
    scene: Path,
    splats: Splats,
    capture: Path | None,
    background: tuple[float, float, float] | None,
) -> list[str]:
    from igsr.rendering.run_folder import background_beside, cameras_beside, cameras_of
    from igsr.rendering.scene_page import write_scene_page

    seen = cameras_beside(scene) if capture is None else cameras_of(capture)
    color = background or background_beside(scene) or (0.0, 0.0, 0.0)
    return write_scene_page(target, splats, seen, color, scene.stem)
