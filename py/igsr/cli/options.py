"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from igsr.errors import IgsrError

if TYPE_CHECKING:
    from igsr.capture import Capture

#: Panels of the help, below the first.
CAMERAS = "Cameras"
FIT = "Fit"
ADVANCED = "Advanced"

#: Folder of the example capture, in that of the run.
EXAMPLE = "example"
NAMED_COLORS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0), "gray": (0.5, 0.5, 0.5)}

Color = tuple[float, float, float]
RenderBackend = Literal["auto", "cpu", "gpu", "reference"]
FitBackend = Literal["auto", "cpu", "gpu"]
QualityName = Literal["draft", "normal", "high"]
SplitName = Literal["train", "test"]
OnOffAuto = Literal["on", "off", "auto"]


def option(*names: str, help: str, metavar: str | None = None, panel: str | None = None) -> Any:
    """An option of a command, with its help in one line."""
    return typer.Option(*names, help=help, metavar=metavar, rich_help_panel=panel)


BackendOption = Annotated[
    RenderBackend, option("--backend", help="auto: a hardware GPU if available, else the CPU.")
]
FitBackendOption = Annotated[
    FitBackend, option("--backend", help="auto: a hardware GPU if available, else the CPU.")
]
BackgroundOption = Annotated[
    str | None,
    option(
        "--background",
        metavar="COLOR",
        help="Color behind splats and photos with alpha: white, black, gray or R,G,B in 0..1. "
        "Default: white if photos have alpha, else black.",
        panel=ADVANCED,
    ),
]
HoldoutOption = Annotated[
    int | None, option("--holdout", metavar="N", help="Hold out every Nth photo for testing.")
]
MaxSizeOption = Annotated[
    int | None, option("--max-size", metavar="N", help="Maximum side of photos, pixels.")
]
FitSizeOption = Annotated[
    int | None,
    option(
        "--max-size",
        metavar="N",
        help="Maximum side of photos, pixels. Default: 1000 (CPU), 1600 (GPU).",
    ),
]
QualityOption = Annotated[
    QualityName, option("--quality", help="Preset for photo size, steps and number of splats.")
]
ExposureOption = Annotated[
    OnOffAuto, option("--exposure", help="Optimize the exposure of each photo.")
]
ResumeOption = Annotated[bool, option("--resume", help="Continue the run in --out.")]
SeedOption = Annotated[int, option("--seed", metavar="N", help="Random seed.", panel=ADVANCED)]
JsonOption = Annotated[bool, option("--json", help="Print the result as JSON.")]
ExampleOption = Annotated[
    bool, option("--example", help="Use the example photos included in igsr.")
]
EstimatorOption = Annotated[
    str,
    option(
        "--estimator",
        metavar="NAME",
        help="Camera estimator: auto, colmap, dust3r or da3.",
        panel=CAMERAS,
    ),
]
CheckpointOption = Annotated[
    Path | None,
    option("--checkpoint", metavar="FILE", help="Weights for dust3r or da3.", panel=CAMERAS),
]
MatcherOption = Annotated[
    str | None,
    option(
        "--matcher",
        metavar="NAME",
        help="Feature matcher: auto (both if installed), sift or aliked.",
        panel=CAMERAS,
    ),
]
FramesOption = Annotated[
    int, option("--frames", metavar="N", help="Maximum frames of each video.", panel=CAMERAS)
]
AllowMissingOption = Annotated[
    bool,
    option(
        "--allow-missing", help="Continue if fewer than half the photos are placed.", panel=CAMERAS
    ),
]
TransientsOption = Annotated[
    OnOffAuto,
    option("--transients", help="Mask transient objects (people, cars).", panel=FIT),
]
CaptureArgument = Annotated[
    Path, typer.Argument(metavar="CAPTURE", help="Photos with cameras.", show_default=False)
]
PhotosArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="PHOTOS", help="Photos or a video, with or without cameras.", show_default=False
    ),
]


def _scene_file(scene: Path) -> Path:
    if not scene.name:  # such as "." and "/"
        raise IgsrError(f"{scene} is a folder; name a splat file.")
    return scene


SceneArgument = Annotated[
    Path,
    typer.Argument(
        metavar="SCENE",
        help="Splat file: .ply, .splat, .ksplat, .spz, .sog or .glb.",
        callback=_scene_file,
    ),
]


def background_color(text: str | None) -> Color | None:
    """RGB in [0, 1] of ``--background``; None for the default.

    Raises:
        IgsrError: the text is neither a name nor three numbers.
    """
    if text is None:
        return None
    if text in NAMED_COLORS:
        return NAMED_COLORS[text]
    try:
        red, green, blue = (float(part) for part in text.split(","))
        if all(0.0 <= channel <= 1.0 for channel in (red, green, blue)):
            return red, green, blue
    except ValueError:
        pass
    raise IgsrError(
        f"--background must be {', '.join(NAMED_COLORS)} or three numbers in 0..1 such as "
        f"0.2,0.2,0.2, not {text!r}."
    )


def resolved(backend: str) -> Any:
    """The backend that runs: "cpu", "gpu" or "reference".

    Raises:
        RuntimeError: backend gpu was asked for and no adapter answers.
    """
    from igsr import _core

    return _core.resolve_backend(backend)


def load(path: Path, holdout: int | None, max_size: int | None = None) -> Capture:
    """Load a capture, and hold out photos if that is asked for.

    Raises:
        IgsrError: as ``load_capture`` and ``Capture.with_holdout``.
    """
    from igsr.capture import load_capture

    capture = load_capture(path, max_size)
    return capture if holdout is None else capture.with_holdout(holdout)


def photos_or_example(photos: Path | None, is_example: bool, out: Path) -> Path:
    """The photos of the command line, or the example capture, which is written into ``out``.

    Raises:
        IgsrError: neither or both were given, or the example cannot be written.
    """
    if photos is None and not is_example:
        raise IgsrError("PHOTOS is missing; name a folder of photos, or give --example")
    if photos is None:
        from igsr.capture.example import write_example

        return write_example(out / EXAMPLE)
    if is_example:
        raise IgsrError(f"--example stands for PHOTOS; leave {photos} or --example out")
    return photos


def estimator_options(checkpoint: Path | None, matcher: str | None) -> dict[str, Any]:
    """The options of the camera estimator that were given."""
    given = {"checkpoint": checkpoint, "matcher": matcher}
    return {name: value for name, value in given.items() if value is not None}
