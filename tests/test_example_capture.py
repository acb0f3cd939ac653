"""The committed example is whole, and its cameras agree with its photos."""

from pathlib import Path

import numpy as np
import pytest

from igsr.capture import Capture, View, load_capture


@pytest.fixture(scope="module")
def example(example_path: Path) -> Capture:
    return load_capture(example_path)


def seen_at(points: np.ndarray, view: View) -> tuple[np.ndarray, np.ndarray]:
    """For world points [N,3]: which project onto the object in this photo (bool [N]), and the
    object's outline that those points cast, thickened by one pixel (bool [H,W])."""
    camera = view.camera
    in_camera = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    on_image = in_camera @ camera.K.T
    columns, rows = np.floor(on_image[:, :2] / on_image[:, 2:]).astype(int).T
    inside = (in_camera[:, 2] > 0) & (rows >= 0) & (columns >= 0)
    inside &= (rows < camera.height) & (columns < camera.width)
    cast = np.zeros((camera.height + 2, camera.width + 2), dtype=bool)
    for down in range(3):
        for right in range(3):
            cast[rows[inside] + down, columns[inside] + right] = True
    inside[inside] = view.image[rows[inside], columns[inside], 3] > 0
    return inside, cast[1:-1, 1:-1]


def test_size_and_splits(example: Capture, example_path: Path) -> None:
    assert len(example.train_views) == 40
    assert len(example.test_views) == 8
    for view in example.views:
        assert view.image.shape == (view.camera.height, view.camera.width, 4)
        assert view.image.dtype == np.uint8
        seen = view.image[..., 3] > 0
        assert 0.1 < seen.mean() < 0.6
        # The object is whole in every photo, and nothing hides under full transparency.
        assert seen[1:-1, 1:-1].sum() == seen.sum()
        assert (view.image[~seen] == 0).all()
    size = sum(file.stat().st_size for file in example_path.rglob("*") if file.is_file())
    assert size <= 3_000_000


def test_hull_of_the_train_silhouettes_casts_the_test_silhouettes(example: Capture) -> None:
    """Space carved by the train photos must cast the test photos' outlines: cameras that are turned
    or mirrored would carve the object away."""
    across, up = np.linspace(-1.3, 1.3, 131), np.linspace(-0.5, 0.8, 66)
    points = np.stack(np.meshgrid(across, across, up, indexing="ij"), axis=-1).reshape(-1, 3)
    for view in example.train_views:
        points = points[seen_at(points, view)[0]]
    for view in example.test_views:
        _, cast = seen_at(points, view)
        seen = view.image[..., 3] > 0
        overlap = (cast & seen).sum() / (cast | seen).sum()
        assert overlap > 0.93, f"{view.name}: {overlap:.3f}"
