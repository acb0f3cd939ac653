"""Cameras from a network that tells the truth with known noise, and from features.

    python -m igsr_lab.cameras.all_evidence CAPTURE [CAPTURE ...] [--size 384] [--seed 0]

Each capture has true cameras; depths come from ``depth/train`` of synthetic captures, else from
the nearest of COLMAP's points. A line for each way to find the cameras: COLMAP alone, the network
alone, both together as ``--estimator da3`` does, bundle adjustment although COLMAP places all
photos, and the same with one photo whose depths are wrong. Errors are as in
the study ``poses``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from igsr.capture import Camera, load_capture
from igsr.capture.downscaling import resized_camera
from igsr.capture.photo_folder import Photo, reduced_photo
from igsr.geometry.pose_errors import pose_accuracy
from igsr.geometry.similarity import similarity_between
from igsr.pose import all_evidence
from igsr.pose.colmap import Colmap
from igsr.pose.da3.estimator import Da3
from igsr.pose.estimate import Estimate
from igsr_lab.cameras.noisy_network import NoisyNetwork

#: Depths of COLMAP's points are spread over so many times fewer pixels.
COARSER = 4
#: The photo whose depths are wrong, and by how much: a factor, and noise of its logarithm.
WRONG, FACTOR, NOISE = 2, 2.5, 0.5


def truth(path: Path, size: int) -> tuple[list[Photo], dict[str, Camera], dict[str, np.ndarray]]:
    """Photos at most so large, their true cameras, and the depths [h, w] that are stored."""
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
    """For each photo the depth [h, w] of the nearest point that it shows, in the true world."""
    placed = [k for k, camera in enumerate(found.cameras) if camera is not None]
    similarity = similarity_between(
        [found.cameras[k] for k in placed], [cameras[photos[k].name] for k in placed]
    )
    assert found.points is not None
    assert found.points.tracks is not None
    xyz = similarity.scale * found.points.xyz @ similarity.rotation.T + similarity.translation
    tracks, depths = found.points.tracks, {}
    for k, name in enumerate(tracks.names):
        own, camera = tracks.view == k, cameras[name]
        z = xyz[tracks.point[own]] @ camera.viewmat[2, :3] + camera.viewmat[2, 3]
        rows, columns = np.mgrid[: camera.height // COARSER, : camera.width // COARSER] + 0.5
        nearest = np.full(rows.shape, np.inf)
        depth = np.full(rows.shape, np.nan, np.float32)
        for (x, y), far in zip(tracks.xy[own] / COARSER, z, strict=True):
            apart = (columns - x) ** 2 + (rows - y) ** 2
            depth[apart < nearest] = far
            nearest = np.minimum(nearest, apart)
        depths[name] = depth
    return depths


def main() -> None:
    """Print a line for each capture and way."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--size", type=int, default=384)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    fewest = all_evidence.MIN_PLACED
    for path in asked.captures:
        photos, cameras, depths = truth(path, asked.size)
        true = [cameras[photo.name] for photo in photos]

        def told(way: str, found: list[Camera | None], path=path, true=true) -> None:
            scores = pose_accuracy(found, true)
            placed = sum(camera is not None for camera in found)
            numbers = {name: scores[name] for name in ("rotation", "ATE_relative", "mAA@30")}
            print(path.name, way, f"{placed} of {len(true)} placed", numbers, flush=True)

        by_features = Colmap()(photos, seed=asked.seed)
        told("COLMAP", by_features.cameras)
        depths = depths or depths_of_points(photos, cameras, by_features)
        network = NoisyNetwork(cameras, depths, seed=asked.seed)
        told("network", Da3(network, bundle_adjustment=False)(photos).cameras)
        told("together", Da3(network)(photos).cameras)
        random, name = np.random.default_rng(asked.seed), photos[WRONG].name
        noise = np.exp(NOISE * random.normal(size=depths[name].shape))
        spoiled = {**depths, name: (FACTOR * depths[name] * noise).astype(np.float32)}
        try:
            # COLMAP's model then is no start, and the adjustment has to do it all.
            all_evidence.MIN_PLACED = len(photos) + 1
            told("adjusted", Da3(network)(photos).cameras)
            wrong = NoisyNetwork(cameras, spoiled, seed=asked.seed)
            told("adjusted, one photo's depths wrong", Da3(wrong)(photos).cameras)
        finally:
            all_evidence.MIN_PLACED = fewest


if __name__ == "__main__":
    main()
