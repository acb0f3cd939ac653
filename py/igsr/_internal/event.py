"""Events, which a run reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

#: Stages of events that name a file: the cameras are known, the splats are on disk.
CAMERAS_FOUND = "cameras found"
SCENE_WRITTEN = "scene written"
#: The stage of messages for people that belong to no stage.
NOTE = "note"


@dataclass(frozen=True)
class Event:
    """Progress of a run, or a file that it has just written.

    Attributes:
        stage: "find cameras", "fit" and "score" of fits; "fit photos", "denoise novel
            views", "refit with novel views" and "score test views" of refinements;
            ``CAMERAS_FOUND``, ``SCENE_WRITTEN`` or ``NOTE``.
        done, total: steps or photos of the stage.
        message: details, in one line.
        part: fraction of the whole run that is done, in [0, 1]; None if unknown.
        path: the file or folder that now exists, or None.
        values: numbers by name: "loss", "splats" and "steps_per_second" of fits, "round" of
            refinements.
    """

    stage: str
    done: float = 0.0
    total: float = 1.0
    message: str = ""
    part: float | None = None
    path: Path | None = None
    values: Mapping[str, float] = field(default_factory=dict)


#: Called with each event, a few times a second; an exception that it raises ends the run.
Listener = Callable[[Event], object]
