"""What depths that photos come with gain: the few-photo protocols with and without them.

    python benches/given_depths.py DATA --out DIR [--seeds N] [--noise 0.02] [--wrong]

DATA holds the scenes of ``igsr study few-photos`` and, in ``blender``, those of ``igsr study
blender8``. None has depths: they are rendered from a fit to all photos of the scene, held-out ones
too, and get smooth noise. So they know more than a sensor would of what few photos leave open, and
the gains are those of good depths. With --wrong, one photo's depths are half too large.

Rows are kept in DIR/rows.jsonl; the same command goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np

import igsr
from igsr.capture import Capture, View
from igsr.fitting.fit_capture import fit_with_cameras
from igsr.rendering.renders import render
from igsr.study.blender import VIEW_IDS
from igsr.study.splits import dtu_views, llff_views, with_train_views

#: Per scene its folder and how its photos are chosen.
SCENES = {
    "fern, 3": ("fern", lambda capture: llff_views(capture, 3)),
    "dtu_scan24, 3": ("dtu_scan24", lambda capture: dtu_views(capture, 3)),
    "tankard, 6": ("tankard", lambda capture: llff_views(capture, 6)),
    "chair, 8": ("blender/chair", lambda capture: with_train_views(capture, VIEW_IDS["75"])),
    "lego, 8": ("blender/lego", lambda capture: with_train_views(capture, VIEW_IDS["75"])),
}
#: Pixels over which noise is alike, and alpha above which a render has a depth.
SMOOTH, OPAQUE = 24, 0.8


def smooth_noise(shape: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """Noise [H, W] of unit variance that is alike within about ``SMOOTH`` pixels."""
    rows, columns = (np.linspace(0.0, size // SMOOTH + 1.0, size) for size in shape)
    knots = random.normal(size=(shape[0] // SMOOTH + 3, shape[1] // SMOOTH + 3))
    above, left = rows.astype(int), columns.astype(int)
    down, right = (rows - above)[:, None], (columns - left)[None]

    def at(i: int, j: int) -> np.ndarray:
        return knots[np.ix_(above + i, left + j)]

    mixed = (1 - down) * ((1 - right) * at(0, 0) + right * at(0, 1))
    mixed += down * ((1 - right) * at(1, 0) + right * at(1, 1))
    return mixed / mixed.std()


def rendered_depths(capture: Capture, out: Path) -> dict[str, np.ndarray]:
    """Per train view the depth [H, W] of a fit to all photos, 0 where it is not opaque."""
    if not out.is_file():
        views = [replace(view, split="train") for view in capture.views]
        splats, fitted = fit_with_cameras(replace(capture, views=views), backend="cpu")
        depths = {}
        for view in fitted.views:
            drawn = render(splats, view.camera, (0.0, 0.0, 0.0), backend="cpu")
            known = drawn.alpha > OPAQUE
            depths[view.name] = np.where(known, drawn.expected_depth, 0.0).astype(np.float32)
        np.savez(out, **{name.replace("/", "|"): depth for name, depth in depths.items()})
    with np.load(out) as stored:
        return {name.replace("|", "/"): stored[name] for name in stored.files}


def main() -> None:
    """Fit what has no row yet, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--noise", type=float, default=0.02)
    parser.add_argument("--wrong", action="store_true")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    file = asked.out / "rows.jsonl"
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    rows = [json.loads(line) for line in lines]
    for scene, (folder, chosen) in SCENES.items():
        whole = igsr.load_capture(asked.data / folder)
        capture = chosen(whole)
        depths = rendered_depths(whole, asked.out / f"{folder.replace('/', '-')}.npz")
        for seed in range(asked.seeds):
            for kind in ("without", "wrong" if asked.wrong else "with"):
                if any((r["scene"], r["seed"], r["kind"]) == (scene, seed, kind) for r in rows):
                    continue
                views = [
                    with_depth(v, depths, seed, asked.noise, kind) for v in capture.train_views
                ]
                if kind == "wrong":
                    assert views[0].depth is not None
                    views[0] = replace(views[0], depth=1.5 * views[0].depth)
                given = replace(capture, views=views + capture.test_views)
                splats = igsr.fit(given, backend="cpu", seed=seed)
                scores = igsr.evaluate(splats, given, backend="cpu")
                row = {"scene": scene, "seed": seed, "kind": kind, "splats": len(splats)}
                rows.append(row | {name: scores[name] for name in ("psnr", "ssim")})
                with file.open("a", encoding="utf-8") as appended:
                    appended.write(json.dumps(rows[-1]) + "\n")
                print(rows[-1], flush=True)
    table(rows)


def with_depth(
    view: View, depths: dict[str, np.ndarray], seed: int, noise: float, kind: str
) -> View:
    """A photo with its noisy depth, or without."""
    if kind == "without":
        return view
    known = depths[view.name]
    random = np.random.default_rng([seed, *view.name.encode()])
    factor = np.exp(noise * smooth_noise(known.shape, random))
    return replace(view, depth=(known * factor).astype(np.float32))


def table(rows: list[dict]) -> None:
    """Print means over seeds, and the paired difference with its standard error over seeds."""
    for scene in SCENES:
        of_scene = {
            kind: {r["seed"]: r["psnr"] for r in rows if (r["scene"], r["kind"]) == (scene, kind)}
            for kind in ("without", "with", "wrong")
        }
        for kind in ("with", "wrong"):
            seeds = sorted(of_scene["without"].keys() & of_scene[kind].keys())
            if seeds:
                gains = [of_scene[kind][seed] - of_scene["without"][seed] for seed in seeds]
                error = np.std(gains, ddof=1) / np.sqrt(len(seeds)) if len(seeds) > 1 else np.nan
                before = np.mean([of_scene["without"][seed] for seed in seeds])
                print(f"{scene}, {kind}: {before:.2f} {np.mean(gains):+.2f} ± {error:.2f} dB")


if __name__ == "__main__":
    main()
