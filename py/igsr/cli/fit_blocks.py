"""``igsr fit --blocks``: fit a capture in blocks and print the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

from igsr._internal.choices import FitBackend
from igsr.cli.output import (
    output_console,
    parts_line,
    print_files,
    print_json,
    protocol_line,
    score_line,
)
from igsr.errors import IgsrError


def fit_blocks(
    capture: Path,
    out: Path,
    blocks: str,
    ray: str | None,
    settings: dict[str, Any],
    *,
    holdout: int | None,
    max_size: int | None,
    backend: str,
    background: tuple[float, float, float] | None,
    as_json: bool,
) -> None:
    """Fit in blocks and print the report.

    Args:
        capture: photos with cameras.
        out: folder of the run.
        blocks: "auto" or a number.
        ray: address of a Ray cluster, or None.
        settings, holdout, max_size, backend, background: as for ``igsr.fit``.
        as_json: whether to print the report as JSON.

    Raises:
        IgsrError: as ``fit_in_blocks``, or ``blocks`` is not a number.
    """
    from igsr._internal.progress_bar import progress_bar
    from igsr.blocks import BlockOptions, fit_in_blocks
    from igsr.fitting.fitter import fit_device
    from igsr.fitting.presets import default_max_size

    try:
        count = None if blocks == "auto" else int(blocks)
    except ValueError:
        raise IgsrError(f"--blocks must be auto or a whole number, not {blocks!r}.") from None
    name = fit_device(backend)["backend"]
    options = BlockOptions(
        blocks=count,
        ray=ray,
        holdout=holdout,
        max_size=max_size or default_max_size(name, settings["quality"]),
        backend=cast(FitBackend, name),
        settings={key: value for key, value in settings.items() if value is not None},
        background=background,
    )
    with progress_bar(shown=not as_json) as show:
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
    across, seams = report["across_seams"], report["seams"]
    if across["photos"]:
        console.print(f"{across['photos']} of them across borders: PSNR {across['psnr']:.2f} dB")
    if seams:
        console.print(
            f"{seams['photos']} photos across borders: {seams['psnr_joined']:.2f} dB in the joined "
            f"scene, {seams['psnr_alone']:.2f} dB in the block alone"
        )
    console.print(protocol_line(report["protocol"]), style="dim")
    console.print(parts_line(report["parts"]), style="dim")
    print_files(out, ["scene.ply", "report.html", "report.json", "manifest.json"])


def _block_line(block: dict[str, Any]) -> str:
    if not block["fitted"]:
        return f"{block['name']}: not fitted, splats of the coarse fit"
    peak = block["peak_memory_bytes"]
    memory = "" if peak is None else f", {peak / 2**30:.2f} GiB"
    part = block["splats_part"]
    fewer = "" if part == 1.0 else f", with {part:g} of the splats"
    return (
        f"{block['name']}: {block['photos']} photos, {block['splats']} splats, "
        f"{block['seconds']:.1f} s{memory} on {block['host']}{fewer}"
    )
