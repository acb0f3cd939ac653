"""Cameras of as many photos as possible: what is not placed is tried again with more and with less.

Where COLMAP's own thresholds leave few photos out, these ask for more matches of their own, and the
model is extended. Where they leave many out, all photos stand on little: every pair gets more
matches, and the model is made anew. A model that contradicts its photos is made anew, too, without
the matches that cannot all be right (``contradictions``).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from igsr.pose.colmap.contradictions import (
    Pair,
    contradictions,
    leave_out,
    links,
    links_between_parts,
)
from igsr.pose.colmap.database import image_id
from igsr.pose.colmap.evidence import DOUBTFUL, STEPS, Evidence
from igsr.pose.colmap.mapping import extend, map_photos
from igsr.pose.colmap.matching import (
    matched,
    matched_along_lines,
    with_focal_lengths,
)
from igsr.pose.estimate import Progress

#: Up to this many photos, unregistered ones are tried again.
FEW = 60
#: The largest part of the photos that counts as few.
FEW_MISSING = 0.25
#: A model is made so often without matches that contradict others, at most.
MOST_PARTINGS = 4


@dataclass(frozen=True)
class Mapped:
    """The model with most photos, and what is to be said of it.

    Attributes:
        model: pycolmap's, or None if no two photos can be placed.
        doubtful: whether it stands on so little evidence that it may be wrong.
        alike: number of pairs of photos whose matches were left out, since they contradict others.
    """

    model: Any | None
    doubtful: bool
    alike: int


def mapped(count: int, features: Path, seed: int, show: Progress) -> Mapped:
    """Match and place photos.

    Args:
        count: of photos.
        features: COLMAP's database of them and their features.
        seed: random seed.
        show: called with "matching" and "mapping", how much is done, and how much there is.
    """
    matches = matched(count, features, seed, show)
    strengths = {pair: len(found) for pair, found in links(matches).items()}
    all_links = len(strengths)
    hopeless = set(range(count)) - {image - image_id(0) for pair in strengths for image in pair}
    source, database = matches, with_focal_lengths(matches, seed)
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
                    source, database = more, with_focal_lengths(more, seed)
                elif _differ_in_matches_alone(STEPS[step - 1], evidence):
                    continue

        def model_of(database: Path, base: Any = best if extending else None) -> Any | None:
            if base is None:
                return map_photos(count, database, evidence, seed, show)  # noqa: B023
            model = copy.deepcopy(base)
            extend(model, count, database, evidence, seed, show)  # noqa: B023
            return model

        model = model_of(database)
        for _ in range(MOST_PARTINGS):
            wrong = _wrong_links(model, source, strengths)
            if not wrong:
                break
            for pair in wrong:
                del strengths[pair]
            for file in {matches, source}:
                leave_out(file, wrong)
            database = with_focal_lengths(source, seed)
            model = model_of(database)
        if model is not None and (best is None or model.num_reg_images() > best.num_reg_images()):
            best, best_step = model, step
        lost = _missing(best, count)
        if best is not None and (count > FEW or lost <= hopeless):
            break
        if step == 0:
            few = len(lost) <= FEW_MISSING * count
    show("mapping", count, count)
    return Mapped(best, best_step >= DOUBTFUL, all_links - len(strengths))


def _wrong_links(model: Any | None, source: Path, strengths: dict[Pair, int]) -> set[Pair]:
    """Pairs of photos whose matches make a model contradict its photos."""
    if model is None:
        return set()
    return links_between_parts(strengths, contradictions(model, links(source)))


def _missing(model: Any | None, count: int) -> set[int]:
    """Indices of photos that a model has not placed."""
    placed = set() if model is None else set(model.reg_image_ids())
    return {index for index in range(count) if image_id(index) not in placed}


def _differ_in_matches_alone(before: Evidence, after: Evidence) -> bool:
    return after == replace(before, guided_matching=True)
