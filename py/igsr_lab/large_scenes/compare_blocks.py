"""A made-up town fitted whole and in blocks: scores, peak memory, seconds, splats.

    python -m igsr_lab.large_scenes.compare_blocks --out out/blocks [--blocks 2,4]

The town is ``soft_town``; with ``--capture``, other photos take its place. All runs have as many
splats and steps: blocks share the steps of the whole fit, and have a coarse fit of as many steps as
one block before them. Held-out photos are the same for all; "across" are those of them that show a
seam of the run in blocks. The town and the whole fit are not made again where ``--out`` has them.
Writes ``rows.json`` and, for each number of blocks, a picture of the photo across seams that loses
most: photo, whole, blocks.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import igsr
from igsr._internal.part_usage import Meter
from igsr._internal.worker_processes import in_a_process
from igsr.blocks import BlockOptions, fit_in_blocks
from igsr.capture import Capture

HOLDOUT = 8
BLACK = (0.0, 0.0, 0.0)


def split(capture: Capture) -> Capture:
    """Every Nth photo held out, as runs in blocks have it: blurred ones, too."""
    test = set(sorted(view.photo for view in capture.views)[::HOLDOUT])
    views = [
        replace(view, split="test" if view.photo in test else "train") for view in capture.views
    ]
    return Capture(capture.path, views, capture.points)


def whole_fit(
    folder: str, out: str, max_size: int | None, settings: dict[str, Any]
) -> dict[str, Any]:
    """In a process of its own: the fit of all photos at once, and its scores by photo."""
    meter = Meter()
    capture = split(igsr.load_capture(folder, max_size))
    splats = igsr.fit(capture, backend="cpu", **settings)
    used = meter.lap()
    splats.save(Path(out) / "whole.ply")
    scores = igsr.evaluate(splats, capture, background=BLACK, backend="cpu")
    return {
        "splats": len(splats),
        **used.plain(),
        "views": {row["name"]: row["psnr"] for row in scores.views},
    }


def mean(values: list[float]) -> float | None:
    """To hundredths of a dB; None of nothing."""
    return round(float(np.mean(values)), 2) if values else None


def side_by_side(path: Path, capture: Capture, name: str, scenes: list[igsr.Splats]) -> None:
    """Write a photo, and the same view of each scene, as one picture."""
    from PIL import Image

    (view,) = (view for view in capture.views if view.name == name)
    drawn = [igsr.render(scene, view.camera, background=BLACK, backend="cpu") for scene in scenes]
    renders = [np.rint(255.0 * np.clip(one.color, 0.0, 1.0)).astype(np.uint8) for one in drawn]
    picture = Image.fromarray(np.concatenate([view.image[..., :3], *renders], axis=1))
    picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.NEAREST).save(path)


def row_of(report: dict[str, Any], whole: dict[str, Any]) -> dict[str, Any]:
    """What the table has of a run in blocks."""
    by_name = {view["name"]: view["psnr"] for view in report["views"]}
    across = [view["name"] for view in report["views"] if view["across"]]
    blocks = [block for block in report["blocks"] if block["fitted"]]
    return {
        "psnr": mean(list(by_name.values())),
        "across": len(across),
        "across_psnr": mean([by_name[name] for name in across]),
        "across_whole": mean([whole["views"][name] for name in across]),
        "splats": report["splats"],
        "photos": [block["photos"] for block in blocks],
        "pixels": [block.get("pixels") for block in blocks],
        "peak_memory_bytes": report["peak_memory_bytes"],
        "coarse_memory_bytes": report["coarse"]["peak_memory_bytes"],
        "cpu_seconds": round(sum(block["cpu_seconds"] for block in blocks), 1),
        "coarse_cpu_seconds": report["coarse"]["cpu_seconds"],
        "longest_cpu_seconds": max(block["cpu_seconds"] for block in blocks),
        "seams": report["seams"],
        "parts": {name: part["seconds"] for name, part in report["parts"].items()},
    }


def main() -> None:
    """Fit, compare, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--capture", type=Path, default=None)
    parser.add_argument("--max-size", type=int, default=None)
    parser.add_argument("--houses", default="5x3")
    parser.add_argument("--photos", type=int, default=300)
    parser.add_argument("--size", type=int, default=160)
    parser.add_argument("--blocks", default="2,4")
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--max-splats", type=int, default=None)
    parser.add_argument("--transients", default="auto")
    parser.add_argument("--density", default="original")
    asked = parser.parse_args()

    from igsr_lab.large_scenes import soft_town, towns

    folder = asked.capture or asked.out / "town"
    if not folder.is_dir():
        columns, rows = map(int, asked.houses.split("x"))
        size = asked.size, 3 * asked.size // 4
        towns.written(soft_town.soft_town(columns, rows, asked.photos, *size), folder)
    asked.out.mkdir(parents=True, exist_ok=True)
    settings: dict[str, Any] = {"steps": asked.steps, "transients": asked.transients}
    if asked.density != "preset":
        settings["density"] = asked.density
    if asked.max_splats is not None:
        settings["max_splats"] = asked.max_splats
    kept = asked.out / "whole.json"
    if kept.is_file():
        whole = json.loads(kept.read_text())
    else:
        given = str(folder), str(asked.out), asked.max_size, settings
        whole = in_a_process(whole_fit, *given)
        kept.write_text(json.dumps(whole))
    psnr = mean(list(whole["views"].values()))
    found = [{"run": "whole", "psnr": psnr, **{k: whole[k] for k in whole if k != "views"}}]
    print(json.dumps(found[-1]), flush=True)
    capture = split(igsr.load_capture(folder, asked.max_size))
    scenes = [igsr.Splats.load(asked.out / "whole.ply")]
    for count in filter(None, map(int, asked.blocks.split(","))):
        options = BlockOptions(
            blocks=count,
            holdout=HOLDOUT,
            max_size=asked.max_size,
            settings={**settings, "steps": max(1, asked.steps // count)},
            background=BLACK,
        )
        splats, report = fit_in_blocks(folder, asked.out / f"blocks-{count}", options)
        found.append({"run": f"{count} blocks", **row_of(report, whole)})
        print(json.dumps(found[-1]), flush=True)
        loss = {
            view["name"]: whole["views"][view["name"]] - view["psnr"]
            for view in report["views"]
            if view["across"]
        }
        if loss:
            worst = max(loss, key=lambda name: loss[name])
            picture = asked.out / f"blocks-{count}.png"
            side_by_side(picture, capture, worst, [*scenes, splats])
            print(f"{picture}: {worst}, {loss[worst]:.2f} dB less", flush=True)
    (asked.out / "rows.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
