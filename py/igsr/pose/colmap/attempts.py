"""Cameras of as many photos as possible: what is not placed is tried again with more and with less.

Where COLMAP's own thresholds leave few photos out, these ask for more matches of their own, and the
model is extended. Where they leave many out, all photos stand on little: every pair gets more
matches, and the model is made anew. A model that contradicts its photos is made anew, too, without
the matches that cannot all be right (``contradictions``).
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.pose.colmap.contradictions import (
    Pair,
    contradictions,
    leave_out,
    links,
    links_between_parts,
    parts,
)
from igsr.pose.colmap.database import image_id
from igsr.pose.colmap.evidence import DOUBTFUL, STEPS, Evidence
from igsr.pose.colmap.mapping import extend, map_photos
from igsr.pose.colmap.matching import matched_along_lines, with_focal_lengths
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


def mapped(
    count: int,
    matches: Path,
    seed: int,
    show: Progress,
    *,
    sift: bool = True,
    usable: Mapping[int, npt.NDArray[np.bool_]] | None = None,
    steps: Sequence[Evidence] = STEPS,
) -> Mapped:
    """Place photos.

    Args:
        count: of photos.
        matches: COLMAP's database of them, their features and matches; it may be changed.
        seed: random seed.
        show: called with "matching" and "mapping", how much is done, and how much there is.
        sift: whether features are SIFT's: of these, more are matched where photos are missing.
        usable: pixels [H, W] that have features, by COLMAP's number of the photo, where some have
            none.
        steps: in which thresholds fall; the first ones of ``STEPS``.
    """
    strengths = {pair: len(found) for pair, found in links(matches).items()}
    all_links = len(strengths)
    hopeless = set(range(count)) - {image - image_id(0) for pair in strengths for image in pair}
    source, database = matches, with_focal_lengths(matches, seed)
    best: Any | None = None
    best_step = 0
    looked_for: set[int] = set()
    few = False
    for step, evidence in enumerate(steps):
        extending = few and step < DOUBTFUL
        if evidence.guided_matching:
            wanted = _missing(best, count) if extending else set(range(count))
            if not wanted <= looked_for:
                looked_for = wanted
                more = matched_along_lines(matches, wanted, show) if sift else None
                if more is not None:
                    source, database = more, with_focal_lengths(more, seed)
                elif _differ_in_matches_alone(STEPS[step - 1], evidence):
                    continue

        if extending:
            model = copy.deepcopy(best)
            extend(model, count, database, evidence, seed, show)
        else:
            model = map_photos(count, database, evidence, seed, show)
        for parting in range(MOST_PARTINGS):
            wrong = _wrong_links(model, source, strengths, usable or {})
            if not wrong:
                break
            if step >= DOUBTFUL or parting + 1 == MOST_PARTINGS:
                # What stands on little is no reason to leave out matches.
                model = None
                break
            for pair in wrong:
                del strengths[pair]
            for file in {matches, source}:
                leave_out(file, wrong)
            database = with_focal_lengths(source, seed)
            # A model that is extended holds to what it has by these matches.
            model = map_photos(count, database, evidence, seed, show)
        if model is not None and (best is None or model.num_reg_images() > best.num_reg_images()):
            best, best_step = model, step
        lost = _missing(best, count)
        if best is not None and len(strengths) < all_links:
            hopeless = _unlinked(best, strengths, count)
        if best is not None and (count > FEW or lost <= hopeless):
            break
        if step == 0:
            few = len(lost) <= FEW_MISSING * count
    show("mapping", count, count)
    return Mapped(best, best_step >= DOUBTFUL, all_links - len(strengths))


def _wrong_links(
    model: Any | None,
    source: Path,
    strengths: dict[Pair, int],
    usable: Mapping[int, npt.NDArray[np.bool_]],
) -> set[Pair]:
    """Pairs of photos whose matches make a model contradict its photos."""
    if model is None or model.num_reg_images() > FEW:
        return set()
    return links_between_parts(strengths, contradictions(model, links(source), usable))


def _unlinked(model: Any, strengths: dict[Pair, int], count: int) -> set[int]:
    """Indices of photos that no matches lead to from those of a model."""
    part = parts(strengths, ())
    own = {part.get(image) for image in model.reg_image_ids()}
    return {index for index in range(count) if part.get(image_id(index)) not in own}


def _missing(model: Any | None, count: int) -> set[int]:
    """Indices of photos that a model has not placed."""
    placed = set() if model is None else set(model.reg_image_ids())
    return {index for index in range(count) if image_id(index) not in placed}


def _differ_in_matches_alone(before: Evidence, after: Evidence) -> bool:
    return after == replace(before, guided_matching=True)
