"""Photos that are missing from a first model: what is looked for, and what becomes of the model."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rooms

from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose.colmap import attempts
from igsr.pose.colmap.attempts import THRESHOLDS, Mapped, mapped
from igsr.pose.colmap.database import image_id, list_photos
from igsr.pose.colmap.estimator import guarded
from igsr.pose.colmap.features import find_features
from igsr.pose.colmap.mapping import extend, map_photos
from igsr.pose.colmap.matching import matched, matched_along_lines, with_focal_lengths, with_matches
from igsr.pose.colmap.result import estimate_of

CAMERAS = [rooms.camera(angle) for angle in np.linspace(-0.4, 0.4, 5)]


def silent(*arguments: object) -> None:
    pass


class Model:
    """Placed photos, as far as ``attempts`` asks a model for them."""

    def __init__(self, *placed: int) -> None:
        self.placed = set(placed)

    def num_reg_images(self) -> int:
        return len(self.placed)

    def reg_image_ids(self) -> list[int]:
        return [image_id(index) for index in self.placed]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[Any, Any, list[Any]]]:
    """Runs ``mapped`` on eight photos with models that the test makes up."""

    def with_models(
        anew: dict[int, Model | None],
        further: dict[int, set[int]],
        more: bool = True,
        with_any: set[int] | None = None,
    ) -> tuple[Any, Any, list[Any]]:
        calls: list[Any] = []

        def make(count: int, database: Path, evidence: Any, *_: object) -> Model | None:
            step = THRESHOLDS.index(evidence)
            calls.append(("anew", step, database.name))
            return anew.get(step)

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


def test_what_is_placed_at_once_is_not_tried_again(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(*range(8))}, {})
    assert calls == [("anew", 0, "matched.db")]
    assert model.num_reg_images() == 8
    assert not doubtful


def test_a_model_that_lacks_few_photos_is_extended(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(0, 1, 2, 3, 4, 5)}, {1: {6}, 2: {7}})
    assert calls == [
        ("anew", 0, "matched.db"),
        ("extend", 1, "matched.db"),
        ("guided", [7]),
        ("extend", 2, "guided.db"),
    ]
    assert model.num_reg_images() == 8
    assert not doubtful


def test_with_lower_thresholds_it_is_made_anew_from_all_pairs(run: Callable[..., Any]) -> None:
    model, doubtful, calls = run({0: Model(*range(6)), 3: Model(*range(7))}, {2: {6}})
    assert calls[3:] == [
        ("extend", 2, "guided.db"),
        ("guided", list(range(8))),
        ("anew", 3, "guided.db"),
        ("anew", 4, "guided.db"),
    ]
    assert model.placed == set(range(7))
    assert not doubtful  # the one with more evidence is kept
    model, doubtful, _ = run({0: Model(*range(6)), 4: Model(*range(8))}, {})
    assert model.num_reg_images() == 8
    assert doubtful


def test_a_model_that_lacks_many_is_made_anew(run: Callable[..., Any]) -> None:
    # Even where a later model lacks few, since it began with less.
    found = {0: Model(0, 1), 1: Model(*range(6)), 2: Model(*range(7)), 3: Model(*range(8))}
    model, doubtful, calls = run(found, {})
    assert calls == [
        ("anew", 0, "matched.db"),
        ("anew", 1, "matched.db"),
        ("guided", list(range(8))),
        ("anew", 2, "guided.db"),
        ("anew", 3, "guided.db"),
    ]
    assert model is found[3]
    assert doubtful


def test_nothing_is_done_for_photos_without_matches(run: Callable[..., Any]) -> None:
    model, _, calls = run({0: Model(0, 1, 2, 3)}, {}, with_any={0, 1, 2, 3})
    assert calls == [("anew", 0, "matched.db")]
    assert model.num_reg_images() == 4


def test_the_same_matches_are_not_mapped_twice(run: Callable[..., Any]) -> None:
    _, _, calls = run({0: Model(0, 1, 2, 3)}, {}, more=False)
    assert [call[1] for call in calls if call[0] == "anew"] == [0, 1, 3, 4]


def test_a_photo_is_added_to_a_model_of_the_others(tmp_path: Path) -> None:
    import pycolmap

    photos = rooms.photos(CAMERAS)
    features = tmp_path / "features.db"
    with guarded(0):
        list_photos(photos, features)
        find_features(photos, tmp_path, features, silent)
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
        told: list[tuple[int, int]] = []
        extend(model, 5, database, THRESHOLDS[0], 0, lambda stage, done, of: told.append((done, of)))
    assert told == [(4, 5), (5, 5)]
    found = estimate_of(photos, Mapped(model, doubtful=False, alike=0))
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 5
    assert accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.5
    assert found.warnings == []

    # With the geometry known, more features match; pairs without a missing photo keep theirs.
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
    """How many matches each pair has."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids, found = opened.read_two_view_geometries()
    return {
        tuple(pycolmap.pair_id_to_image_pair(pair)): len(geometry.inlier_matches)
        for pair, geometry in zip(ids, found, strict=True)
    }
