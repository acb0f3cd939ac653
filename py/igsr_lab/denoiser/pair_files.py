"""Files of training pairs, and sets of files for training and validation.

A pair is the network's input of a render, in 8 bits, and the photo.
"""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr._internal.choices import FitBackend
from igsr._internal.untrusted_npz import DAMAGE
from igsr.capture import View
from igsr.denoiser.buffers import photo_support, render_buffers
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR, PHOTOS, network_inputs
from igsr.denoiser.warping import photo_sources, warp_photos
from igsr.errors import IgsrError
from igsr.evaluation.scores import BLACK, over_background
from igsr.splats import Splats

Bytes = npt.NDArray[np.uint8]

#: How fits are degraded: "sparse" has 3 to 16 photos; "underfit" stops early; "noise" has noise on
#: its cameras; "paper" and "scattered" are the paper's recipes; "leave-one-out" leaves one photo of
#: the capture out of each fit.
DEFAULT_RECIPES = ("sparse", "underfit", "noise")
RECIPES = (*DEFAULT_RECIPES, "paper", "scattered", "leave-one-out")
#: Fraction of the files, the last by name, that is kept for validation.
VALIDATION_FRACTION = 0.1

#: Channels of ``network_inputs`` in [-1, 2]; all others are in [0, 1].
_WIDE = np.zeros(CHANNELS, np.bool_)
_WIDE[COLOR + 1 : COLOR + BUFFERS] = True
SCALE = np.where(_WIDE, 3.0 / 255.0, 1.0 / 255.0).astype(np.float32)
OFFSET = np.where(_WIDE, -1.0, 0.0).astype(np.float32)
# Zero must be exact in wide channels.
assert float(85 * SCALE[COLOR + 1] + OFFSET[COLOR + 1]) == 0.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of one fit, all of one size."""

    #: uint8 [V, ``CHANNELS``, H, W]; times ``SCALE`` plus ``OFFSET`` is the output of
    #: ``network_inputs``.
    inputs: Bytes
    truth: Bytes  # uint8 [V, 3, H, W], the photos
    masks: npt.NDArray[np.bool_]  # bool [V, H, W], pixels with a known truth


def packed(inputs: npt.NDArray[np.float32]) -> Bytes:
    """Network inputs [``CHANNELS``, H, W] in 8 bits."""
    scaled = (inputs - OFFSET[:, None, None]) / SCALE[:, None, None]
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def unpacked(inputs: Bytes) -> npt.NDArray[np.float32]:
    """Network inputs float32 [``CHANNELS``, H, W] from 8 bits."""
    channels: npt.NDArray[np.float32] = inputs * SCALE[:, None, None] + OFFSET[:, None, None]
    return channels


def check_one_size(views: Sequence[View]) -> None:
    """Check before a fit that its views can be rendered as pairs."""
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        raise IgsrError(
            f"views to render are of sizes {sorted(sizes)}; pairs need one, resize the photos."
        )


def rendered_pairs(
    splats: Splats,
    photos: Sequence[View],
    views: Sequence[View],
    background: Sequence[float] | None,
    backend: FitBackend,
) -> Pairs:
    """Render views as network inputs, without looking up colors in the views' own photos.

    ``background`` is RGB behind photos with alpha, None for photos without.
    """
    check_one_size(views)
    support = photo_support(splats, photos, backend)
    behind = BLACK if background is None else background
    sources = photo_sources(splats, photos, behind, backend)
    inputs, truth, masks = [], [], []
    for view in views:
        buffers = render_buffers(splats, view.camera, support, background, backend)
        others = [s for s, photo in zip(sources, photos, strict=True) if photo.name != view.name]
        assert buffers.depth is not None
        assert buffers.alpha is not None
        warped = warp_photos(view.camera, buffers.depth, buffers.alpha, others, PHOTOS)
        inputs.append(packed(network_inputs(buffers, warped)))
        truth.append(np.moveaxis(over_background(view.image, behind), -1, 0))
        masks.append(np.ones(truth[-1].shape[1:], np.bool_) if view.mask is None else view.mask)
    return Pairs(np.stack(inputs), np.stack(truth), np.stack(masks))


def write_pairs(path: Path, pairs: Pairs) -> None:
    """Write the pairs of a fit as ``.npz``."""
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, inputs=pairs.inputs, truth=pairs.truth, masks=pairs.masks)


def read_pairs(path: str | os.PathLike[str]) -> Pairs:
    """Read the pairs of a fit."""
    try:
        with np.load(path, allow_pickle=False) as file:
            pairs = Pairs(file["inputs"], file["truth"], file["masks"])
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; make it with python -m igsr_lab pairs") from error
    except DAMAGE as error:
        raise IgsrError(f"{path} is damaged; delete it and make it again") from error
    inputs, truth, masks = pairs.inputs, pairs.truth, pairs.masks
    if (
        inputs.ndim != 4
        or inputs.dtype != np.uint8
        or truth.dtype != np.uint8
        or inputs.shape[1] != CHANNELS
        or masks.dtype != np.bool_
        or truth.shape != (len(inputs), 3, *inputs.shape[2:])
        or masks.shape != (len(inputs), *inputs.shape[2:])
        or 0 in inputs.shape
    ):
        raise IgsrError(
            f"{path} holds pairs of another version: inputs {list(inputs.shape)}, truth "
            f"{list(truth.shape)}; make them again"
        )
    return pairs


def capture_of_pairs(path: str) -> str:
    """Name of the capture of a file of pairs, or the name of a file of unknown origin."""
    file = Path(path).name
    found = re.fullmatch(rf"(.+)-(?:{'|'.join(RECIPES)})-\d+-seed\d+.*\.npz", file)
    return file if found is None else found[1]


@dataclass(frozen=True, eq=False)
class PairSets:
    """Pairs for training and validation, with the sorted names and the hash of all files."""

    names: list[str]
    sha256: str
    train: list[Pairs]
    validation: list[Pairs]


def read_pair_sets(files: Sequence[str | os.PathLike[str]]) -> PairSets:
    """Read files of pairs and keep a tenth of them, in whole captures, for validation."""
    # By captures first, as one name may begin with another.
    paths = sorted((str(path) for path in files), key=lambda path: (capture_of_pairs(path), path))
    if len(paths) < 2:
        raise IgsrError("training needs at least two files of pairs, one of them to validate on.")
    kept = validation_count(paths)
    train, validation = ([read_pairs(p) for p in part] for part in (paths[:-kept], paths[-kept:]))
    return PairSets([Path(path).name for path in paths], _sha256(paths), train, validation)


def validation_count(paths: Sequence[str]) -> int:
    """Number of files at the end to keep, so that no capture is in both sets.

    Warns if all pairs are of one capture; its last files are kept then.
    """
    captures = [capture_of_pairs(path) for path in paths]
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


def _sha256(paths: Sequence[str]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(hashlib.sha256(Path(path).read_bytes()).digest())
    return digest.hexdigest()
