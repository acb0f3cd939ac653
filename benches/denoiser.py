"""Seconds of one denoised view and of its parts, and how far float32 is from float64.

A ball of random splats and ten photos of it on a ring, rendered.

    python benches/denoiser.py --size 400 --threads 2 [--weights FILE]
"""

from __future__ import annotations

import argparse
import copy
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from scenes import ring_camera, splats

from igsr.capture import View
from igsr.denoiser import (
    NetworkDenoiser,
    load_network,
    photo_sources,
    photo_support,
    render_buffers,
    warp_photos,
)
from igsr.denoiser.inputs import PHOTOS, network_inputs
from igsr.rendering.renders import render

BACKGROUND = (1.0, 1.0, 1.0)


def least(repeats: int, part: Callable[[], Any]) -> tuple[float, Any]:
    """The fewest seconds of several runs after a first, and what the last gave."""
    out = part()
    fewest = np.inf
    for _ in range(repeats):
        began = time.perf_counter()
        out = part()
        fewest = min(fewest, time.perf_counter() - began)
    return float(fewest), out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=400, help="pixels of each side")
    parser.add_argument("--splats", type=int, default=20_000)
    parser.add_argument("--threads", type=int, default=2, help="of torch; RAYON_NUM_THREADS draws")
    parser.add_argument("--weights", help="default: igsr's own")
    parser.add_argument("--repeats", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    network = load_network(arguments.weights)
    scene = splats(arguments.splats)
    scene.scales -= 1.0
    cameras = [ring_camera(angle, arguments.size) for angle in np.linspace(0.0, 2.0, 10)]
    photos = []
    for k, camera in enumerate(cameras):
        image = render(scene, camera, BACKGROUND, "cpu").to_uint8()
        photos.append(View(f"{k}.png", camera, "train", image))
    support = photo_support(scene, photos, "cpu")
    sources = photo_sources(scene, photos, BACKGROUND, "cpu")
    view = ring_camera(0.1, arguments.size)

    drawing, buffers = least(
        arguments.repeats, lambda: render_buffers(scene, view, support, None, "cpu")
    )
    assert buffers.depth is not None
    assert buffers.alpha is not None
    depth, alpha = buffers.depth, buffers.alpha
    warping, warped = least(
        arguments.repeats, lambda: warp_photos(view, depth, alpha, sources, PHOTOS)
    )
    inputs = network_inputs(buffers, warped)
    cleaner = NetworkDenoiser(network)
    cleaning, _ = least(arguments.repeats, lambda: cleaner.clean(inputs))
    given = torch.from_numpy(inputs)[None]
    with torch.inference_mode():
        exact, _ = copy.deepcopy(network).double()(given.double())
        off = float((network(given)[0] - exact).abs().max())
    print(
        f"{arguments.size}x{arguments.size}, {arguments.threads} threads: draw {drawing:.3f} s, "
        f"warp {len(photos)} photos {warping:.3f} s, network {cleaning:.3f} s, together "
        f"{drawing + warping + cleaning:.3f} s; float32 is within {off:.1e} of float64"
    )


if __name__ == "__main__":
    main()
