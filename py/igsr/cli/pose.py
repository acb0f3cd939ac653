"""``igsr pose``: find the cameras of photos."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from igsr import _core
from igsr._internal.atomic_write import check_folder
from igsr._internal.progress_bar import progress_bar
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import FRAMES
from igsr.cli.error_messages import error_messages, nothing_written, print_message
from igsr.cli.options import (
    CheckpointOption,
    EstimatorOption,
    FramesOption,
    JsonOption,
    MatcherOption,
    MaxSizeOption,
    SeedOption,
    estimator_options,
    option,
)
from igsr.cli.output import output_console, print_json
from igsr.errors import IgsrError


def pose_command(
    photos: Annotated[
        list[Path],
        typer.Argument(
            metavar="PHOTOS...", help="A folder, or photos and videos.", show_default=False
        ),
    ],
    out: Annotated[Path, option("--out", help="New or empty folder for the capture.")],
    estimator: EstimatorOption = "auto",
    checkpoint: CheckpointOption = None,
    matcher: MatcherOption = None,
    graph: Annotated[
        str | None,
        option(
            "--graph",
            metavar="KIND",
            help="Pairs of photos for dust3r: complete, swin-K, logwin-K or oneref-K.",
            panel="Cameras",
        ),
    ] = None,
    frames: FramesOption = FRAMES,
    max_size: MaxSizeOption = None,
    plot: Annotated[
        bool,
        option("--plot", help="Draw the cameras to --out/poses.png, matches to --out/matches.png."),
    ] = False,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find the cameras of PHOTOS; write photos and cameras as a COLMAP capture."""
    with error_messages(nothing_written(out)):
        check_folder(out)
        given = photos[0] if len(photos) == 1 else photos
        if estimator == "auto" and isinstance(given, Path) and holds_cameras(given):
            raise IgsrError(
                f"{given} has cameras; fit it directly, or give --estimator to estimate them again"
            )
        options = estimator_options(checkpoint, matcher) | (
            {} if graph is None else {"graph": graph}
        )
        from igsr.cameras.find import CameraSettings

        settings = CameraSettings(estimator, options, seed, frames)
        with progress_bar(shown=not as_json) as show:
            report = _posed(given, out, settings, max_size, plot, show)
    if as_json:
        print_json(report)
        return
    console = output_console()
    console.print(
        f"{len(report['cameras'])} of {report['photos']} photos placed by {report['estimator']} "
        f"in {report['seconds']:.1f} s, {report['points']} points, seed {seed}"
    )
    drawn = ["poses.png", "matches.png"] if report["placed_by"] else ["poses.png"]
    console.print("  ".join(map(str, [out, *(out / name for name in drawn if plot)])), style="dim")


def _posed(
    photos: Path | list[Path],
    out: Path,
    settings: Any,
    max_size: int | None,
    plot: bool,
    progress: Any,
) -> dict[str, Any]:
    """Find cameras, write the capture, and return the report."""
    from igsr.cameras.find import estimated_cameras, photos_at
    from igsr.cameras.plot_poses import plot_poses
    from igsr.capture.downscaling import check_max_size
    from igsr.capture.write_colmap import write_colmap
    from igsr.evaluation.contact_sheet import panels_sheet, save_sheet
    from igsr.evaluation.shared_points import SIDE_PX, pair_pictures, placed_by

    check_max_size(max_size)
    started = time.monotonic()
    found, loaded = estimated_cameras(photos, settings, progress, max_size)
    for sentence in found.estimate.warnings:
        print_message(sentence)
    path = photos if isinstance(photos, Path) else Path("photos")
    capture = found.capture(path, photos_at(photos, settings.frames, max_size, loaded))
    write_colmap(capture, out, depths=found.depths, further_masks={"trusted": found.trusted})
    tracks = None if capture.points is None else capture.points.tracks
    if plot:
        plot_poses(out / "poses.png", capture)
        pairs = [] if tracks is None else pair_pictures(tracks, capture.views)
        if pairs:
            rows = [[(picture, caption)] for caption, picture in pairs]
            save_sheet(out / "matches.png", panels_sheet(rows, side=2 * SIDE_PX))
    return {
        "estimator": settings.estimator,
        "photos": len(found.names),
        "cameras": [
            {
                "name": view.name,
                "center": view.camera.center.tolist(),
                "focal": [float(view.camera.K[0, 0]), float(view.camera.K[1, 1])],
                "pose_evidence": view.pose_evidence and vars(view.pose_evidence),
            }
            for view in capture.views
        ],
        "not_placed": found.not_placed,
        "placed_by": {} if tracks is None else placed_by(tracks),
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "warnings": found.estimate.warnings,
        "weights": found.estimate.weights,
        "seed": settings.seed,
        "version": _core.__version__,
        "out": str(out),
        "seconds": round(time.monotonic() - started, 3),
    }
