"""``igsr clean``: remove floaters from a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from igsr import _core
from igsr._internal.atomic_write import check_writable
from igsr.cli.error_messages import error_messages, nothing_written, print_message
from igsr.cli.options import (
    BackendOption,
    BackgroundOption,
    HoldoutOption,
    JsonOption,
    MaxSizeOption,
    SceneArgument,
    SeedOption,
    background_color,
    load,
    option,
    resolved,
)
from igsr.cli.output import output_console, print_json, removed_line
from igsr.errors import IgsrError
from igsr.splats import Splats

if TYPE_CHECKING:
    from igsr._internal.choices import ResolvedBackend
    from igsr.capture import Capture


def clean_command(
    scene: SceneArgument,
    capture_path: Annotated[
        Path | None,
        option(
            "--capture",
            metavar="CAPTURE",
            help="Photos that SCENE was fitted to. Removes splats that no photo shows or that "
            "masks hide, and floaters in front of the surface. Without it, only very faint and "
            "isolated splats are removed.",
        ),
    ] = None,
    holdout: HoldoutOption = None,
    max_size: MaxSizeOption = None,
    out: Annotated[
        Path | None,
        option(
            "--out",
            metavar="FILE",
            help="Cleaned scene, in any splat format. Default: SCENE's name with .clean.ply.",
        ),
    ] = None,
    seed: SeedOption = 0,
    background: BackgroundOption = None,
    backend: BackendOption = "auto",
    as_json: JsonOption = False,
) -> None:
    """Remove floaters from SCENE: splats that photos do not support, or isolated ones."""
    from igsr.evaluation.scores import default_background
    from igsr.floaters import remove_floaters

    target = scene.with_name(f"{scene.name.split('.')[0]}.clean.ply") if out is None else out
    with error_messages(nothing_written(target)):
        name = resolved(backend)
        splats = Splats.load(scene)
        capture, held_out = None, None
        if capture_path is not None:
            capture = load(capture_path, holdout, max_size)
        elif holdout is not None or max_size is not None:
            unused = "--holdout" if holdout is not None else "--max-size"
            raise IgsrError(f"{unused} needs photos; give --capture, or leave {unused} out.")
        check_writable(target)
        color = background_color(background)
        cleaned = remove_floaters(splats, capture, background=color, seed=seed, backend=name)
        if capture is not None and capture.test_views:
            color = color or default_background(capture)
            held_out = {
                "before": _scores(splats, capture, color, name),
                "after": _scores(cleaned.splats, capture, color, name),
            }
        notes = cleaned.splats.save(target)
    report: dict[str, Any] = {
        "scene": str(scene),
        "out": str(target),
        "capture": None if capture_path is None else str(capture_path),
        "before": len(splats),
        "splats": len(cleaned.splats),
        "removed": cleaned.removed,
        "held_out": held_out,
        "notes": notes,
        "seed": seed,
        **_core.backend_info(name),
    }
    if as_json:
        print_json(report)
        return
    console = output_console()
    console.print(f"{len(cleaned.splats)} splats of {len(splats)}")
    console.print(removed_line(cleaned.removed))
    if held_out is not None:
        before, after = held_out["before"], held_out["after"]
        console.print(
            f"{after['views']} held-out photos: PSNR {before['psnr']:.2f} to {after['psnr']:.2f} "
            f"dB, SSIM {before['ssim']:.4f} to {after['ssim']:.4f}"
        )
    for note in notes:
        print_message(note)
    console.print(str(target), style="dim")


def _scores(
    splats: Splats, capture: Capture, color: tuple[float, float, float], backend: ResolvedBackend
) -> dict[str, Any]:
    """Mean PSNR and SSIM of held-out photos."""
    from igsr.evaluation.quick_scores import mean_of, quick_views

    views = capture.test_views
    return mean_of(list(quick_views(splats, views, color, backend)), len(views))
