"""``igsr pose``: find the cameras of photos."""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as ProgressBar

from igsr import _core
from igsr._internal.atomic_write import check_folder
from igsr._internal.part_usage import Parts
from igsr.capture import Capture
from igsr.capture.downscaling import check_max_size
from igsr.capture.load import Overview, holds_cameras, look_at
from igsr.capture.photo_folder import FRAMES
from igsr.capture.write_colmap import write_colmap
from igsr.cli.error_messages import error_messages, print_message, warning_messages
from igsr.cli.shared import (
    JsonOption,
    MaxSizeOption,
    SeedOption,
    error_console,
    load,
    output_console,
    print_json,
    stopped,
)
from igsr.errors import IgsrError
from igsr.pose import AUTO, find_cameras, has_found, kept_cameras, kept_capture, photos_at
from igsr.pose.registry import ESTIMATORS

if TYPE_CHECKING:
    from igsr.fitting.followed_run import FollowedRun

logger = logging.getLogger(__name__)

FramesOption = Annotated[int, typer.Option("--frames", help="Most frames taken from each video.")]


EstimatorOption = Annotated[
    str,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help=f"What finds the cameras: {', '.join(ESTIMATORS)}, or auto: dust3r where its weights "
        "are found, else da3 where its are, else colmap.",
    ),
]


CheckpointOption = Annotated[
    Path | None,
    typer.Option("--checkpoint", metavar="FILE", help="For dust3r and da3: the weights."),
]


GraphOption = Annotated[
    str | None,
    typer.Option(
        "--graph",
        metavar="KIND",
        help="For dust3r: which pairs of photos it sees: complete, swin-K, logwin-K or oneref-K.",
    ),
]


MatcherOption = Annotated[
    str | None,
    typer.Option(
        "--matcher",
        metavar="NAME",
        help="For colmap and da3: what finds and matches features: sift, or loma (a network that "
        "matches photos from further apart; needs the package lomatch).",
    ),
]


AllowMissingOption = Annotated[
    bool,
    typer.Option(
        "--allow-missing",
        help="Go on where the cameras of fewer than half of the photos are found.",
    ),
]


@dataclass(frozen=True)
class CameraFinder:
    """The options that say how cameras are found.

    Attributes:
        estimator: a name of ``igsr.pose.registry.ESTIMATORS``, or "auto".
        checkpoint: weights of the estimator's network, or None.
        graph: which pairs of photos dust3r sees, or None for its default.
        matcher: of colmap, or None for its default.
        frames: most frames taken from each video.
        seed: of everything random.
    """

    estimator: str
    checkpoint: Path | None
    graph: str | None
    matcher: str | None
    frames: int
    seed: int

    @property
    def options(self) -> dict[str, Any]:
        """Keywords for the estimator itself: those that were given."""
        given = {"checkpoint": self.checkpoint, "graph": self.graph, "matcher": self.matcher}
        return {name: value for name, value in given.items() if value is not None}


def _check_out(out: Path) -> None:
    """Find an --out that cannot be a folder, before anything slow."""
    existing = next((path for path in (out, *out.parents) if path.exists()), None)
    if existing is not None and not existing.is_dir():
        raise IgsrError(f"--out {out}: {existing} is a file; name a folder.")


def capture_to_fit(
    path: Path,
    out: Path,
    holdout: int | None,
    finder: CameraFinder,
    *,
    max_size: int | None,
    allow_missing: bool,
    resume: bool,
    shown: bool,
    splats: int = 0,
    parts: Parts | None = None,
    announced: Callable[[Overview, bool], None] | None = None,
    followed: FollowedRun | None = None,
) -> tuple[Capture, bool]:
    """Load the capture at a path; find the cameras first if it has none.

    Cameras that are found are kept in ``out/capture``.

    Args:
        path: a capture, a folder of photos, or a video.
        out: the folder of the fit.
        holdout: hold out every ``holdout``-th view for testing, or None.
        finder: how to find the cameras.
        max_size: longest side, in pixels, of photos as loaded, or None.
        allow_missing: whether to go on with fewer than half of the photos.
        resume: use cameras that an earlier run found.
        shown: whether progress is shown.
        splats: most splats of the fit, for the memory that it needs.
        parts: count what "cameras" and "load" take, or None.
        announced: called before anything slow, with what there is and whether cameras are known.
        followed: told what finding cameras does, or None.

    Returns:
        The capture, and whether its cameras were found here (or by the run that is resumed).

    Raises:
        IgsrError: the capture cannot be loaded, its cameras cannot be found, or options that find
            cameras were given for a capture that has them.
    """
    _check_out(out)
    check_max_size(max_size)
    parts = Parts() if parts is None else parts
    seen = look_at(path, finder.frames, max_size)
    seen.train_photos(holdout)
    if seen.has_cameras and (finder.options or finder.estimator != AUTO):
        raise IgsrError(
            f"{path} has cameras, or no photos; leave --estimator, --checkpoint, --graph and "
            "--matcher out"
        )
    if not seen.has_cameras:
        kept_cameras(path, out)
    seen.check_memory(max_size, splats)
    if announced is not None:
        announced(seen, seen.has_cameras or has_found(path, out))
    if seen.has_cameras:
        with parts.measured("load"):
            return load(path, holdout, max_size), False
    with _pose_bar(shown) as show:

        def progress(step: str, done: int, total: int) -> None:
            show(step, done, total)
            if followed is not None:
                followed.tell(f"find cameras: {step}", 0.0)

        capture = kept_capture(
            path,
            out,
            estimator=finder.estimator,
            seed=finder.seed,
            frames=finder.frames,
            options=finder.options,
            max_size=max_size,
            resume=resume,
            allow_missing=allow_missing,
            progress=progress,
            say=print_message,
            warn=print_message,
            parts=parts,
        )
    return (capture if holdout is None else capture.with_holdout(holdout)), True


