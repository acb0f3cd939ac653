"""Time, memory and errors of global alignment on exact pointmaps and on ones with wrong depths.

The scene is that of the tests: two spheres on a floor in a dome, cameras on an arc. "smooth" errors
are 5 % in root mean square over blocks of 8 x 8 pixels, and 1 % per pixel; "white" are 5 % per
pixel; each pointmap of each pair has its own.

    python benches/alignment.py --photos 10 --grid 128 --noise smooth
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
from pointmaps import PointmapScene, all_pairs

from igsr.geometry.pose_errors import pose_errors
from igsr.pose.alignment import align
from igsr.pose.alignment.global_alignment import STEPS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--photos", type=int, default=10)
    parser.add_argument("--window", type=int, help="pairs of photos up to this far apart only")
    parser.add_argument("--grid", type=int, default=128, help="pixels of the longer side, 4:3")
    parser.add_argument("--noise", default="exact", choices=["exact", "smooth", "white"])
    parser.add_argument("--steps", type=int, default=STEPS)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    # Grids leave out a row and two columns of the photo.
    size = (4 * (arguments.grid * 3 // 4 + 1), 4 * (arguments.grid + 2))
    arc = 1.2 if arguments.window is None else 6.0
    scene = PointmapScene(arguments.photos, arc=arc, sizes=(size,))
    random = np.random.default_rng(0)

    def spoil(points, confidence, first, photo):
        if arguments.noise == "exact":
            return points, confidence
        error = random.normal(size=confidence.shape)
        if arguments.noise == "smooth":
            height, width = confidence.shape
            blocks = np.kron(random.normal(size=(-(-height // 8), -(-width // 8))), np.ones((8, 8)))
            error = blocks[:height, :width] + 0.2 * error
        return points * np.exp(0.05 * error)[..., None], confidence

    pairs = all_pairs(arguments.photos)
    if arguments.window is not None:
        pairs = [(i, j) for i, j in pairs if abs(i - j) <= arguments.window]
    predictions = scene.predictions(pairs, spoil=spoil)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    marks = [time.process_time()]
    alignment = align(
        predictions,
        scene.photos(),
        steps=arguments.steps,
        progress=lambda stage, done, of: marks.append(time.process_time()),
    )
    marks.append(time.process_time())
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    errors = pose_errors([photo.camera for photo in alignment.photos], scene.cameras)
    focal = alignment.photos[0].camera.K[0, 0] / scene.cameras[0].K[0, 0] - 1.0
    print(
        f"{len(pairs)} pairs, CPU seconds of one thread: {marks[-1] - marks[0]:.1f} "
        f"(start {marks[1] - marks[0]:.1f}, steps {marks[-2] - marks[1]:.1f}), "
        f"{(after - before) / 1024:.0f} MiB on top of the predictions\n"
        f"loss {alignment.start_loss:.3g} -> {alignment.loss:.6g}; rotation "
        f"{errors['rotation']:.4f} degrees, centres {errors['centre']:.4f} units of 4, "
        f"focal length {100 * focal:.3f} %"
    )


if __name__ == "__main__":
    main()
