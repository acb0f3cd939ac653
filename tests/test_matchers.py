"""Features and matches that are not SIFT's: in COLMAP's database, verified there."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rooms
import torch
from PIL import Image

import igsr
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose.colmap import Colmap
from igsr.pose.colmap.loma import Loma
from igsr.pose.colmap.matcher import PhotoFeatures
from igsr.pose.find import made_by_of

#: Cameras whose photos are of noise: only the matches tell where they stand.
CAMERAS = [rooms.camera(angle) for angle in np.linspace(-1.0, 1.0, 5)]
POINTS = np.random.default_rng(0).uniform([-2.0, -1.0, 2.0], [2.0, 1.0, 4.0], (300, 3))


def photos(count: int = len(CAMERAS)) -> list[Photo]:
    """A photo for each camera, whose first pixel is its number."""
    made = []
    for i in range(count):
        image = np.random.default_rng(i).integers(0, 256, (180, 240, 3)).astype(np.uint8)
        image[0, 0] = i
        made.append(Photo(f"{i}.png", image))
    return made


@dataclass
class Known:
    """Projects the points into the cameras, and matches those that are the same, with errors."""

    name: str = "known"
    wrong: float = 0.2
    seen: int = 0

    def features(self, photo: Path) -> PhotoFeatures:
        self.seen += 1
        image = np.asarray(Image.open(photo))
        camera = CAMERAS[int(image[0, 0, 0]) % len(CAMERAS)]
        local = POINTS @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = local @ camera.K.T
        return PhotoFeatures(
            (pixels[:, :2] / pixels[:, 2:]).astype(np.float32),
            np.arange(len(POINTS), dtype=np.float32)[:, None],
            (image.shape[1], image.shape[0]),
        )

    def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> np.ndarray:
        _, a, b = np.intersect1d(first.descriptors, second.descriptors, return_indices=True)
        moved = np.arange(len(b)) < self.wrong * len(b)
        b[moved] = np.roll(b[moved], 1)
        return np.stack([a, b], axis=1).astype(np.uint32)


def test_cameras_are_found_from_a_matchers_matches() -> None:
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


def test_masked_pixels_have_no_features() -> None:
    hidden = np.ones((180, 240), dtype=np.bool_)
    hidden[:, :120] = False
    found = Colmap(Known())([replace(photo, mask=hidden) for photo in photos()], seed=0)
    assert found.points is not None
    assert found.points.tracks is not None
    assert found.points.tracks.xy[:, 0].min() >= 120.0


def test_photos_without_matches_are_not_placed() -> None:
    class Nothing(Known):
        def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> np.ndarray:
            return np.zeros((0, 2), dtype=np.uint32)

    found = Colmap(Nothing())(photos(), seed=0)
    assert found.cameras == [None] * 5


@pytest.mark.parametrize(
    "matches",
    [
        np.array([[0, 300]]),
        np.array([[-1, 0]]),
        np.array([[0, 1], [0, 2]]),
        np.array([[0.0, 1.0]]),
        np.array([0, 1]),
    ],
)
def test_matches_that_cannot_be_are_refused(matches: np.ndarray) -> None:
    class Wrong(Known):
        def features(self, photo: Path) -> PhotoFeatures:
            # All 300 in the photo.
            found = super().features(photo)
            return replace(found, xy=np.full((300, 2), 50.0, dtype=np.float32))

        def matches(self, first: PhotoFeatures, second: PhotoFeatures) -> np.ndarray:
            return matches

    with pytest.raises(IgsrError, match=r"^matcher known: matches must be"):
        Colmap(Wrong())(photos(2), seed=0)


def test_features_that_cannot_be_are_refused() -> None:
    class Wrong(Known):
        def features(self, photo: Path) -> PhotoFeatures:
            return replace(super().features(photo), xy=np.zeros((3, 2), dtype=np.float32))

    with pytest.raises(IgsrError, match=r"features of 0\.png must be"):
        Colmap(Wrong())(photos(2), seed=0)


def test_too_many_photos_and_unknown_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(IgsrError, match=r"^matcher known compares every pair of photos: give"):
        Colmap(Known())(photos(61), seed=0)
    with pytest.raises(IgsrError, match="matcher must be sift or loma, not 'orb'"):
        Colmap("orb")
    with pytest.raises(IgsrError, match="needs a name"):
        Colmap(object())
    with pytest.raises(IgsrError, match="matcher is no option of dust3r"):
        igsr.find_cameras(photos(2), "dust3r", matcher="sift")


def test_found_cameras_know_their_matcher() -> None:
    assert made_by_of("colmap", 0, 9, {"matcher": Known()})["options"] == {"matcher": "known"}
    options = {"matcher": "loma", "checkpoint": Path("some") / "file.pth"}
    assert made_by_of("colmap", 0, 9, options)["options"] == {
        "matcher": "loma",
        "checkpoint": str(Path("some") / "file.pth"),
    }


# ---- LoMa ---------------------------------------------------------------------------------------


class Network:
    """LoMa's calls that igsr uses, with features that know what they match."""

    def __init__(self, config: Any) -> None:
        self.cfg = SimpleNamespace(filter_threshold=0.1)
        self.loaded = torch.hub.load_state_dict_from_url("https://example.org/a/loma.pth")

    def detect_and_describe(self, image: str, num_keypoints: int) -> tuple[Any, Any, int, int]:
        found = Known().features(Path(image))
        width, height = found.size
        normal = 2.0 * found.xy / np.array([width, height], dtype=np.float32) - 1.0
        descriptors = torch.from_numpy(found.descriptors)[None]
        return torch.from_numpy(normal)[None], descriptors, height, width

    def __call__(self, xy: Any, other: Any, first: Any, second: Any) -> dict[str, Any]:
        assert xy.abs().max() <= 1.0
        assert other.abs().max() <= 1.0
        return {"scores": (first == second.mT).float()}


