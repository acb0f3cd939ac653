"""Cameras from a network with known noise, and from features.

    python -m igsr_lab.cameras.all_evidence CAPTURE [CAPTURE ...] [--size 384] [--seed 0]

Captures have true cameras. Depths are read from ``depth/train`` of synthetic captures, else they
are the nearest of COLMAP's points. A line is printed for each way to find cameras: COLMAP, the
network, both as ``--estimator da3``, bundle adjustment although COLMAP places all photos, and the
same with wrong depths of one photo. Errors are measured as in the study ``poses``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from igsr.cameras import all_evidence
from igsr.cameras.colmap import Colmap
from igsr.cameras.da3.estimator import Da3
from igsr.cameras.estimate import Estimate
from igsr.capture import Camera, load_capture
from igsr.capture.downscaling import resized_camera
from igsr.capture.photo_folder import Photo, reduced_photo
from igsr.geometry.pose_errors import pose_accuracy
from igsr.geometry.similarity import similarity_between
from igsr_lab.cameras.noisy_network import NoisyNetwork

#: Reduction of depth maps from COLMAP's points.
REDUCTION = 4
#: Photo with wrong depths, their factor, and the noise of their logarithm.
WRONG_PHOTO, WRONG_FACTOR, WRONG_NOISE = 2, 2.5, 0.5


def truth(path: Path, size: int) -> tuple[list[Photo], dict[str, Camera], dict[str, np.ndarray]]:
    """Load photos of at most ``size`` pixels, their true cameras, and stored depths [h, w]."""
    views = load_capture(path).train_views
    photos = [
        reduced_photo(Photo(view.name, view.image, view.mask, device="one"), size) for view in views
    ]
    cameras = {
        photo.name: resized_camera(view.camera, photo.image.shape[1], photo.image.shape[0])
        for photo, view in zip(photos, views, strict=True)
    }
    folder = path / "depth" / "train"
    depths = {}
    if folder.is_dir():
        depths = {view.name: np.load(folder / f"{Path(view.name).stem}.npy") for view in views}
    return photos, cameras, depths


def depths_of_points(
    photos: list[Photo], cameras: dict[str, Camera], found: Estimate
) -> dict[str, np.ndarray]:
    """Depth of the nearest visible point for each pixel [h, w], in the true world."""
    placed = [k for k, camera in enumerate(found.cameras) if camera is not None]
    similarity = similarity_between(
        [found.cameras[k] for k in placed], [cameras[photos[k].name] for k in placed]
    )
    xyz = similarity.scale * found.points.xyz @ similarity.rotation.T + similarity.translation
    tracks, depths = found.points.tracks, {}
    for k, name in enumerate(tracks.names):
        own, camera = tracks.view == k, cameras[name]
        z = xyz[tracks.point[own]] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        rows, columns = np.mgrid[: camera.height // REDUCTION, : camera.width // REDUCTION] + 0.5
        nearest = np.full(rows.shape, np.inf)
        depth = np.full(rows.shape, np.nan, np.float32)
        for (x, y), far in zip(tracks.xy[own] / REDUCTION, z, strict=True):
            apart = (columns - x) ** 2 + (rows - y) ** 2
            depth[apart < nearest] = far
            nearest = np.minimum(nearest, apart)
        depths[name] = depth
    return depths


def print_errors(path: Path, way: str, found: list[Camera | None], true: list[Camera]) -> None:
    """Print a line about found cameras."""
    scores = pose_accuracy(found, true)
    placed = sum(camera is not None for camera in found)
    numbers = {name: scores[name] for name in ("rotation", "ATE_relative", "mAA@30")}
    print(path.name, way, f"{placed} of {len(true)} placed", numbers, flush=True)


def compare(path: Path, size: int, seed: int) -> None:
    """Find the cameras of a capture in all ways."""
    photos, cameras, depths = truth(path, size)
    true = [cameras[photo.name] for photo in photos]
    by_features = Colmap()(photos, seed=seed)
    print_errors(path, "COLMAP", by_features.cameras, true)
    depths = depths or depths_of_points(photos, cameras, by_features)
    network = NoisyNetwork(cameras, depths, seed=seed)
    alone = Da3(network, bundle_adjustment=False)(photos).cameras
    print_errors(path, "network", alone, true)
    print_errors(path, "together", Da3(network)(photos).cameras, true)
    random, name = np.random.default_rng(seed), photos[WRONG_PHOTO].name
    noise = np.exp(WRONG_NOISE * random.normal(size=depths[name].shape))
    spoiled = {**depths, name: (WRONG_FACTOR * depths[name] * noise).astype(np.float32)}
    minimum = all_evidence.FEWEST_PLACED
    try:
        # COLMAP's model is not used as a start then.
        all_evidence.FEWEST_PLACED = len(photos) + 1
        print_errors(path, "adjusted", Da3(network)(photos).cameras, true)
        wrong = Da3(NoisyNetwork(cameras, spoiled, seed=seed))(photos).cameras
        print_errors(path, "adjusted, one photo's depths wrong", wrong, true)
    finally:
        all_evidence.FEWEST_PLACED = minimum


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for path in args.captures:
        compare(path, args.size, args.seed)


if __name__ == "__main__":
    main()
