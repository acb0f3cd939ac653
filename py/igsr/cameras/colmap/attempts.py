"""Place as many photos as possible with COLMAP's mapper, with falling thresholds.

If COLMAP's own thresholds leave out few photos, more matches are searched for these, and the model
is extended. If they leave out many, more matches are searched for all pairs, and mapping starts
over, as it does with the first thresholds that may give a wrong model. A model that contradicts its
photos is mapped again without the wrong matches (``contradictions``).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from igsr.cameras.colmap.agreement import (
    GOOD_FRACTION,
    MIN_SURE,
    agreeing,
    consistent_part,
    missing_matches,
)
from igsr.cameras.colmap.contradictions import (
    Pair,
    contradictions,
    leave_out,
    links,
    links_between_parts,
    parts,
)
from igsr.cameras.colmap.cycles import consistent_databases
from igsr.cameras.colmap.database import image_id
from igsr.cameras.colmap.mapping import Thresholds, extend, map_globally, map_photos
from igsr.cameras.colmap.matching import (
    has_usual_focals,
    matched_along_lines,
    with_focal_lengths,
    with_other_focal_lengths,
)
from igsr.cameras.estimate import Progress

#: COLMAP's thresholds first, then lower ones.
THRESHOLDS = (
    Thresholds(100, 16.0, 30, 1.5, True, False),
    Thresholds(100, 16.0, 30, 1.5, False, False),
    Thresholds(100, 16.0, 30, 1.5, False, True),
    Thresholds(40, 6.0, 15, 1.0, False, True),
    Thresholds(15, 2.0, 10, 0.5, False, True),
)
#: Models by these thresholds and later ones may be wrong.
FIRST_DOUBTFUL = 3
#: Maximum number of photos for retries.
MAX_RETRY_PHOTOS = 60
#: Initial focal lengths to try, in units of the longer side, if there are at most this many photos.
FOCALS = (1.2, 0.7, 2.0)
MAX_TRIAL_PHOTOS = 12
#: Maximum fraction of missing photos to extend a model instead of mapping again.
MAX_MISSING_FRACTION = 0.25
#: A model of fewer photos than this, and than half of all photos, is rejected: photos that only
#: look-alike things connect can have any position, and nothing contradicts it.
MIN_PLACED = 4
#: Maximum number of times that matches are left out for one model.
MAX_REMAPPINGS = 4


@dataclass(frozen=True)
class Mapped:
    """The model with most photos.

    Attributes:
        model: pycolmap's reconstruction, or None if no two photos can be placed.
        doubtful: whether its thresholds were so low that it may be wrong.
        removed_pairs: number of pairs of photos whose matches were left out as contradictory.
        other_scenes: indices of photos that match each other, but no photo of the model.
    """

    model: Any | None
    doubtful: bool
    removed_pairs: int
    other_scenes: list[list[int]] = field(default_factory=list)


@dataclass(frozen=True)
class _Candidate:
    """A model, and the number of verified matches that agree with it.

    Attributes:
        is_good: whether these are nearly all matches between its photos.
    """

    model: Any
    agreed: int
    is_good: bool


@dataclass(frozen=True)
class _Task:
    """The arguments of ``mapped`` that all attempts share."""

    count: int
    matches: Path
    seed: int
    show: Progress
    sift: bool
    aliked: bool


def mapped(
    count: int,
    matches: Path,
    seed: int,
    show: Progress,
    *,
    sift: bool = True,
    aliked: bool = False,
    usable: Mapping[int, npt.NDArray[np.bool_]] | None = None,
    attempts: Sequence[Thresholds] = THRESHOLDS,
) -> Mapped:
    """Place photos.

    Args:
        count: number of photos.
        matches: COLMAP's database with features and matches; it may be changed.
        seed: random seed.
        show: called with "matching" or "mapping", done and total.
        sift: whether features are SIFT's; then guided matching is possible.
        aliked: whether ALIKED is used; then missing matches can contradict a model.
        usable: pixels [H, W] that can have features, by COLMAP's image id, for photos with a mask.
        attempts: the first ones of ``THRESHOLDS``.
    """
    strengths = {pair: len(indices) for pair, indices in links(matches).items()}
    all_links = len(strengths)
    hopeless = set(range(count)) - {image - image_id(0) for pair in strengths for image in pair}
    source, database = matches, with_focal_lengths(matches, seed)
    task = _Task(count, matches, seed, show, sift, aliked)
    best: _Candidate | None = None
    best_attempt = 0
    guided: set[int] = set()
    few_missing = False
    for attempt, thresholds in enumerate(attempts):
        extending = few_missing and attempt != FIRST_DOUBTFUL and best is not None and best.is_good
        if thresholds.guided_matching:
            wanted = _missing(best, count) if extending else set(range(count))
            if not wanted <= guided:
                guided = wanted
                more = matched_along_lines(matches, wanted, show) if sift else None
                if more is not None:
                    source, database = more, with_focal_lengths(more, seed)
                elif thresholds == replace(THRESHOLDS[attempt - 1], guided_matching=True):
                    continue  # nothing differs from the attempt before

        found: _Candidate | None
        if extending and best is not None:
            model = copy.deepcopy(best.model)
            extend(model, count, database, thresholds, seed, show)
            found = _candidate(model, matches)
        else:
            found = _mapped_once(task, database, thresholds)
        for remapping in range(MAX_REMAPPINGS):
            wrong = _wrong_links(found, matches, source, strengths, usable or {}, aliked)
            if not wrong:
                break
            if attempt >= FIRST_DOUBTFUL or remapping + 1 == MAX_REMAPPINGS:
                found = None  # matches are not left out because of a doubtful model
                break
            for pair in wrong:
                del strengths[pair]
            for file in {matches, source}:
                leave_out(file, wrong)
            database = with_focal_lengths(source, seed)
            # Mapped again, because an extended model would keep its wrong cameras.
            best = None
            found = _mapped_once(task, database, thresholds)
        better = found is not None and (best is None or found.agreed > best.agreed)
        if better:
            best, best_attempt = found, attempt
        missing = _missing(best, count)
        if best is not None and len(strengths) < all_links:
            hopeless = _unlinked(best.model, strengths, count)
        if best is not None and count > MAX_RETRY_PHOTOS:
            break
        settled = thresholds.guided_matching and not better
        if best is not None and missing <= hopeless and (settled or best.is_good):
            break
        if attempt == 0:
            few_missing = len(missing) <= MAX_MISSING_FRACTION * count
    show("mapping", count, count)
    model = None if best is None else best.model
    if model is not None and count <= MAX_RETRY_PHOTOS and aliked:
        model = _without_disagreeing(model, matches)
    if model is not None and model.num_reg_images() < min(MIN_PLACED, count / 2):
        model = None
    others = [] if model is None else _other_scenes(model, links(matches), count)
    return Mapped(model, best_attempt >= FIRST_DOUBTFUL, all_links - len(strengths), others)


def _mapped_once(task: _Task, database: Path, thresholds: Thresholds) -> _Candidate | None:
    """The model with which most matches agree, until nearly all agree with one of all photos."""
    best: _Candidate | None = None
    for found in _candidates(task, database, thresholds):
        if found is not None and has_usual_focals(found.model, database):
            if best is None or found.agreed > best.agreed:
                best = found
            if found.is_good and not _missing(found, task.count):
                break
    return best


def _candidates(task: _Task, database: Path, thresholds: Thresholds) -> Iterator[_Candidate | None]:
    """Models of the incremental and the global mapper, also with other focal lengths."""
    count, matches, seed, show = task.count, task.matches, task.seed, task.show

    def judged(model: Any | None) -> _Candidate | None:
        return None if model is None else _candidate(model, matches)

    first = judged(map_photos(count, database, thresholds, seed, show))
    yield first
    if count <= MAX_TRIAL_PHOTOS:
        # It places photos that only one pair connects at a wrong distance: nothing disagrees.
        if first is not None and not first.is_good:
            yield judged(map_globally(database, thresholds, seed))
        # Their models have few points, so the others come first, with SIFT's guided matches.
        after = THRESHOLDS[FIRST_DOUBTFUL - (1 if task.sift else 2) : FIRST_DOUBTFUL]
        for start in consistent_databases(database) if thresholds in after else ():
            yield from (
                judged(model)
                for model in (
                    map_globally(start, thresholds, seed),
                    map_photos(count, start, thresholds, seed, show),
                )
                if _is_confirmed(model, start, matches, task.aliked)
            )
        for start in with_other_focal_lengths(database, FOCALS):
            yield judged(map_photos(count, start, thresholds, seed, show))


def _is_confirmed(model: Any | None, start: Path, matches: Path, aliked: bool) -> bool:
    """Whether a model of matches that were chosen by cycles has all photos and agrees with them.

    Look-alike things make cycles, too, but seldom a whole model.
    """
    if model is None:
        return False
    verified = links(matches)
    photos = {photo for pair in verified for photo in pair}
    return (
        photos <= set(model.reg_image_ids())
        and _candidate(model, start).is_good
        and not (aliked and missing_matches(model, verified, matches))
    )


def _candidate(model: Any, matches: Path) -> _Candidate:
    """A model with its agreement."""
    verified = links(matches)
    counts = agreeing(model, verified, matches)
    total, agreed = sum(len(verified[pair]) for pair in counts), sum(counts.values())
    return _Candidate(model, agreed, agreed >= GOOD_FRACTION * total)


def _without_disagreeing(model: Any, matches: Path) -> Any | None:
    """The largest part of a model that agrees with the matches; None if fewer than two photos."""
    verified = links(matches)
    part = consistent_part(agreeing(model, verified, matches), verified)
    if len(part) < 2:
        return None
    for image in sorted(set(model.reg_image_ids()) - part):
        model.deregister_frame(model.images[image].frame_id)
    return model


def _wrong_links(
    found: _Candidate | None,
    matches: Path,
    source: Path,
    strengths: dict[Pair, int],
    usable: Mapping[int, npt.NDArray[np.bool_]],
    aliked: bool,
) -> set[Pair]:
    """Pairs of photos whose matches make a model contradict its photos."""
    if found is None or found.model.num_reg_images() > MAX_RETRY_PHOTOS:
        return set()
    model = found.model
    return links_between_parts(
        strengths,
        contradictions(model, links(source), usable),
        missing_matches(model, links(matches), matches) if aliked else (),
    )


def _unlinked(model: Any, strengths: dict[Pair, int], count: int) -> set[int]:
    """Indices of photos without a chain of matches to a model's photos."""
    part = parts(strengths, ())
    of_model = {part.get(image) for image in model.reg_image_ids()}
    return {index for index in range(count) if part.get(image_id(index)) not in of_model}


def _other_scenes(
    model: Any, verified: Mapping[Pair, npt.NDArray[np.uint32]], count: int
) -> list[list[int]]:
    """Groups of two or more photos with many matches among them and few with a model's photos."""
    part = parts({pair: len(m) for pair, m in verified.items() if len(m) >= MIN_SURE}, ())
    of_model = {part.get(image) for image in model.reg_image_ids()}
    groups: dict[int, list[int]] = {}
    for index in range(count):
        name = part.get(image_id(index))
        if name is not None and name not in of_model:
            groups.setdefault(name, []).append(index)
    return sorted(groups.values())


def _missing(found: _Candidate | None, count: int) -> set[int]:
    """Indices of photos that are not in a model."""
    placed = set() if found is None else set(found.model.reg_image_ids())
    return {index for index in range(count) if image_id(index) not in placed}
