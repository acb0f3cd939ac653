"""Checkpoints of a fit, from which it continues to the same bits.

A checkpoint is an uncompressed ``.npz`` of the fitter's arrays and one JSON object of settings. It
is read as an untrusted file: no pickles, no compression, and no array is allocated before its size
is known to be in the file.
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
from igsr._internal.untrusted_npz import DAMAGE, stored_arrays, stored_json
from igsr.errors import IgsrError
from igsr.fitting.settings import FitSettings

#: Incremented when the meaning of the arrays changes.
FORMAT = 2
#: Member with the settings, as UTF-8 JSON.
SETTINGS = "settings"
#: Recorded as the initialization of a fit that starts from splats.
GIVEN = "given"

State: TypeAlias = dict[str, npt.NDArray[Any]]


def recorded_settings(
    settings: FitSettings, backend: dict[str, str], capture: str, splats: str | None = None
) -> dict[str, Any]:
    """Return what a resumed fit must have in common with the checkpoint.

    Args:
        settings: of the fit.
        backend: "backend" and "instruction_set", on which bits depend.
        capture: fingerprint of photos, cameras and tracks.
        splats: hash of the splats that the fit starts from, or None.
    """
    after_last_step = ("remove_floaters", "backdrop")
    plain = {key: value for key, value in settings.plain().items() if key not in after_last_step}
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
        path: ``.npz`` file.
        settings: ``recorded_settings`` of the fit.
    """

    path: Path
    settings: dict[str, Any]

    def check_writable(self) -> None:
        """Check that the file can be written.

        Raises:
            IgsrError: it cannot.
        """
        check_writable(self.path)

    def save(self, state: State, started: tuple[str, int], seconds: float) -> None:
        """Write the file; an older checkpoint stays until then.

        Args:
            state: arrays of the fitter and others.
            started: initialization and its number of splats.
            seconds: time spent so far.

        Raises:
            IgsrError: it cannot be written.
        """
        save_checkpoint(
            self.path, state, {**self.settings, "started": list(started), "seconds": seconds}
        )

    def load(self) -> tuple[State, tuple[str, int], float]:
        """Return the arguments of ``save``.

        Raises:
            IgsrError: there is no checkpoint, it is damaged, or it is of another format or fit.
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


def save_checkpoint(path: Path, state: State, settings: dict[str, Any]) -> None:
    """Write arrays and settings ("seconds" and "started" among them).

    Raises:
        IgsrError: the file cannot be written; an older checkpoint stays.
    """
    text = json.dumps({"format": FORMAT, **settings}, allow_nan=False).encode()
    members: dict[str, Any] = {**state, SETTINGS: np.frombuffer(text, dtype=np.uint8)}
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **members)


def load_checkpoint(path: Path) -> tuple[State, dict[str, Any]]:
    """Read arrays and settings.

    Raises:
        IgsrError: there is no checkpoint, it is damaged or of another format.
    """
    if not path.is_file():
        raise IgsrError(f"There is no checkpoint {path} to resume; leave --resume out.")
    try:
        state = stored_arrays(path)
        settings = stored_json(state.pop(SETTINGS))
        if not isinstance(settings, dict) or settings.pop("format", None) != FORMAT:
            raise ValueError(f"it is not of format {FORMAT}")
        seconds = settings.get("seconds")
        if not isinstance(seconds, float) or not math.isfinite(seconds):
            raise ValueError(f"its seconds are {seconds!r}, not a finite number")
        started = settings.get("started")
        if not isinstance(started, list) or [type(value) for value in started] != [str, int]:
            raise ValueError(f"its started is {started!r}, not a name and a number")
    except DAMAGE as error:
        raise IgsrError(
            f"The checkpoint {path} cannot be read ({error}); leave --resume out to start over."
        ) from error
    return state, settings
