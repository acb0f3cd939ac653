"""``igsr convert``: a splat file or a capture in another format."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from igsr._internal.atomic_write import check_folder, check_writable
from igsr.cli.error_messages import error_messages, nothing_written, print_message
from igsr.cli.options import Color, JsonOption, background_color, option
from igsr.cli.output import output_console, print_json
from igsr.errors import IgsrError
from igsr.splats import SPLAT_ENDINGS, Splats

#: Suffix of pages.
PAGE = ".html"


def convert_command(
    source: Annotated[
        Path, typer.Argument(metavar="SCENE|CAPTURE", help="Splat file, or photos with cameras.")
    ],
    target: Annotated[
        Path,
        typer.Argument(
            metavar="TARGET",
            help="Splat file (.ply, .compressed.ply, .splat, .spz, .sog, .glb, .gltf), page "
            "(.html), or a new folder for a capture or --lod.",
        ),
    ],
    *,
    to: Annotated[
        Literal["colmap", "colmap-text", "transforms"],
        option("--to", help="Format of a capture."),
    ] = "colmap",
    cameras: Annotated[
        Path | None,
        option(
            "--cameras",
            metavar="CAPTURE",
            help="Cameras of a page. Default: the cameras.json beside SCENE.",
        ),
    ] = None,
    background: Annotated[
        str | None,
        option(
            "--background",
            metavar="COLOR",
            help="Background of a page: white, black, gray or R,G,B in 0..1. Default: as in the "
            "report beside SCENE, else black.",
        ),
    ] = None,
    lod: Annotated[
        int | None,
        option("--lod", metavar="N", help="Write a folder of N levels of detail (streamed SOG)."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write SCENE or CAPTURE in another format.

    Says what the format cannot hold. Captures are written with undistorted photos and masks.
    """
    with error_messages(nothing_written(target)):
        if source.suffix.lower() not in SPLAT_ENDINGS:
            report = _converted_capture(source, target, to)
            lines = [f"{report['views']} views in {target}"]
        elif lod is not None:
            if cameras is not None or background is not None:
                raise IgsrError("--cameras and --background are for pages, not for --lod")
            report, lines = _levels(source, target, lod)
        else:
            color = background_color(background)
            report = _converted_scene(source, target, cameras, color)
            before, size = report["bytes_before"], report["bytes"]
            lines = [
                f"{report['splats']} splats in {target}, {size} bytes "
                f"({size / max(before, 1):.2f} of {source})"
            ]
    if as_json:
        print_json(report)
        return
    for note in report.get("notes", []):
        print_message(note)
    for line in lines:
        output_console().print(line)


def _converted_capture(source: Path, target: Path, to: str) -> dict[str, Any]:
    from igsr.capture import load_capture
    from igsr.capture.write_colmap import write_colmap
    from igsr.capture.write_transforms import write_transforms

    if target.suffix.lower() in (*SPLAT_ENDINGS, PAGE):
        raise IgsrError(f"{source} is not a splat file; name a folder to write its photos to")
    check_folder(target)
    capture = load_capture(source)
    if to == "transforms":
        write_transforms(capture, target)
    else:
        write_colmap(capture, target, text=to == "colmap-text")
    return {"capture": str(source), "target": str(target), "to": to, "views": len(capture.views)}


def _converted_scene(
    source: Path, target: Path, cameras: Path | None, background: Color | None
) -> dict[str, Any]:
    is_page = target.suffix.lower() == PAGE
    for name, value in (("--cameras", cameras), ("--background", background)):
        if value is not None and not is_page:
            raise IgsrError(f"{name} is for pages; end {target} in {PAGE} or leave it out")
    check_writable(target)
    splats = Splats.load(source)
    if is_page:
        from igsr.rendering.run_folder import background_beside, cameras_beside, cameras_of
        from igsr.rendering.scene_page import write_scene_page

        shown = cameras_beside(source) if cameras is None else cameras_of(cameras)
        color = background or background_beside(source) or (0.0, 0.0, 0.0)
        notes = write_scene_page(target, splats, shown, color, source.stem)
    else:
        notes = splats.save(target)
    # A note may be about splats that are left out.
    written = len(Splats.load(target)) if notes and not is_page else len(splats)
    return {
        "scene": str(source),
        "target": str(target),
        "splats": written,
        "sh_degree": splats.sh_degree,
        "antialiased": splats.antialiased,
        "bytes_before": source.stat().st_size,
        "bytes": target.stat().st_size,
        "notes": notes,
    }


def _levels(source: Path, target: Path, levels: int) -> tuple[dict[str, Any], list[str]]:
    from igsr.rendering.levels import INDEX, write_levels

    if target.resolve() == Path.cwd().resolve():
        raise IgsrError(f"{target} is the folder that the command runs in; name another")
    written = write_levels(source, target, levels)
    lines = [f"level {level}: {count} splats" for level, count in enumerate(written.counts)]
    cells = "1 cell" if written.cells == 1 else f"{written.cells} cells"
    files = "1 file" if written.files == 1 else f"{written.files} files"
    lines.append(f"{cells} in {files}, {target / INDEX}")
    return {"scene": str(source), "target": str(target), **asdict(written)}, lines
