"""Which files of pairs are trained on and which are kept for validation."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from igsr.errors import IgsrError
from igsr_lab.denoiser.pair_files import Pairs, read_pairs
from igsr_lab.denoiser.pairs import capture_of_pairs

#: Part of the files of pairs, at the end of the order of their names, that is never trained on.
VALIDATION = 0.1


@dataclass(frozen=True, eq=False)
class PairSets:
    """The pairs of a training.

    Attributes:
        names: of all files, in the order of their captures and names.
        sha256: of the contents of all files.
        train: the pairs to learn from.
        validation: the pairs that are only scored.
    """

    names: list[str]
    sha256: str
    train: list[Pairs]
    validation: list[Pairs]


def read_pair_sets(files: Sequence[str | os.PathLike[str]]) -> PairSets:
    """Read files of pairs and split them by captures, a tenth of the files for validation.

    Raises:
        IgsrError: there are fewer than two files, or one cannot be read.
    """
    # By captures: one's name may begin with another's.
    paths = sorted((str(path) for path in files), key=lambda path: (_capture(path), path))
    if len(paths) < 2:
        raise IgsrError("training needs at least two files of pairs, one of them to validate on.")
    kept = kept_for_validation(paths)
    train, validation = ([read_pairs(path) for path in part] for part in _split(paths, kept))
    return PairSets([Path(path).name for path in paths], _sha256(paths), train, validation)


def kept_for_validation(paths: Sequence[str]) -> int:
    """How many files at the end to keep: whole captures, so that none of them is trained on.

    Warns where all pairs are of one capture: its last files are then kept.
    """
    captures = [_capture(path) for path in paths]
    kept = max(1, round(VALIDATION * len(paths)))
    if len(set(captures)) == 1:
        warnings.warn(
            "All pairs are of one capture: validation is of the scene that is trained on.",
            stacklevel=4,  # whoever called ``train``
        )
        return kept
    while kept < len(paths) and captures[-kept - 1] == captures[-kept]:
        kept += 1
    if kept < len(paths):
        return kept
    # The tenth reached into the first capture: the last alone is kept.
    return captures.count(captures[-1])


def _split(paths: list[str], kept: int) -> tuple[list[str], list[str]]:
    return paths[:-kept], paths[-kept:]


def _capture(path: str) -> str:
    return capture_of_pairs(Path(path).name)


def _sha256(paths: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return digest.hexdigest()
