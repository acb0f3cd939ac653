"""What commands print."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

#: Kinds of floaters, as ``igsr.floaters.Cleaned`` names them, in words.
_FLOATERS = {
    "unseen": "that no photo shows",
    "masked": "that masks hide",
    "floating": "floating in front of the surface",
    "invisible": "too faint to be drawn",
    "alone": "with few neighbors",
}


def error_console() -> Console:
    """The console for progress: stderr."""
    from igsr._internal.plain_console import PlainConsole

    return PlainConsole(sys.stderr)


def output_console() -> Console:
    """The console for results: stdout, without line breaks inside long paths."""
    from igsr._internal.plain_console import PlainConsole

    return PlainConsole(sys.stdout, soft_wrap=True)


def print_json(value: dict[str, Any]) -> None:
    """Print one JSON object on stdout."""
    import json

    print(json.dumps(value, indent=2, allow_nan=False))


def print_files(out: Path, names: list[str]) -> None:
    """Print the paths of those files that exist in a folder."""
    paths = [str(out / name) for name in names if (out / name).exists()]
    output_console().print("  ".join(paths), style="dim")


def score_line(scores: dict[str, Any]) -> str:
    """Mean scores in one line."""
    ms_ssim = "-" if scores["ms_ssim"] is None else f"{scores['ms_ssim']:.4f}"
    return (
        f"PSNR {scores['psnr']:.2f} dB   SSIM {scores['ssim']:.4f}   MS-SSIM {ms_ssim}   "
        f"FLIP {scores['flip']:.4f}   color-corrected PSNR {scores['cc_psnr']:.2f} dB "
        f"SSIM {scores['cc_ssim']:.4f}"
    )


def fitted_line(train: dict[str, Any]) -> str:
    """Scores of fitted photos in one line; ``train`` as in reports."""
    of = "" if train["views"] == train["of"] else f", {train['views']} of {train['of']}"
    return f"fitted photos{of}: PSNR {train['psnr']:.2f} dB   SSIM {train['ssim']:.4f}"


def parts_line(parts: dict[str, dict[str, Any]]) -> str:
    """Seconds and peak memory of each part in one line; ``parts`` as in reports."""
    texts = []
    for name, part in parts.items():
        peak = part["peak_memory_bytes"]
        memory = "" if peak is None else f" {peak / 2**30:.1f} GiB"
        texts.append(f"{name} {part['seconds']:.1f} s{memory}")
    return ", ".join(texts)


def removed_line(removed: dict[str, int]) -> str:
    """Number of removed floaters by kind, in one line."""
    kinds = (f"{count} {_FLOATERS[kind]}" for kind, count in removed.items())
    return f"removed {sum(removed.values())} splats: {', '.join(kinds)}"


def masked_line(masked: dict[str, float], photos: int) -> str:
    """Number of photos with masked transient objects, in one line."""
    largest = max(masked, key=lambda name: masked[name])
    return (
        f"transient objects masked in {len(masked)} of {photos} photos, at most "
        f"{100.0 * masked[largest]:.1f} % ({largest})"
    )


def protocol_line(protocol: dict[str, Any]) -> str:
    """How views were scored, in one line; ``protocol`` as ``Scores.protocol``."""
    from igsr.cli.options import NAMED_COLORS

    background = tuple(protocol["background"])
    names = {color: name for name, color in NAMED_COLORS.items()}
    behind = names.get(background) or ",".join(f"{channel:g}" for channel in background)
    some = f" of {protocol['of']}" if "of" in protocol else ""
    plural = "" if protocol["views"] == 1 else "s"
    return (
        f"scored on {protocol['views']}{some} {protocol['split']} view{plural} over {behind}, "
        f"{protocol['pixels']}"
    )
