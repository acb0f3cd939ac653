"""The committed example is whole, and its cameras agree with its photos."""

from pathlib import Path

import numpy as np
import pytest

from igsr.capture import Capture, load_capture

# Where examples/make_capture.py lays the glazed marble: the only teal thing in the scene.
MARBLE = np.array([0.82, -0.22, 0.085])


@pytest.fixture(scope="module")
def example(example_path: Path) -> Capture:
    return load_capture(example_path)


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


def test_marble_is_seen_where_it_stands(example: Capture) -> None:
    views_from_above = example.train_views[20:]  # nothing stands before the marble there
    for view in views_from_above:
        in_camera = view.camera.viewmat[:3, :3] @ MARBLE + view.camera.viewmat[:3, 3]
        on_image = view.camera.K @ in_camera
        expected = on_image[:2] / on_image[2]
        red, green, blue, alpha = np.moveaxis(view.image.astype(int), -1, 0)
        teal = (green - red > 30) & (abs(green - blue) < 35) & (alpha == 255)
        rows, columns = np.nonzero(teal)
        assert len(rows) > 40
        seen = np.array([np.median(columns), np.median(rows)]) + 0.5
        # Its lit side is seen better than its shaded side, hence the pixels of tolerance.
        assert np.linalg.norm(seen - expected) < 3.0, view.name