def pose_command(
    photos: Annotated[
        list[Path],
        typer.Argument(metavar="PHOTOS", help="A folder of photos, or photos and videos."),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder for the capture; it must be new or empty.")
    ],
    estimator: EstimatorOption = AUTO,
    checkpoint: CheckpointOption = None,
    graph: GraphOption = None,
    matcher: MatcherOption = None,
    max_size: MaxSizeOption = None,
    plot: Annotated[
        bool, typer.Option("--plot", help="Draw cameras and points to --out/poses.png.")
    ] = False,
    frames: FramesOption = FRAMES,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Find the cameras of PHOTOS and write photos and cameras as a COLMAP capture."""
    with error_messages(lambda: "Interrupted; nothing is written."), warning_messages():
        check_folder(out)
        check_max_size(max_size)
        started = time.monotonic()
        given = photos[0] if len(photos) == 1 else photos
        if estimator == AUTO and isinstance(given, Path) and holds_cameras(given):
            raise IgsrError(
                f"{given} has cameras already; fit it as it is, or name an --estimator to find "
                "them again"
            )
        finder = CameraFinder(estimator, checkpoint, graph, matcher, frames, seed)
        report = _posed(given, out, finder, max_size=max_size, plot=plot, shown=not as_json)
        report["seconds"] = round(time.monotonic() - started, 3)
    if as_json:
        print_json(report)
        return
    console = output_console()
    console.print(
        f"{len(report['cameras'])} of {report['photos']} photos registered by "
        f"{report['estimator']} in {report['seconds']:.1f} s, {report['points']} points, "
        f"seed {seed}"
    )
    console.print("  ".join([str(out), *([str(out / "poses.png")] if plot else [])]), style="dim")


def _posed(
    photos: Path | list[Path],
    out: Path,
    finder: CameraFinder,
    *,
    max_size: int | None,
    plot: bool,
    shown: bool,
) -> dict[str, Any]:
    """Find cameras, write the capture, and return the report of ``igsr pose``."""
    from igsr.pose.plot_poses import plot_poses

    logger.info("finding the cameras of %s with estimator %s", photos, finder.estimator)
    with _pose_bar(shown) as show:
        found, held = find_cameras(
            photos,
            finder.estimator,
            seed=finder.seed,
            frames=finder.frames,
            max_size=max_size,
            progress=show,
            **finder.options,
        )
    for sentence in found.estimate.warnings:
        print_message(sentence)
    capture = found.capture(
        photos if isinstance(photos, Path) else Path("photos"),
        photos_at(photos, finder.frames, max_size, held),
    )
    write_colmap(capture, out, depths=found.depths, further_masks={"trusted": found.trusted})
    if plot:
        plot_poses(out / "poses.png", capture)
    return {
        "estimator": found.made_by["estimator"],
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
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "warnings": found.estimate.warnings,
        "weights": found.estimate.weights,
        "seed": finder.seed,
        "version": _core.__version__,
        "out": str(out),
    }


@contextlib.contextmanager
def _pose_bar(shown: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A progress bar on stderr, a line for each stage of finding cameras."""
    bar = ProgressBar(
        TextColumn("{task.description} {task.completed}/{task.total}"),
        BarColumn(bar_width=30),
        TimeRemainingColumn(compact=True),
        console=error_console(),
        disable=not shown,
        transient=True,
    )
    tasks: dict[str, Any] = {}
    with stopped(bar):

        def show(stage: str, done: int, total: int) -> None:
            bar.start()
            if stage not in tasks:
                tasks[stage] = bar.add_task(stage, total=total)
            bar.update(tasks[stage], completed=done, total=total)

        yield show
