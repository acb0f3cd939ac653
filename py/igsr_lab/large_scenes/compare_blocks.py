"""An artificial town fitted whole and in blocks: scores, peak memory, seconds, splats.

    python -m igsr_lab.large_scenes.compare_blocks --out out/blocks [--blocks 2,4]

The scene is ``soft_town``, or the photos of ``--capture``. All runs have the same number of splats
and steps: blocks share the steps of the whole fit, after a coarse fit with the steps of one block.
Held-out photos are the same for all; "across" are held-out photos that show a seam between blocks.
The town and the whole fit are kept in ``--out``. Writes ``rows.json`` and, for each number of
blocks, a picture of the photo across seams that loses most: photo, whole, blocks.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import igsr
from igsr._internal.json_file import write_json
from igsr._internal.part_usage import Meter
from igsr._internal.worker_processes import in_a_process
from igsr.blocks import BlockOptions, fit_in_blocks
from igsr.capture import Capture
from igsr_lab.large_scenes import soft_town, towns

HOLDOUT = 8
BLACK = (0.0, 0.0, 0.0)


def split(capture: Capture) -> Capture:
    """Hold out every 8th photo, as fits in blocks do: also blurred ones."""
    test = set(sorted(view.photo for view in capture.views)[::HOLDOUT])
    views = [
        replace(view, split="test" if view.photo in test else "train") for view in capture.views
    ]
    return Capture(capture.path, views, capture.points)


def whole_fit(
    folder: str, out: str, max_size: int | None, settings: dict[str, Any]
) -> dict[str, Any]:
    """Fit all photos at once; scores by photo."""
    meter = Meter()
    capture = split(igsr.load_capture(folder, max_size))
    splats = igsr.fit(capture, backend="cpu", **settings).splats
    used = meter.lap()
    splats.save(Path(out) / "whole.ply")
    scores = igsr.evaluate(splats, capture, background=BLACK, backend="cpu")
    views = {row["name"]: row["psnr"] for row in scores.views}
    return {"splats": len(splats), **used.plain(), "views": views}


def mean(values: list[float]) -> float | None:
    """Mean in hundredths of a dB; None of an empty list."""
    return round(float(np.mean(values)), 2) if values else None


def side_by_side(path: Path, capture: Capture, name: str, scenes: list[igsr.Splats]) -> None:
    """Write a photo and the same view of each scene as one picture."""
    (view,) = (view for view in capture.views if view.name == name)
    renders = [igsr.render(scene, view.camera, background=BLACK, backend="cpu") for scene in scenes]
    pictures = [view.image[..., :3], *(render.to_uint8() for render in renders)]
    picture = Image.fromarray(np.concatenate(pictures, axis=1))
    picture.resize((2 * picture.width, 2 * picture.height), Image.Resampling.NEAREST).save(path)


def row_of(report: dict[str, Any], whole: dict[str, Any]) -> dict[str, Any]:
    """The row of a fit in blocks."""
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
    args = parser.parse_args()

    folder = args.capture or args.out / "town"
    if not folder.is_dir():
        columns, rows = map(int, args.houses.split("x"))
        size = args.size, 3 * args.size // 4
        towns.written(soft_town.soft_town(columns, rows, args.photos, *size), folder)
    args.out.mkdir(parents=True, exist_ok=True)
    settings: dict[str, Any] = {"steps": args.steps, "transients": args.transients}
    if args.density != "preset":
        settings["density"] = args.density
    if args.max_splats is not None:
        settings["max_splats"] = args.max_splats
    kept = args.out / "whole.json"
    if not kept.is_file():
        given = str(folder), str(args.out), args.max_size, settings
        write_json(kept, in_a_process(whole_fit, *given))
    whole = json.loads(kept.read_text())
    psnr = mean(list(whole["views"].values()))
    found = [{"run": "whole", "psnr": psnr, **{k: whole[k] for k in whole if k != "views"}}]
    print(json.dumps(found[-1]), flush=True)
    capture = split(igsr.load_capture(folder, args.max_size))
    scene = igsr.Splats.load(args.out / "whole.ply")
    for count in filter(None, map(int, args.blocks.split(","))):
        options = BlockOptions(
            blocks=count,
            holdout=HOLDOUT,
            max_size=args.max_size,
            settings={**settings, "steps": max(1, args.steps // count)},
            background=BLACK,
        )
        splats, report = fit_in_blocks(folder, args.out / f"blocks-{count}", options)
        found.append({"run": f"{count} blocks", **row_of(report, whole)})
        print(json.dumps(found[-1]), flush=True)
        loss = {
            view["name"]: whole["views"][view["name"]] - view["psnr"]
            for view in report["views"]
            if view["across"]
        }
        if loss:
            worst = max(loss, key=lambda name: loss[name])
            picture = args.out / f"blocks-{count}.png"
            side_by_side(picture, capture, worst, [scene, splats])
            print(f"{picture}: {worst}, {loss[worst]:.2f} dB less", flush=True)
    (args.out / "rows.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
