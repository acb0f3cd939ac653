"""A refinement that runs: its folder, its progress and the time that each stage took."""

from __future__ import annotations

import contextlib
import logging
import os
import time
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from igsr._internal.atomic_write import remove_unfinished
from igsr._internal.part_usage import Meter, Parts
from igsr._internal.progress_bar import BarState
from igsr.capture import Capture, load_capture
from igsr.capture.load import holds_cameras
from igsr.capture.photo_folder import FRAMES
from igsr.errors import IgsrError
from igsr.evaluation.scores import default_background
from igsr.fitting.followed_run import FollowedRun
from igsr.pose import check_enough_placed, find_cameras, kept_capture, photos_at
from igsr.pose.cache import read_usage
from igsr.refinement.report import parts_so_far, write_refinement
from igsr.refinement.results import Refined, RefineProgress, Stage
from igsr.refinement.settings import RefineSettings

logger = logging.getLogger(__name__)

#: The error message of a run that ``progress`` ended.
STOPPED = "the refinement was stopped; go on with resume."


#: Stages as progress bars call them.
_STAGES: dict[Stage, str] = {
    "pose": "find cameras",
    "fit": "fit photos",
    "cross_validate": "cross-validate",
    "novel_views": "render and denoise novel views",
    "refit": "refit with novel views",
    "test": "score test views",
}


def bar_state(now: RefineProgress) -> BarState:
    """What a progress bar shows of a refinement."""
    return BarState(now.done, 1.0, f"round {now.round}: {_STAGES[now.stage]}")


class RefineRun:
    """Files, progress and time of one call of ``igsr.refine``.

    Attributes:
        round: number of the current round; 0 is the fit to the photos alone.
    """

    def __init__(
        self,
        settings: RefineSettings,
        out: str | os.PathLike[str] | None,
        resume: bool,
        progress: Callable[[RefineProgress], bool | None] | None,
    ) -> None:
        """Begin to count time; no file is touched yet.

        Raises:
            IgsrError: ``resume`` without ``out``.
        """
        if resume and out is None:
            raise IgsrError("resume needs out, the folder to go on from.")
        self.round = 0
        self._settings, self._resume, self._progress = settings, resume, progress
        self._out = None if out is None else Path(out)
        self._followed = None if self._out is None else FollowedRun(self._out)
        self._started, self._meter = time.monotonic(), Meter()
        self._parts = Parts()
        # In units of a fit to all photos.
        self._work, self._work_done = 1.0, 0.0
        # A resumed run that has done nothing new leaves the files as they are.
        self._has_news = not resume

    def find_cameras(
        self, photos: str | os.PathLike[str], max_size: int | None, allow_missing: bool
    ) -> Capture:
        """The capture of a folder of photos; cameras that had to be found are kept in the folder.

        Args:
            photos: a capture, or a folder of photos.
            max_size: longest side in pixels of photos as loaded, or None.
            allow_missing: whether fewer than half of the photos may be registered.

        Raises:
            IgsrError: as ``igsr.estimate_poses`` and ``igsr.load_capture``, too few photos are
                registered, photos lie where the cameras would be kept, or ``progress`` ended the
                run.
        """

        def tell(step: str, done: int, total: int) -> None:
            if not self._goes_on("pose", 0.0):
                raise IgsrError(STOPPED)

        if holds_cameras(photos):
            return load_capture(photos, max_size)
        seed = self._settings.seed
        if self._out is not None:
            return kept_capture(
                Path(photos),
                self._out,
                seed=seed,
                max_size=max_size,
                # A run that is resumed must fit the very cameras that it began with.
                resume=self._resume,
                allow_missing=allow_missing,
                progress=tell,
                say=logger.info,
            )
        found, held = find_cameras(photos, seed=seed, max_size=max_size, progress=tell)
        for sentence in found.estimate.warnings:
            warnings.warn(sentence, stacklevel=3)
        check_enough_placed(found, {}, allow_missing)
        return found.capture(Path(photos), photos_at(photos, FRAMES, max_size, held))

    def prepare(self, capture: Capture, work: float) -> None:
        """Clear the folder of what an earlier run left unfinished, or read what it took to resume.

        Args:
            capture: the photos, some of which are left for who follows the run.
            work: all that there may be to do, in units of a fit to all photos.
        """
        self._work, self._parts = work, Parts()
        self._meter.lap()
        if self._out is None:
            return
        for folder in (self._out, self._checkpoints, *self._out.glob("rounds/[0-9]*")):
            remove_unfinished(folder)
        if self._resume:
            self._parts.used = parts_so_far(self._out)
        else:
            self._remove_checkpoints()
        if self._followed is not None:
            self._followed.show(capture, default_background(capture))

    def checkpoint(self, name: str) -> tuple[Path | None, bool]:
        """Where a fit is saved to, and whether it resumes from there."""
        if self._out is None:
            return None, False
        path = self._checkpoints / f"{name}.npz"
        return path, self._resume and path.is_file()

    def fitting(self, stage: Stage, part: float) -> bool:
        """Tell that a fit is under way, and has done ``part`` of a whole fit's work.

        Returns:
            False where it is to be saved and ended.
        """
        self._has_news = True
        return self._goes_on(stage, part)

    def tell(self, stage: Stage) -> None:
        """Tell the progress and count the time since the last call to a stage.

        Raises:
            IgsrError: ``progress`` ended the run.
        """
        if not self._goes_on(stage, 0.0):
            raise IgsrError(STOPPED)

    def work_done(self, work: float) -> None:
        """Count finished work, in units of a fit to all photos."""
        self._work_done += work

    def write(self, refined: Refined) -> Refined:
        """Write the result so far, unless the folder already holds as much.

        Returns:
            The result, with the time that each stage has taken.

        Raises:
            IgsrError: a file cannot be written.
        """
        # As the report keeps them: what a resumed run reads there never counts as less.
        seconds = {name: part["seconds"] for name, part in self._parts.plain().items()}
        refined = replace(refined, seconds=seconds)
        if self._out is not None and (self._has_news or refined.stop is not None):
            cameras = read_usage(refined.capture.path)
            parts = {} if cameras is None else {"cameras": cameras}
            write_refinement(self._out, refined, self._settings, parts | self._parts.used)
        return refined

    def close(self) -> None:
        """Tell who follows the run that it has ended, done or not."""
        if self._followed is not None:
            self._followed.close()

    @property
    def _checkpoints(self) -> Path:
        assert self._out is not None
        return self._out / "checkpoints"

    def _goes_on(self, stage: Stage, part: float) -> bool:
        if stage != "pose":
            self._parts.add(stage, self._meter.lap())
        done = min(1.0, (self._work_done + part) / self._work)
        now = RefineProgress(self.round, stage, done, time.monotonic() - self._started)
        if self._followed is not None:
            self._followed.tell(bar_state(now).text, done)
        return self._progress is None or self._progress(now) is not False

    def _remove_checkpoints(self) -> None:
        """Remove fits of an earlier run and its report: a later resume must not use them."""
        assert self._out is not None
        with contextlib.suppress(OSError):
            (self._out / "report.json").unlink()
        for fit in ("whole", "fold[0-9]"):
            for name in (f"{fit}.npz", f"{fit}-round[0-9]*.npz"):
                for path in self._checkpoints.glob(name):
                    path.unlink(missing_ok=True)
