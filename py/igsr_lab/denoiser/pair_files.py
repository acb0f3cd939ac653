"""Training pairs on disk: what the network sees of a render in 8 bits, and the true picture."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr._internal.atomic_write import atomic_write
from igsr._internal.untrusted_npz import DAMAGE
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR
from igsr.errors import IgsrError

Bytes = npt.NDArray[np.uint8]

#: Channels of ``network_inputs`` that may be negative or above one: from -1 to 2.
_WIDE = np.zeros(CHANNELS, np.bool_)
_WIDE[COLOR + 1 : COLOR + BUFFERS] = True
SCALE = np.where(_WIDE, 3.0 / 255.0, 1.0 / 255.0).astype(np.float32)
OFFSET = np.where(_WIDE, -1.0, 0.0).astype(np.float32)
#: The byte that stands for zero in wide channels must mean exactly that.
assert float(85 * SCALE[COLOR + 1] + OFFSET[COLOR + 1]) == 0.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """The pairs of one fit, all of one size.

    Attributes:
        inputs: uint8 [V, ``CHANNELS``, H, W]; times ``SCALE`` plus ``OFFSET`` is what
            ``network_inputs`` gave.
        truth: uint8 [V, 3, H, W], the true pictures.
        masks: bool [V, H, W], where the true pictures may be relied on.
    """

    inputs: Bytes
    truth: Bytes
    masks: npt.NDArray[np.bool_]


def packed(inputs: npt.NDArray[np.float32]) -> Bytes:
    """Network inputs [``CHANNELS``, H, W] in 8 bits."""
    scaled = (inputs - OFFSET[:, None, None]) / SCALE[:, None, None]
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def unpacked(inputs: Bytes) -> npt.NDArray[np.float32]:
    """Network inputs float32 [``CHANNELS``, H, W] from 8 bits."""
    channels: npt.NDArray[np.float32] = inputs * SCALE[:, None, None] + OFFSET[:, None, None]
    return channels


def write_pairs(path: Path, pairs: Pairs) -> None:
    """Write the pairs of a fit as ``.npz``, under a temporary name first.

    Raises:
        IgsrError: the file cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, inputs=pairs.inputs, truth=pairs.truth, masks=pairs.masks)


def read_pairs(path: str | os.PathLike[str]) -> Pairs:
    """Read the pairs of a fit.

    Raises:
        IgsrError: the file is missing, damaged, or of other channels.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            pairs = Pairs(file["inputs"], file["truth"], file["masks"])
    except FileNotFoundError as error:
        raise IgsrError(f"{path} does not exist; make it with python -m igsr_lab pairs") from error
    except DAMAGE as error:
        raise IgsrError(f"{path} is no whole file of pairs; delete it and make it again") from error
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
