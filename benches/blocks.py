"""A made-up town fitted whole and in blocks: scores, peak memory, seconds, splats.

    python benches/blocks.py --out out/blocks [--houses 5x3] [--each 20] [--size 128] [--blocks 2,4]

The town is that of the tests. Held-out photos are the same for all; "across" are those of them that
show a seam of the run in blocks. Writes ``rows.json`` and prints a table.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import igsr
from igsr._internal.part_usage import Meter
from igsr._internal.worker_processes import in_a_process
from igsr.blocks import BlockOptions, fit_in_blocks

HOLDOUT = 8


def whole_fit(folder: str, out: str, settings: dict[str, Any]) -> dict[str, Any]:
    """In a process of its own: the fit of all photos at once, and its scores by photo."""
    meter = Meter()
    capture = igsr.load_capture(folder).with_holdout(HOLDOUT)
    splats = igsr.fit(capture, backend="cpu", **settings)
    used = meter.lap()
    splats.save(Path(out) / "whole.ply")
    scores = igsr.evaluate(splats, capture, background=(0.0, 0.0, 0.0), backend="cpu")
    return {
        "splats": len(splats),
        **used.plain(),
        "views": {row["name"]: row["psnr"] for row in scores.views},
    }


def mean(values: list[float]) -> float | None:
    """To hundredths of a dB; None of nothing."""
    return round(float(np.mean(values)), 2) if values else None


def main() -> None:
    """Fit, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--houses", default="5x3")
    parser.add_argument("--each", type=int, default=20)
    parser.add_argument("--size", type=int, default=128)
    parser.add_argument("--blocks", default="2,4")
    parser.add_argument("--steps", type=int, default=None)
    parser.add_argument("--max-splats", type=int, default=None)
    parser.add_argument("--skip-whole", action="store_true")
    asked = parser.parse_args()

    import towns

    columns, rows = map(int, asked.houses.split("x"))
    folder = asked.out / "town"
    if not folder.is_dir():
        size = asked.size, 3 * asked.size // 4
        towns.written(towns.town(columns, rows, asked.each, *size), folder)
    given = {"steps": asked.steps, "max_splats": asked.max_splats}
    settings: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    found = []
    whole: dict[str, Any] = {"views": {}}
    if not asked.skip_whole:
        whole = in_a_process(whole_fit, str(folder), str(asked.out), settings)
        psnr = mean(list(whole["views"].values()))
        found.append({"run": "whole", "psnr": psnr, **{k: whole[k] for k in whole if k != "views"}})
        print(json.dumps(found[-1]), flush=True)
    for count in map(int, asked.blocks.split(",")):
        options = BlockOptions(
            blocks=count,
            holdout=HOLDOUT,
            settings=settings,
            background=(0.0, 0.0, 0.0),
        )
        _, report = fit_in_blocks(folder, asked.out / f"blocks-{count}", options)
        across = [view["name"] for view in report["views"] if view["across"]]
        by_name = {view["name"]: view["psnr"] for view in report["views"]}
        blocks = [block for block in report["blocks"] if block["fitted"]]
        found.append(
            {
                "run": f"{count} blocks",
                "psnr": mean(list(by_name.values())),
                "across": len(across),
                "across_psnr": mean([by_name[name] for name in across]),
                "across_whole": mean(
                    [whole["views"][name] for name in across if name in whole["views"]]
                ),
                "splats": report["splats"],
                "photos": [block["photos"] for block in blocks],
                "peak_memory_bytes": report["peak_memory_bytes"],
                "coarse_memory_bytes": report["coarse"]["peak_memory_bytes"],
                "cpu_seconds": round(sum(block["cpu_seconds"] for block in blocks), 1),
                "coarse_cpu_seconds": report["coarse"]["cpu_seconds"],
                "longest_cpu_seconds": max(block["cpu_seconds"] for block in blocks),
                "seams": report["seams"],
                "parts": {name: part["seconds"] for name, part in report["parts"].items()},
            }
        )
        print(json.dumps(found[-1]), flush=True)
    (asked.out / "rows.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