def filter_matches(scores: Any, threshold: float) -> tuple[Any, ...]:
    best = scores.max(2)
    return (torch.where(best.values > threshold, best.indices, -1),)


@pytest.fixture
def package(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A package ``loma``, and a folder of torch.hub with its weights."""
    top, inner = ModuleType("loma"), ModuleType("loma.loma")
    top.LoMa, top.LoMaB, inner.filter_matches = Network, lambda: None, filter_matches
    monkeypatch.setitem(sys.modules, "loma", top)
    monkeypatch.setitem(sys.modules, "loma.loma", inner)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    weights = tmp_path / "checkpoints" / "loma.pth"
    weights.parent.mkdir()
    torch.save({"a": torch.zeros(1)}, weights)
    return weights


def test_loma_finds_cameras(package: Path) -> None:
    original = torch.hub.load_state_dict_from_url
    found = Colmap("loma")(photos(), seed=0)
    assert torch.hub.load_state_dict_from_url is original
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 5
    assert accuracy["rotation"] < 0.1


def test_loma_offline_without_its_weights(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("IGSR_OFFLINE", "1")
    Loma()
    package.unlink()
    with pytest.raises(IgsrError, match=r"loma\.pth, and IGSR_OFFLINE is set; put https"):
        Loma()


class Hostile:
    """Runs when it is unpickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (Path("hostile"),))


def test_lomas_weights_run_nothing(
    package: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save({"a": Hostile()}, package)
    original = torch.hub.load_state_dict_from_url
    with pytest.raises(IgsrError, match="weights cannot be fetched or read"):
        Loma()
    assert not Path("hostile").exists()
    assert torch.hub.load_state_dict_from_url is original


def test_loma_without_its_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "loma", None)
    with pytest.raises(IgsrError, match="pip install --no-deps lomatch"):
        Colmap("loma")
