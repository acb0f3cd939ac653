"""``igsr info``: describe a scene or a capture, and list the backends."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from igsr import _core
from igsr.cli.error_messages import error_messages
from igsr.cli.options import JsonOption, MaxSizeOption
from igsr.cli.output import output_console, print_json
from igsr.splats import SPLAT_ENDINGS, Splats


def info_command(
    path: Annotated[Path, typer.Argument(metavar="SCENE|CAPTURE", help="Splat file or capture.")],
    max_size: MaxSizeOption = None,
    as_json: JsonOption = False,
) -> None:
    """Describe a scene or a capture, and this machine's backends."""
    with error_messages():
        report = (
            _scene_info(path)
            if path.suffix.lower() in SPLAT_ENDINGS
            else _capture_info(path, max_size)
        )
        report["backends"] = _backends()
    if as_json:
        print_json(report)
        return
    console = output_console()
    for key, value in report.items():
        if key == "backends":
            for name, device in value.items():
                console.print(f"backend {name}: {device}")
        else:
            console.print(f"{key.replace('_', ' ')}: {_plain(value)}")


def _opacity(logit: float) -> float:
    # tanh does not overflow, unlike exp.
    return 0.5 + 0.5 * math.tanh(0.5 * logit)


def _scene_info(path: Path) -> dict[str, Any]:
    splats = Splats.load(path)
    bounds = splats.without_backdrop().bounds()
    finite = splats.finite
    logit = float(np.median(splats.opacities[finite])) if finite.any() else None
    return {
        "kind": "scene",
        "path": str(path),
        "splats": len(splats),
        "backdrop_splats": splats.backdrop_splats,
        "not_finite": int((~finite).sum()),
        "sh_degree": splats.sh_degree,
        "antialiased": splats.antialiased,
        "lowest_corner": None if bounds is None else bounds[0].tolist(),
        "highest_corner": None if bounds is None else bounds[1].tolist(),
        "origin": splats.origin.tolist(),
        "median_opacity": None if logit is None else _opacity(logit),
        "bytes": path.stat().st_size,
    }


def _finite(number: float) -> float | None:
    """The number, or None if it is not finite (the mean of extreme camera positions overflows)."""
    return float(number) if math.isfinite(number) else None


def _capture_info(path: Path, max_size: int | None) -> dict[str, Any]:
    from igsr.capture import load_capture

    capture = load_capture(path, max_size)
    sizes = sorted({f"{view.camera.width}x{view.camera.height}" for view in capture.views})
    points = None if capture.points is None else len(capture.points.xyz)
    return {
        "kind": "capture",
        "path": str(path),
        "views": len(capture.views),
        "train_views": len(capture.train_views),
        "test_views": len(capture.test_views),
        "sizes": sizes,
        "views_with_alpha": sum(view.image.shape[2] == 4 for view in capture.views),
        "views_with_mask": sum(view.mask is not None for view in capture.views),
        "points": points,
        "scene_centre": [_finite(x) for x in capture.scene_centre],
        "scene_extent": _finite(capture.scene_extent),
    }


def _backends() -> dict[str, str]:
    """Device of each backend, or why it is not available."""
    backends = {}
    for name in ("cpu", "gpu", "reference"):
        try:
            info = _core.backend_info(_core.resolve_backend(name))
            backends[name] = f"{info['device']}, {info['instruction_set']}"
        except RuntimeError as error:
            backends[name] = f"not available: {error}"
    backends["auto"] = _core.resolve_backend("auto")
    return backends


def _plain(value: object) -> str:
    if isinstance(value, list):
        return "  ".join(_plain(item) for item in value)
    return f"{value:.6g}" if isinstance(value, float) else str(value)
