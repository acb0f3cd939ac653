"""What a fit works on: checked photos, settings, priors and starting exposures."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Capture, View, photos_among
from igsr.capture.photo_checks import check_photos
from igsr.errors import IgsrError
from igsr.fitting.depth_checks import with_consistent_depths, with_scaled_depths
from igsr.fitting.exposures import StartingExposures, starting_exposures
from igsr.fitting.fitter import fit_device, without_exposures
from igsr.fitting.photo_statistics import PhotoStatistics, photo_statistics
from igsr.fitting.pose_priors import PosePriors, pose_priors
from igsr.fitting.presets import Quality, settings_for
from igsr.fitting.settings import FitSettings
from igsr.geometry.frame import Frame
from igsr.splats import Splats


@dataclass(frozen=True, eq=False)
class FitInputs:
    """Everything that a fit depends on.

    Captures, splats and priors are in the fit's frame.

    Attributes:
        frame: of the fit.
        given: the capture in the frame, as it was given.
        capture: its train views are fitted; given depths are scaled and checked.
        settings: of the fit.
        device: "backend" ("cpu" or "gpu"), "device" and "instruction_set".
        initial: splats to start from; None if they are initialized from the photos.
        frozen: splats that are drawn behind the others and stay as they are, or None.
        exposures: starting exposures of the train views; None if exposures are not optimized.
        priors: pose priors of the train views; None if cameras are not optimized.
    """

    frame: Frame
    given: Capture
    capture: Capture
    settings: FitSettings
    device: dict[str, str]
    initial: Splats | None
    frozen: Splats | None
    exposures: StartingExposures | None
    priors: PosePriors | None

    @property
    def views(self) -> list[View]:
        """The views to fit."""
        return self.capture.train_views

    @property
    def backend(self) -> Backend:
        """ "cpu" or "gpu"."""
        name: Backend = self.device["backend"]  # type: ignore[assignment]
        return name

    @property
    def frozen_count(self) -> int:
        """Number of frozen splats."""
        return 0 if self.frozen is None else len(self.frozen)

    def with_scene_colors(self, capture: Capture) -> Capture:
        """Undo the starting exposures, so that initialization can compare colors of photos."""
        if self.exposures is None:
            return capture
        views = without_exposures(capture.train_views, self.exposures.exposures)
        return replace(capture, views=views)


def prepare(
    capture: Capture,
    *,
    quality: Quality = "normal",
    initial: Splats | None = None,
    frozen: Splats | None = None,
    whole_schedule: bool = False,
    backend: str = "auto",
    **given: Any,
) -> FitInputs:
    """Check the photos and choose the settings of a fit.

    Args:
        capture: photos and cameras.
        quality: "draft", "normal" or "high".
        initial: splats of an earlier fit to continue from.
        frozen: splats beside the initial ones that stay as they are.
        whole_schedule: with ``initial``, run the whole schedule instead of its last steps.
        backend: "auto", "cpu" or "gpu".
        **given: fields of ``FitSettings``; None stands for the default.

    Raises:
        IgsrError: an argument cannot be used.
        UserWarning: see ``igsr.capture.photo_checks``.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if not isinstance(capture, Capture):
        raise IgsrError(
            f"capture must be a Capture, not {type(capture).__name__}; igsr.load_capture(path) "
            "makes one."
        )
    views = capture.train_views
    if not views:
        raise IgsrError(f"{capture.path} has no train views to fit.")
    frame = Frame.of_capture(capture)
    given_capture = capture = frame.capture(capture)
    initial = None if initial is None else frame.splats(initial)
    frozen = None if frozen is None else frame.splats(frozen)
    views = capture.train_views
    statistics = photo_statistics(photos_among(views))
    if initial is None:
        settings = settings_for(statistics, quality, **given)
    else:
        initial = initial.without_backdrop()
        settings = _settings_from_splats(statistics, quality, initial, given, whole_schedule)
    if frozen is not None:
        _check_frozen(frozen, initial)
    check_photos(views)
    if settings.depth_weight > 0.0 and any(view.depth is not None for view in views):
        scaled = with_scaled_depths(capture.views, capture.points)
        capture = replace(capture, views=with_consistent_depths(scaled))
        views = capture.train_views
    _check_focal(views, settings)
    device = fit_device(backend)
    priors = None
    if settings.moves_cameras:
        joint = settings.poses != "fixed"
        priors = pose_priors(views, capture.points, poses=joint, focal=settings.focal)
    exposures = starting_exposures(views, capture.points, settings.exposure)
    return FitInputs(
        frame, given_capture, capture, settings, device, initial, frozen, exposures, priors
    )


def _check_frozen(frozen: Splats, initial: Splats | None) -> None:
    if initial is None:
        raise IgsrError("frozen needs start, the splats that are fitted beside the frozen ones.")
    if frozen.antialiased:
        raise IgsrError("frozen has antialiased splats, which igsr does not fit.")
    if frozen.sh_degree != initial.sh_degree:
        raise IgsrError(
            f"frozen has SH degree {frozen.sh_degree} and start has {initial.sh_degree}; they must "
            "be the same."
        )
    if not np.array_equal(frozen.origin, initial.origin):
        raise IgsrError("frozen and start have different origins; give splats of one scene.")


def _check_focal(views: list[View], settings: FitSettings) -> None:
    rigged = next((view for view in views if view.rig is not None), None)
    if rigged is not None and settings.focal != "fixed":
        raise IgsrError(
            f"{rigged.name} is a view of a panorama or wide fisheye photo, whose focal length is "
            'known; leave focal "fixed".'
        )


def _settings_from_splats(
    statistics: PhotoStatistics,
    quality: Quality,
    splats: Splats,
    given: dict[str, Any],
    whole_schedule: bool,
) -> FitSettings:
    """Settings of a fit that continues from splats: the last steps of the usual schedule."""
    given = {**given, "start": None}
    if given.get("sh_degree") is None:
        given["sh_degree"] = splats.sh_degree
    settings = settings_for(statistics, quality, **given)
    if splats.sh_degree != settings.sh_degree:
        raise IgsrError(
            f"start has splats of SH degree {splats.sh_degree}; sh_degree must be the same, not "
            f"{settings.sh_degree}."
        )
    if not 1 <= len(splats) <= settings.max_splats:
        raise IgsrError(
            f"start has {len(splats)} splats; give at least one and at most max_splats, "
            f"{settings.max_splats}."
        )
    if splats.antialiased:
        raise IgsrError("start has antialiased splats, which igsr does not fit.")
    if whole_schedule:
        return settings
    usual = settings_for(statistics, quality, **(given | {"steps": None}))
    whole = max(settings.steps, usual.steps)
    schedule = settings_for(statistics, quality, **(given | {"steps": whole}))
    return replace(schedule, first_step=whole - settings.steps)
