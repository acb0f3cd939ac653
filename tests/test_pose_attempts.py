"""Attempts to place photos that the first model lacks."""

from __future__ import annotations

import shutil
from pathlib import Path

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


def silent(*arguments):
    pass


class Model:
    """Stands in for COLMAP's model."""

    def __init__(self, *placed):
        self.placed = set(placed)

    def num_reg_images(self):
        return len(self.placed)

    def reg_image_ids(self):
        return [image_id(index) for index in self.placed]


RETRIES = [
    *("map 0 matched", "extend 1 matched", "guided 67", "extend 2 guided"),
    *("guided 01234567", "map 3 guided", "extend 4 guided"),
]


@pytest.mark.parametrize(
    ("models", "further", "options", "expected", "placed", "doubtful"),
    [
        # A complete model is kept.
        ({0: 8}, {}, {}, RETRIES[:1], 8, False),
        # A model without few photos is extended.
        ({0: 6}, {1: {6}, 2: {7}}, {}, [*RETRIES[:2], "guided 7", RETRIES[3]], 8, False),
        # With lower thresholds all photos are mapped again; with more evidence a model is kept.
        ({0: 6, 3: 7}, {2: {6}}, {}, RETRIES, 7, False),
        ({0: 6, 3: 7}, {4: {7}}, {}, RETRIES, 8, True),
        # A model without many photos is replaced; later ones too, even if they lack few photos.
        (
            {0: 2, 1: 6, 2: 7, 3: 8},
            {},
            {},
            ["map 0 matched", "map 1 matched", "guided 01234567", "map 2 guided", "map 3 guided"],
            8,
            True,
        ),
        # Photos without matches are not tried again.
        ({0: 4}, {}, {"linked": 4}, RETRIES[:1], 4, False),
        # The same matches are not mapped twice.
        (
            {0: 4},
            {},
            {"more": False},
            [f"map {n} matched" if n != 2 else "guided 01234567" for n in range(5)],
            4,
            False,
        ),
    ],
)
def test_attempts_of_eight_photos(
    monkeypatch, models, further, options, expected, placed, doubtful
):
    calls = []

    def candidates(task, database, evidence):
        step = THRESHOLDS.index(evidence)
        calls.append(f"map {step} {database.stem}")
        if step in models:
            yield attempts._candidate(Model(*range(models[step])), task.matches)

    def add(model, count, database, evidence, *_):
        step = THRESHOLDS.index(evidence)
        calls.append(f"extend {step} {database.stem}")
        model.placed |= further.get(step, set())

    def agreed(model, matches, database):
        placed = set(model.reg_image_ids())
        return {pair: len(some) for pair, some in matches.items() if placed.issuperset(pair)}

    def look(matches, missing, show):
        calls.append("guided " + "".join(map(str, sorted(missing))))
        return Path("guided.db") if options.get("more", True) else None

    found = {
        (image_id(0), image_id(other)): np.zeros((9, 2))
        for other in range(1, options.get("linked", 8))
    }
    monkeypatch.setattr(attempts, "with_focal_lengths", lambda path, seed: path)
    monkeypatch.setattr(attempts, "links", lambda path: found)
    monkeypatch.setattr(attempts, "contradictions", lambda model, matches, usable: set())
    monkeypatch.setattr(attempts, "agreeing", agreed)
    monkeypatch.setattr(attempts, "_candidates", candidates)
    monkeypatch.setattr(attempts, "has_usual_focals", lambda model, database: True)
    monkeypatch.setattr(attempts, "matched_along_lines", look)
    monkeypatch.setattr(attempts, "extend", add)
    result = mapped(8, Path("matched.db"), 0, silent)
    assert calls == expected
    assert result.model.placed == set(range(placed))
    assert (result.doubtful, result.removed_pairs) == (doubtful, 0)


def test_a_photo_is_added_to_a_model_of_the_others(tmp_path):
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
        progress, shown = [], []
        extend(model, 5, database, THRESHOLDS[0], 0, lambda *step: progress.append(step[1:]))
    assert progress == [(4, 5), (5, 5)]
    found = estimate_of(photos, Mapped(model, doubtful=False, removed_pairs=0))
    accuracy = pose_accuracy(found.cameras, CAMERAS)
    assert accuracy["registered"] == 5
    assert accuracy["RTA@5"] == 1.0
    assert accuracy["rotation"] < 0.5
    assert found.warnings == []

    # With known geometry more features match; pairs without a missing photo keep their matches.
    more = matched_along_lines(database, [4], lambda *step: shown.append(step[1:]))
    before, after = inliers(database), inliers(more)
    assert before.keys() == after.keys()
    with_missing = {pair for pair in after if image_id(4) in pair}
    assert all(after[pair] == before[pair] for pair in after.keys() - with_missing)
    assert sum(after[p] for p in with_missing) > 1.05 * sum(before[p] for p in with_missing)
    assert shown[-1] == (len(with_missing), len(with_missing))
    assert matched_along_lines(database, [], silent) is None

    # Keypoints without descriptors keep their matches.
    pair = image_id(3), image_id(4)
    with pycolmap.Database.open(database) as opened:
        geometry = opened.read_two_view_geometry(*pair)
        keypoints = [opened.read_keypoints(image) for image in pair]
        for image, of_image in zip(pair, keypoints, strict=True):
            opened.update_keypoints(image, np.vstack([of_image, of_image[:1]]))
        added = np.array([[len(of_image) for of_image in keypoints]], dtype=np.uint32)
        geometry.inlier_matches = np.vstack([geometry.inlier_matches, added])
        opened.update_two_view_geometry(*pair, geometry)
    assert inliers(matched_along_lines(database, [4], silent))[pair] == after[pair] + 1


def inliers(database):
    """Number of matches of each pair."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids, found = opened.read_two_view_geometries()
    return {
        tuple(pycolmap.pair_id_to_image_pair(pair)): len(geometry.inlier_matches)
        for pair, geometry in zip(ids, found, strict=True)
    }
