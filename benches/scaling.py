"""What a fit takes, by photos, pixels and splats: measured, fitted, and checked on other fits.

    python benches/scaling.py --out out/scaling [--steps 60]

Each row is a fit in a process of its own, of so many splats that stay as many. The model:

    processor seconds = steps * (a + b pixels + c splats)
    bytes = a + b photos pixels + c splats + d pixels

Both by least squares of relative errors on all rows but the last two, which it is checked on. Then
it says what scenes of 100 to 10 000 photos take in blocks.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import igsr
from igsr._internal.part_usage import Meter
from igsr._internal.worker_processes import in_a_process
from igsr.capture import Capture, View
from igsr.fitting.photo_support import PhotoSupport
from igsr.fitting.presets import settings_for

#: Photos, longest side in pixels, splats. The last two are not fitted to.
ROWS = (
    (40, 96, 2_000),
    (40, 96, 60_000),
    (40, 320, 2_000),
    (40, 320, 60_000),
    (300, 96, 20_000),
    (10, 800, 20_000),
    (10, 800, 200_000),
    (40, 800, 20_000),
    (120, 240, 30_000),
    (20, 640, 120_000),
)
CHECKED = 2


def measured(photos: int, side: int, splats: int, steps: int) -> dict[str, Any]:
    """In a process of its own: processor seconds of the steps, and peak memory of all."""
    import towns

    random = np.random.default_rng(0)
    boxes = towns.houses(2, 2)
    cameras = towns.cameras(2, 2, -(-photos // 4), side, 3 * side // 4)[:photos]
    size = (3 * side // 4, side, 3)
    views = [
        View(f"{k:04d}.png", camera, "train", random.integers(0, 256, size, np.uint8))
        for k, camera in enumerate(cameras)
    ]
    low, high = boxes[:, 0].min(axis=0) - 2.0, boxes[:, 1].max(axis=0) + 2.0
    start = igsr.Splats(
        random.uniform(low, high, (splats, 3)).astype(np.float32),
        np.tile(np.array([1, 0, 0, 0], np.float32), (splats, 1)),
        # Sides that shrink as there are more: about as many lie before a pixel.
        np.full((splats, 3), math.log(4.0 * splats ** (-1.0 / 3.0) * 0.25), np.float32),
        np.full(splats, -1.0, np.float32),
        np.zeros((splats, 9, 3), np.float32),
    )
    meter = Meter()
    igsr.fit(
        Capture(Path("town"), views),
        steps=steps,
        max_splats=splats,
        start=start,
        whole_schedule=True,
        density="fixed",
        transients="off",
        exposure="off",
        coarse_to_fine=False,
        remove_floaters=False,
        backend="cpu",
    )
    used = meter.lap()
    return {
        "photos": photos,
        "pixels": side * size[0],
        "splats": splats,
        "steps": steps,
        "cpu_seconds": round(used.cpu_seconds, 3),
        "peak_memory_bytes": used.peak_memory_bytes,
    }


def time_terms(row: dict[str, Any]) -> list[float]:
    """Of the seconds of a step."""
    return [1.0, row["pixels"], row["splats"]]


def memory_terms(row: dict[str, Any]) -> list[float]:
    """Of the bytes of a fit."""
    return [1.0, row["photos"] * row["pixels"], row["splats"], row["pixels"]]


def fitted(terms: list[list[float]], values: list[float]) -> np.ndarray:
    """Coefficients, none negative, with the least sum of squared relative errors."""
    scaled = np.array(terms) / np.array(values)[:, None]
    used = np.ones(scaled.shape[1], np.bool_)
    found = np.zeros(scaled.shape[1])
    while used.any():
        unit = np.abs(scaled[:, used]).max(axis=0)
        part = np.linalg.lstsq(scaled[:, used] / unit, np.ones(len(values)), rcond=None)[0] / unit
        found[:] = 0.0
        found[used] = part
        if (part >= 0.0).all():
            break
        used[np.flatnonzero(used)[np.argmin(part * unit)]] = False
    return found


def scene(photos: int, time: np.ndarray, memory: np.ndarray) -> dict[str, Any]:
    """What a scene of photos of 1000 x 750 pixels takes in blocks of 250, by the model."""
    blocks = max(1, round(photos / 250))
    each = photos if blocks == 1 else round(1.3 * photos / blocks)
    settings = settings_for("default", PhotoSupport(each, 750_000.0, 12.0, 5.0))
    block = {"photos": each, "pixels": 750_000, "splats": settings.max_splats}
    # They grow to the most there may be in the first half of the steps: three quarters in the mean.
    mean = {**block, "splats": 0.75 * settings.max_splats}
    seconds = settings.steps * float(time @ time_terms(mean))
    # A third of the size, and no more pixels than a block has.
    pixels = min(600e6, 1.2 * 750_000 * photos / blocks)
    coarse_side = max(96, min(333, int((pixels / (0.75 * photos)) ** 0.5)))
    coarse = {"photos": photos, "pixels": 0.75 * coarse_side**2, "splats": 100_000}
    coarse_seconds = settings.steps * float(time @ time_terms(coarse))
    return {
        "photos": photos,
        "blocks": blocks,
        "block_core_hours": round(seconds / 3600, 2),
        "block_gigabytes": round(float(memory @ memory_terms(block)) / 1e9, 2),
        "coarse_core_hours": round(coarse_seconds / 3600, 2),
        "coarse_gigabytes": round(float(memory @ memory_terms(coarse)) / 1e9, 2),
        "splats": blocks * settings.max_splats
        if blocks == 1
        else round(blocks * settings.max_splats / 1.2),
        # Machines of two cores; the coarse fit runs on one of them.
        "hours": {
            machines: round((coarse_seconds + -(-blocks // machines) * seconds) / 2 / 3600, 2)
            for machines in (1, 8, 64)
        },
    }


def main() -> None:
    """Measure, fit, check, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", type=int, default=60)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for row in ROWS:
        rows.append(in_a_process(measured, *row, asked.steps))
        print(json.dumps(rows[-1]), flush=True)
    known = rows[:-CHECKED]
    time = fitted(
        [time_terms(row) for row in known], [r["cpu_seconds"] / r["steps"] for r in known]
    )
    memory = fitted([memory_terms(row) for row in known], [r["peak_memory_bytes"] for r in known])
    for row in rows:
        row["model_cpu_seconds"] = round(row["steps"] * float(time @ time_terms(row)), 3)
        row["model_memory_bytes"] = round(float(memory @ memory_terms(row)))
    found = {
        "rows": rows,
        "seconds_per_step": dict(zip(("step", "pixel", "splat"), time.tolist(), strict=True)),
        "bytes": dict(zip(("fit", "photo_pixel", "splat", "pixel"), memory.tolist(), strict=True)),
        "scenes": [scene(photos, time, memory) for photos in (100, 1000, 10_000)],
    }
    (asked.out / "scaling.json").write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps({key: found[key] for key in found if key != "rows"}, indent=1))
    for row in rows:
        print(json.dumps(row))


if __name__ == "__main__":
    main()
