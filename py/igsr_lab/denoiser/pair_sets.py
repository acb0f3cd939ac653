"""Split files of pairs into those for training and those for validation."""

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

#: Fraction of the files, the last by name, that is kept for validation.
VALIDATION_FRACTION = 0.1


@dataclass(frozen=True, eq=False)
class PairSets:
    """Pairs for training and validation, with the sorted names and the hash of all files."""

    names: list[str]
    sha256: str
    train: list[Pairs]
    validation: list[Pairs]


def read_pair_sets(files: Sequence[str | os.PathLike[str]]) -> PairSets:
    """Read files of pairs and keep a tenth of them, in whole captures, for validation."""
    # By captures first, as the name of one may begin with that of another.
    paths = sorted((str(path) for path in files), key=lambda path: (_capture(path), path))
    if len(paths) < 2:
        raise IgsrError("training needs at least two files of pairs, one of them to validate on.")
    kept = validation_count(paths)
    train, validation = ([read_pairs(p) for p in part] for part in (paths[:-kept], paths[-kept:]))
    return PairSets([Path(path).name for path in paths], _sha256(paths), train, validation)


def validation_count(paths: Sequence[str]) -> int:
    """Number of files at the end to keep, so that no capture is in both sets.

    Warns if all pairs are of one capture; its last files are kept then.
    """
    captures = [_capture(path) for path in paths]
    kept = max(1, round(VALIDATION_FRACTION * len(paths)))
    if len(set(captures)) == 1:
        warnings.warn(
            "All pairs are of one capture: validation uses the scene that is trained on.",
            stacklevel=4,
        )
        return kept
    while kept < len(paths) and captures[-kept - 1] == captures[-kept]:
        kept += 1
    # If the tenth reaches into the first capture, only the last one is kept.
    return kept if kept < len(paths) else captures.count(captures[-1])


def _capture(path: str) -> str:
    return capture_of_pairs(Path(path).name)


def _sha256(paths: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return digest.hexdigest()
