"""``igsr fit --blocks``: fit a capture in blocks, with a bar for each, and print the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from igsr.cli.shared import output_console, parts_line, print_json, protocol_line, score_line
from igsr.errors import IgsrError


def fit_blocks(
    capture: Path,
    out: Path,
    *,
    blocks: str,
    ray: str | None,
    holdout: int | None,
    max_size: int | None,
    backend: str,
    settings: dict[str, Any],
    background: tuple[float, float, float] | None,
    as_json: bool,
) -> None:
    """Fit in blocks and print the report.

    Args:
        capture: photos with cameras.
        out: folder of the run.
        blocks: "auto" or a number.
        ray: address of a Ray cluster, or None.
        holdout: every so many photos one is held out, or None.
        max_size: longest side in pixels of photos as loaded.
        backend: "cpu" or "gpu".
        settings: keywords of ``igsr.fit`` that are given.
        background: RGB in [0, 1], or None.
        as_json: whether to print the report as JSON.

    Raises:
        IgsrError: as ``fit_in_blocks``, or ``blocks`` is no number.
    """
    from igsr.blocks import BlockOptions, fit_in_blocks
    from igsr.blocks.progress import bars

    try:
        count = None if blocks == "auto" else int(blocks)
    except ValueError:
        raise IgsrError(f"--blocks must be auto or a whole number, not {blocks!r}.") from None
    options = BlockOptions(
        blocks=count,
        ray=ray,
        holdout=holdout,
        max_size=max_size,
        backend=backend,
        settings=settings,
        background=background,
    )
    with bars(shown=not as_json) as show:
        _, report = fit_in_blocks(capture, out, options, show)
    if as_json:
        print_json(report)
        return
    console = output_console()
    console.print(
        f"{report['splats']} splats in {len(report['blocks'])} blocks on {report['backend']} "
        f"({report['instruction_set']}), {', '.join(report['hosts'])}"
    )
    for block in report["blocks"]:
        console.print(_block_line(block), style="dim")
    console.print(score_line(report))
    if report["across_seams"]["photos"]:
        across = report["across_seams"]
        console.print(f"{across['photos']} of them across seams: PSNR {across['psnr']:.2f} dB")
    if report["seams"]:
        console.print(_seam_line(report["seams"]))
    console.print(protocol_line(report["protocol"]), style="dim")
    console.print(parts_line(report["parts"]), style="dim")
    names = ["scene.ply", "report.html", "report.json", "manifest.json"]
    console.print("  ".join(str(out / name) for name in names), style="dim")


def _block_line(block: dict[str, Any]) -> str:
    if not block["fitted"]:
        return f"{block['name']}: not fitted, as coarse as it was"
    peak = block["peak_memory_bytes"]
    memory = "" if peak is None else f", {peak / 2**30:.2f} GiB"
    less = "" if block["splats_part"] == 1.0 else f", with {block['splats_part']:g} of the splats"
    return (
        f"{block['name']}: {block['photos']} photos, {block['splats']} splats, "
        f"{block['seconds']:.1f} s{memory} on {block['host']}{less}"
    )


def _seam_line(seams: dict[str, Any]) -> str:
    return (
        f"seams: what blocks have of {seams['photos']} photos across them scores "
        f"{seams['psnr_joined']:.2f} dB joined, {seams['psnr_alone']:.2f} dB by the block alone"
    )
