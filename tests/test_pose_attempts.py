"""Attempts to place photos that the first model lacks."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rooms

from igsr.cameras.colmap import attempts
from igsr.cameras.colmap.attempts import THRESHOLDS, Mapped, mapped
from igsr.cameras.colmap.database import image_id, list_photos
from igsr.cameras.colmap.estimator import guarded
from igsr.cameras.colmap.features import find_features
from igsr.cameras.colmap.mapping import extend, map_photos
from igsr.cameras.colmap.matching import (
    matched,
    matched_along_lines,
    with_focal_lengths,
    with_matches,
)
from igsr.cameras.colmap.result import estimate_of
from igsr.geometry.pose_errors import pose_accuracy

CAMERAS = [rooms.camera(angle) for angle in np.linspace(-0.4, 0.4, 5)]


def silent(*arguments: object) -> None:
    pass


class Model:
    """Stands in for COLMAP's model."""

    def __init__(self, *placed: int) -> None:
        self.placed = set(placed)

    def num_reg_images(self) -> int:
        return len(self.placed)

    def reg_image_ids(self) -> list[int]:
        return [image_id(index) for index in self.placed]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Any, Any, list[Any]]]:
    """Run ``mapped`` on eight photos with made-up models; returns its calls, too."""

    def with_models(
        models: dict[int, Model | None],
        further: dict[int, set[int]],
        more: bool = True,
        with_any: set[int] | None = None,
    ) -> tuple[Any, Any, list[Any]]:
        calls: list[Any] = []

        def make(count: int, database: Path, evidence: Any, *_: object) -> Model | None:
            step = THRESHOLDS.index(evidence)
            calls.append(("map", step, database.name))
            return models.get(step)

        def add(model: Model, count: int, database: Path, evidence: Any, *_: object) -> None:
            step = THRESHOLDS.index(evidence)
            calls.append(("extend", step, database.name))
            model.placed |= further.get(step, set())

        def look(matches: Path, missing: set[int], show: object) -> Path | None:
            calls.append(("guided", sorted(missing)))
            return Path("guided.db") if more else None

        monkeypatch.setattr(attempts, "with_focal_lengths", lambda path, seed: path)
        some = sorted(with_any or range(8))
        found = {(image_id(some[0]), image_id(other)): np.zeros((9, 2)) for other in some[1:]}
        monkeypatch.setattr(attempts, "links", lambda path: found)
        monkeypatch.setattr(attempts, "contradictions", lambda model, matches, usable: set())
        monkeypatch.setattr(attempts, "matched_along_lines", look)
        monkeypatch.setattr(attempts, "map_photos", make)
        monkeypatch.setattr(attempts, "extend", add)
        result = mapped(8, Path("matched.db"), 0, silent)
        assert result.removed_pairs == 0
        return result.model, result.doubtful, calls

    return with_models


def test_a_complete_model_is_kept(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(*range(8))}, {})
    assert calls == [("map", 0, "matched.db")]
    assert model.num_reg_images() == 8
    assert not doubtful


def test_a_model_without_few_photos_is_extended(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(0, 1, 2, 3, 4, 5)}, {1: {6}, 2: {7}})
    assert calls == [
        ("map", 0, "matched.db"),
        ("extend", 1, "matched.db"),
        ("guided", [7]),
        ("extend", 2, "guided.db"),
    ]
    assert model.num_reg_images() == 8
    assert not doubtful


def test_with_lower_thresholds_all_photos_are_mapped_again(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(*range(6)), 3: Model(*range(7))}, {2: {6}})
    assert calls[3:] == [
        ("extend", 2, "guided.db"),
        ("guided", list(range(8))),
        ("map", 3, "guided.db"),
        ("map", 4, "guided.db"),
    ]
    assert model.placed == set(range(7))
    assert not doubtful  # the one with more evidence is kept
    model, doubtful, _ = run({0: Model(*range(6)), 4: Model(*range(8))}, {})
    assert model.num_reg_images() == 8
    assert doubtful


def test_a_model_without_many_photos_is_replaced(run: Callable[..., Any]) -> None:
    # Later models are replaced, too, even if they lack few photos.
    found = {0: Model(0, 1), 1: Model(*range(6)), 2: Model(*range(7)), 3: Model(*range(8))}
    model, doubtful, calls = run(found, {})
    assert calls == [
        ("map", 0, "matched.db"),
        ("map", 1, "matched.db"),
        ("guided", list(range(8))),
        ("map", 2, "guided.db"),
        ("map", 3, "guided.db"),
    ]
    assert model is found[3]
    assert doubtful


def test_photos_without_matches_are_not_tried_again(run: Callable[..., Any]) -> None:
    model, _, calls = run({0: Model(0, 1, 2, 3)}, {}, with_any={0, 1, 2, 3})
    assert calls == [("map", 0, "matched.db")]
    assert model.num_reg_images() == 4


def test_the_same_matches_are_not_mapped_twice(run: Callable[..., Any]) -> None:
    _, _, calls = run({0: Model(0, 1, 2, 3)}, {}, more=False)
    assert [call[1] for call in calls if call[0] == "map"] == [0, 1, 3, 4]


def test_a_photo_is_added_to_a_model_of_the_others(tmp_path: Path) -> None:
    import pycolmap

    photos = rooms.photos(CAMERAS)
    features = tmp_path / "features.db"
    with guarded(0):
        list_photos(photos, features)
        find_features(photos, features, silent)
        matches = matched(5, features, 0, silent)
        assert with_matches(matches) == set(range(5))
        database = with_focal_lengths(matches, 0)
        fewer = Path(shutil.copyfile(matches, tmp_path / "fewer.db"))
        with pycolmap.Database.open(fewer) as opened:
            for other in range(4):
                opened.delete_two_view_geometry(image_id(other), image_id(4))
        assert with_matches(fewer) == set(range(4))
        model = map_photos(5, with_focal_lengths(fewer, 0), THRESHOLDS[0], 0, silent)
        assert model.num_reg_images() == 4
        progress: list[tuple[int, int]] = []
        extend(
            model,
            5,
            database,
            THRESHOLDS[0],
            0,
            lambda stage, done, of: progress.append((done, of)),
        )
    assert progress == [(4, 5), (5, 5)]
    found = estimate_of(photos, Mapped(model, doubtful=False, removed_pairs=0))
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 5
    assert accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.5
    assert found.warnings == []

    # With known geometry more features match; pairs without a missing photo keep their matches.
    shown: list[tuple[int, int]] = []
    more = matched_along_lines(database, [4], lambda stage, done, of: shown.append((done, of)))
    before, after = inliers(database), inliers(more)
    assert before.keys() == after.keys()
    with_missing = {pair for pair in after if image_id(4) in pair}
    assert all(after[pair] == before[pair] for pair in after.keys() - with_missing)
    assert sum(after[p] for p in with_missing) > 1.05 * sum(before[p] for p in with_missing)
    assert shown[-1] == (len(with_missing), len(with_missing))
    assert matched_along_lines(database, [], silent) is None


def inliers(database: Path) -> dict[tuple[int, int], int]:
    """Number of matches of each pair."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids, found = opened.read_two_view_geometries()
    return {
        tuple(pycolmap.pair_id_to_image_pair(pair)): len(geometry.inlier_matches)
        for pair, geometry in zip(ids, found, strict=True)
    }
