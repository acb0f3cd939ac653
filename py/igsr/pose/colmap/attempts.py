"""Cameras of as many photos as possible: what is not placed is tried again with more and with less.

Where COLMAP's own thresholds leave few photos out, these ask for more matches of their own, and the
model is extended. Where they leave many out, all photos stand on little: every pair gets more
matches, and the model is made anew.
"""

from __future__ import annotations

import copy
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
#: The largest part of the photos that counts as few.
FEW_MISSING = 0.25


def mapped(count: int, features: Path, seed: int, show: Progress) -> tuple[Any | None, bool]:
    """Match and place photos.

    Args:
        count: of photos.
        features: COLMAP's database of them and their features.
        seed: random seed.
        show: called with "matching" and "mapping", how much is done, and how much there is.

    Returns:
        The model with most photos, or None, and whether it stands on so little evidence that it may
        be wrong.
    """
    matches = matched(count, features, seed, show)
    hopeless = set(range(count)) - with_matches(matches)
    database = with_focal_lengths(matches, seed)
    best: Any | None = None
    best_step = 0
    looked_for: set[int] = set()
    few = False
    for step, evidence in enumerate(STEPS):
        extending = few and step < DOUBTFUL
        if evidence.guided_matching:
            wanted = _missing(best, count) if extending else set(range(count))
            if not wanted <= looked_for:
                looked_for = wanted
                more = matched_along_lines(matches, wanted, show)
                if more is not None:
                    database = with_focal_lengths(more, seed)
                elif _differ_in_matches_alone(STEPS[step - 1], evidence):
                    continue
        if extending:
            model = copy.deepcopy(best)
            extend(model, count, database, evidence, seed, show)
        else:
            model = map_photos(count, database, evidence, seed, show)
        if model is not None and (best is None or model.num_reg_images() > best.num_reg_images()):
            best, best_step = model, step
        lost = _missing(best, count)
        if best is not None and (count > FEW or lost <= hopeless):
            break
        if step == 0:
            few = len(lost) <= FEW_MISSING * count
    show("mapping", count, count)
    return best, best_step >= DOUBTFUL


def _missing(model: Any | None, count: int) -> set[int]:
    """Indices of photos that a model has not placed."""
    placed = set() if model is None else set(model.reg_image_ids())
    return {index for index in range(count) if image_id(index) not in placed}


def _differ_in_matches_alone(before: Evidence, after: Evidence) -> bool:
    return after == replace(before, guided_matching=True)
