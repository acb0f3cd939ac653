"""Checkpoints of a fit: everything needed to continue it and end with the same bits.

A checkpoint is an uncompressed ``.npz``: the fitter's arrays and one JSON object of settings. It
is read as an untrusted file: no pickles, nothing compressed, and no array is allocated before its
size is known to be in the file.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.atomic_write import atomic_write, check_writable
from igsr._internal.untrusted_npz import DAMAGE, stored_arrays
from igsr.errors import IgsrError
from igsr.fitting.settings import FitSettings
from igsr.splats import Splats

#: Raised whenever the arrays' meaning changes; older checkpoints are then refused by number.
FORMAT = 1
#: Member that holds the settings, as UTF-8 JSON.
SETTINGS = "settings"
#: What is recorded as the initialization of a fit that went on from splats that it was given.
GIVEN = "given"

State: TypeAlias = dict[str, npt.NDArray[Any]]


def recorded_settings(
    settings: FitSettings, backend: dict[str, str], capture: str, splats: str | None = None
) -> dict[str, Any]:
    """What a checkpoint records of a fit: all that a resumed fit must have in common with it.

    Args:
        settings: of the fit.
        backend: "backend" and "instruction_set": on another one the bits differ.
        capture: fingerprint of photos, cameras and tracks.
        splats: hash of the splats that the fit goes on from, if it does.
    """
    # Floaters are removed, and the backdrop added, after the last step.
    after = ("remove_floaters", "backdrop")
    plain = {key: value for key, value in settings.plain().items() if key not in after}
    recorded = {
        **plain,
        "backend": backend["backend"],
        "instruction_set": backend["instruction_set"],
        "igsr": _core.__version__,
    }
    if splats is not None:
        recorded |= {"start": GIVEN, "first_step": settings.first_step, "splats": splats}
    return {**recorded, "capture": capture}


@dataclass(frozen=True)
class CheckpointFile:
    """The checkpoint of one fit.

    Attributes:
        path: of the ``.npz`` file.
        settings: ``recorded_settings`` of the fit.
    """

    path: Path
    settings: dict[str, Any]

    def check_writable(self) -> None:
        """Find out now whether the file can be written.

        Raises:
            IgsrError: it cannot.
        """
        check_writable(self.path)

    def save(self, state: State, started: tuple[str, int], seconds: float) -> None:
        """Write the file, whole or not at all.

        Args:
            state: arrays of the fitter, and what else is kept.
            started: what the splats were initialized from, and their number.
            seconds: time spent so far.

        Raises:
            IgsrError: it cannot be written; an older checkpoint is still there.
        """
        save_checkpoint(
            self.path, state, {**self.settings, "started": list(started), "seconds": seconds}
        )

    def load(self) -> tuple[State, tuple[str, int], float]:
        """What ``save`` was given.

        Raises:
            IgsrError: there is no checkpoint, it is damaged, or of another format, fit or capture;
                the message says which.
        """
        state, saved = load_checkpoint(self.path)
        for name, value in self.settings.items():
            if saved.get(name) == value:
                continue
            if name == "capture":
                raise IgsrError(
                    f"{self.path} was made from other photos, masks, cameras, tracks or another "
                    "split; resume with the same or leave --resume out."
                )
            raise IgsrError(
                f"{self.path} was made with {name} {saved.get(name)!r}, not {value!r}; "
                "resume with the same or leave --resume out."
            )
        return state, (saved["started"][0], saved["started"][1]), saved["seconds"]


def checkpoint_splats(path: Path) -> Splats:
    """The splats of a fit as they were when it saved a checkpoint.

    Raises:
        IgsrError: there is no checkpoint, it is damaged, or of another format.
    """
    state, _ = load_checkpoint(path)
    try:
        return Splats(
            means=state["means"],
            quats=state["quats"],
            scales=state["scales"],
            opacities=state["opacities"],
            sh=state["sh"],
            origin=state["origin"],
        )
    except (KeyError, IgsrError) as error:
        raise IgsrError(f"The checkpoint {path} holds no splats: {error}.") from error


def save_checkpoint(path: Path, state: State, settings: dict[str, Any]) -> None:
    """Write a checkpoint, whole or not at all.

    ``settings`` holds "seconds", the time spent so far, as a float, and "started", what
    the first splats were made from and their number.

    Raises:
        IgsrError: the file cannot be written; an older checkpoint is still there.
    """
    text = json.dumps({"format": FORMAT, **settings}, allow_nan=False).encode()
    members: dict[str, Any] = {**state, SETTINGS: np.frombuffer(text, dtype=np.uint8)}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **members)


def load_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """The arrays and settings of a checkpoint.

    Raises:
        IgsrError: there is none, it is damaged, or another format; the message says which.
    """
    if not path.is_file():
        raise IgsrError(f"There is no checkpoint {path} to resume; leave --resume out.")
    try:
        state = stored_arrays(path)
        settings = json.loads(state.pop(SETTINGS).tobytes())
        if not isinstance(settings, dict) or settings.pop("format", None) != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        settings.setdefault("coarse_to_fine", False)  # the first fits had no such setting
        settings.setdefault("exposure", "off")  # nor this one
        settings.setdefault("transients", "auto")  # nor this one; looks that are left are made
        settings.setdefault("learning_rate", 1.0)
        settings.setdefault("depth_weight", 0.0)  # photos had no depths
        seconds = settings.get("seconds")
        if not isinstance(seconds, float) or not math.isfinite(seconds):
            raise ValueError(f"its seconds are {seconds!r} where a finite number belongs")
        started = settings.get("started")
        if not isinstance(started, list) or [type(value) for value in started] != [str, int]:
            raise ValueError(f"its started is {started!r} where a name and a number belong")
    except DAMAGE as error:
        raise IgsrError(
            f"The checkpoint {path} cannot be read ({error}); leave --resume out to start anew."
        ) from error
    return state, settings
