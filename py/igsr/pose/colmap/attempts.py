"""Cameras of as many photos as possible: what is not placed is tried again with more and with less.

A model of most photos is kept and extended: photos that are missing ask for more matches of their
own and for lower thresholds, not for the same cameras once more. A smaller model may have begun at
the wrong pair, and is made anew.
"""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Any

from igsr.pose.colmap.database import image_id
from igsr.pose.colmap.evidence import DOUBTFUL, STEPS, Evidence
from igsr.pose.colmap.mapping import extend, map_photos
from igsr.pose.colmap.matching import (
    matched,
    matched_along_lines,
    with_focal_lengths,
    with_matches,
)
from igsr.pose.estimate import Progress

#: Up to this many photos, unregistered ones are tried again.
FEW = 60
#: Steps, and whether a model is made anew where one could be extended. Where thresholds have fallen
#: as far as they do and photos are still missing, another beginning may hold them too.
ATTEMPTS = (*((step, False) for step in range(len(STEPS))), (len(STEPS) - 1, True))


def mapped(
    count: int, features: Path, seed: int, show: Progress
) -> tuple[Any | None, Collection[int]]:
    """Match and place photos.

    Args:
        count: of photos.
        features: COLMAP's database of them and their features.
        seed: random seed.
        show: called with "matching" and "mapping", how much is done, and how much there is.

    Returns:
        The model with most photos, or None, and the indices of photos in it that are placed on so
        little evidence that they may be wrong.
    """
    matches = matched(count, features, seed, show)
    hopeless = set(range(count)) - with_matches(matches)
    database = with_focal_lengths(matches, seed)
    best: Any | None = None
    sure: set[int] = set()
    looked = same = extended = False
    for step, anew in ATTEMPTS:
        evidence = STEPS[step]
        if evidence.guided_matching and not looked:
            looked = True
            more = matched_along_lines(matches, _missing(best, count), show)
            same = more is None
            database = database if more is None else with_focal_lengths(more, seed)
        if same and _differ_in_matches_alone(STEPS[step - 1], evidence):
            continue
        if anew and not extended:
            break
        extended = not anew and best is not None and 2 * best.num_reg_images() > count
        if extended:
            model = copy.deepcopy(best)
            extend(model, count, database, evidence, seed, show)
        else:
            model = map_photos(count, database, evidence, seed, show)
        if model is not None and (best is None or model.num_reg_images() > best.num_reg_images()):
            best = model
            if step < DOUBTFUL:
                sure = set(range(count)) - _missing(best, count)
            elif not extended:
                sure = set()
        if best is not None and (count > FEW or _missing(best, count) <= hopeless):
            break
    show("mapping", count, count)
    return best, sorted(set(range(count)) - _missing(best, count) - sure)


def _missing(model: Any | None, count: int) -> set[int]:
    """Indices of photos that a model has not placed."""
    placed = set() if model is None else set(model.reg_image_ids())
    return {index for index in range(count) if image_id(index) not in placed}


def _differ_in_matches_alone(before: Evidence, after: Evidence) -> bool:
    return after == replace(before, guided_matching=True)
