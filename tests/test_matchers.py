"""Custom matchers: their features and matches are verified by COLMAP."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import rooms

import igsr
from igsr.cameras import find
from igsr.cameras.colmap import Colmap
from igsr.cameras.colmap.matcher import PhotoFeatures
from igsr.cameras.colmap.pairs import SIMILAR_LEARNED, similar_pairs
from igsr.cameras.find import CameraSettings
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_accuracy

#: Their photos are noise: only the matcher's matches determine the cameras.
CAMERAS = [rooms.camera(angle) for angle in np.linspace(-1.0, 1.0, 5)]
POINTS = np.random.default_rng(0).uniform([-2.0, -1.0, 2.0], [2.0, 1.0, 4.0], (300, 3))


def photos(count=5):
    """A photo for each camera; its first pixel is its number."""
    made = []
    for i in range(count):
        image = np.random.default_rng(i).integers(0, 256, (180, 240, 3)).astype(np.uint8)
        image[0, 0] = i
        made.append(Photo(f"{i}.png", image))
    return made


@dataclass
class Known:
    """Projects the points into the cameras; some of its matches are wrong."""

    name: str = "known"
    wrong: float = 0.2
    seen: int = 0

    def features(self, image):
        assert image.dtype == np.uint8
        assert image.shape == (180, 240, 3)
        self.seen += 1
        camera = CAMERAS[int(image[0, 0, 0]) % len(CAMERAS)]
        local = POINTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = local @ camera.K.T
        return PhotoFeatures(
            (pixels[:, :2] / pixels[:, 2:]).astype(np.float32),
            np.arange(len(POINTS), dtype=np.float32)[:, None],
            (image.shape[1], image.shape[0]),
        )

    def matches(self, first, second):
        _, a, b = np.intersect1d(first.descriptors, second.descriptors, return_indices=True)
        moved = np.arange(len(b)) < self.wrong * len(b)
        b[moved] = np.roll(b[moved], 1)
        return np.stack([a, b], axis=1).astype(np.uint32)


def test_cameras_are_found_from_the_matches():
    matcher = Known()
    found = Colmap(matcher)(photos(), seed=0)
    assert matcher.seen == len(CAMERAS)
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 5
    assert accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.1
    again = Colmap(Known())(photos(), seed=0)
    for one, other in zip(found.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(one.viewmat, other.viewmat)


def test_masked_pixels_have_no_features():
    hidden = np.ones((180, 240), dtype=np.bool_)
    hidden[:, :120] = False
    found = Colmap(Known())([replace(photo, mask=hidden) for photo in photos()], seed=0)
    assert found.points is not None
    assert found.points.tracks is not None
    assert found.points.tracks.xy[:, 0].min() >= 120.0


def test_photos_without_matches_are_not_placed():
    class Nothing(Known):
        def matches(self, first, second):
            return np.zeros((0, 2), dtype=np.uint32)

    found = Colmap(Nothing())(photos(), seed=0)
    assert found.cameras == [None] * 5


@pytest.mark.parametrize(
    "matches", [[[0, 300]], [[-1, 0]], [[0, 1], [0, 2]], [[0.0, 1.0]], [0, 1]], ids=str
)
def test_invalid_matches_are_errors(matches):
    class Wrong(Known):
        def features(self, image):
            # Put all of them into the photo.
            return replace(super().features(image), xy=np.full((300, 2), 50.0, dtype=np.float32))

        def matches(self, first, second):
            return np.array(matches)

    with pytest.raises(IgsrError, match=r"^matcher known: matches must be"):
        Colmap(Wrong())(photos(2), seed=0)


def test_invalid_features_are_errors():
    class Wrong(Known):
        def features(self, image):
            return replace(super().features(image), xy=np.zeros((3, 2), dtype=np.float32))

    with pytest.raises(IgsrError, match=r"features of 0\.png must be"):
        Colmap(Wrong())(photos(2), seed=0)


def test_unknown_matchers_are_errors():
    with pytest.raises(IgsrError, match="matcher must be auto, sift, aliked or an object with"):
        Colmap(object())
    with pytest.raises(IgsrError, match=r"matcher must be auto, .* not 'surf'"):
        igsr.find_cameras(photos(2), "colmap", matcher="surf")
    with pytest.raises(IgsrError, match="matcher is not an option of estimator dust3r"):
        igsr.find_cameras(photos(2), "dust3r", matcher=Known())


def test_of_many_photos_similar_ones_are_matched():
    turned = [np.roll(np.eye(40, 8, dtype=np.float32), k, axis=1) for k in range(8)]
    descriptors = [np.vstack([turned[k % 8], turned[(k + 1) % 8]]) for k in range(40)]
    pairs = similar_pairs(descriptors)
    assert len(pairs) < 40 * SIMILAR_LEARNED
    assert all(a < b for a, b in pairs)
    assert {photo for pair in pairs for photo in pair} == set(range(40))
    assert len(similar_pairs(descriptors[:12])) == 66


def test_kept_cameras_depend_on_their_matcher_and_on_all_methods(monkeypatch):
    settings = CameraSettings("colmap", {"matcher": Known()})
    assert settings.made_by()["options"] == {"matcher": "known"}
    before = CameraSettings().made_by()
    monkeypatch.setitem(find.METHODS, "colmap", 1000)
    assert CameraSettings().made_by() != before
