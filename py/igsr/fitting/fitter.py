"""Conversion between views, splats and cameras and the arrays of the renderer's fitter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.choices import FitBackend
from igsr.capture import Camera, Capture, Exposure, PseudoView, View, photos_among
from igsr.capture.types import intrinsic_matrix
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import GIVEN
from igsr.fitting.exposures import StartingExposures
from igsr.fitting.initialization.initial_splats import initial_splats
from igsr.fitting.pose_priors import PosePriors
from igsr.fitting.settings import FitSettings
from igsr.rendering.renders import intrinsics_of, viewmat_about
from igsr.splats import PARAMETERS, Splats, subset

#: Minimum number of steps on photos for each step on a pseudo-view, which may be wrong.
PHOTO_STEPS = 5
#: Last fraction of the steps, on photos only: pseudo-views are a little blurred, and fine detail is
#: fitted last.
PHOTOS_ONLY_FRACTION = 0.2


def fitter_of(
    views: Sequence[View],
    origin: npt.NDArray[np.float64],
    state: dict[str, Any],
    settings: dict[str, Any],
    backend: str,
    priors: PosePriors | None = None,
    exposures: StartingExposures | None = None,
) -> _core.Fitter:
    """Return the renderer's fitter; see ``_core.Fitter``.

    Args:
        views: V photos or pseudo-views with their cameras, in the world frame.
        origin: float64 [3], world position of the splats' origin.
        state: float32 arrays of N splats ("means" [N, 3] ...) and, to continue, those of the
            optimizer, as ``Fitter.state`` returns them.
        settings: fields of ``FitSettings``, and "frozen" (no splat changes), "frozen_splats"
            (number of last splats that do not change) and "camera_warm_up" (fraction of the steps
            before cameras move).
        backend: "cpu" or "gpu".
        priors: of the V cameras, or None.
        exposures: initial exposures of the V views; None if they are not optimized.

    Raises:
        ValueError: a view, the state or a setting cannot be used; the message names it.
    """
    return _core.Fitter(
        [np.ascontiguousarray(view.image) for view in views],
        [_mask(view) for view in views],
        [getattr(view, "background", None) for view in views],
        _schedule(views, int(settings["steps"]), int(settings.get("first_step", 0))),
        *_arrays(views, origin),
        state,
        {**settings, "exposures": exposures is not None},
        backend,
        None if priors is None else _prior_arrays(priors, origin),
        None if exposures is None else _exposure_arrays(exposures),
        _rigs(views) if settings.get("poses") == "joint" else None,
        [_depth(view) for view in views] if settings.get("depth_weight") else None,
    )


def _rigs(views: Sequence[View]) -> list[int] | None:
    """A number for each view, equal for views of one rig; None if there is no rig."""
    if all(view.rig is None for view in views):
        return None
    names = {name: number for number, name in enumerate(dict.fromkeys(v.photo for v in views))}
    return [names[view.photo] for view in views]


def fit_device(backend: str) -> dict[str, str]:
    """Return "backend", "device" and "instruction_set" of a backend that fits.

    Raises:
        IgsrError: the name is unknown, or the backend only renders.
        RuntimeError: backend "gpu" was asked for and no adapter answers.
    """
    if backend == "reference":
        raise IgsrError("backend reference renders but does not fit; use auto, cpu or gpu.")
    if backend not in get_args(FitBackend):
        raise IgsrError(f"backend must be auto, cpu or gpu, not {backend!r}.")
    return _core.backend_info(_core.resolve_backend(backend))


def initial_state(
    capture: Capture, settings: FitSettings, given: Splats | None = None
) -> tuple[dict[str, npt.NDArray[Any]], tuple[str, int]]:
    """Return the arrays of the initial splats, with their origin, and how and how many were made.

    Raises:
        IgsrError: as ``initial_splats``.
    """
    if given is not None:
        return splat_arrays(given), (GIVEN, len(given))
    views = photos_among(capture.train_views)
    if settings.depth_weight == 0.0:
        views = [replace(view, depth=None, depth_confidence=None) for view in views]
    splats, made_from = initial_splats(
        replace(capture, views=views),
        settings.seed,
        settings.max_splats,
        settings.sh_degree,
        settings.start,
        dense=settings.density == "fixed",
        exact_poses=settings.poses == "fixed",
        exact_focal=settings.focal == "fixed",
    )
    return splat_arrays(splats), (made_from, len(splats))


def splat_arrays(splats: Splats) -> dict[str, npt.NDArray[Any]]:
    """Arrays of splats by name, with their origin."""
    return {name: getattr(splats, name) for name in (*PARAMETERS, "origin")}


def with_splats_after(
    state: dict[str, npt.NDArray[Any]], splats: Splats
) -> dict[str, npt.NDArray[Any]]:
    """Parameters of a state's splats, followed by other splats of the same origin."""
    return {name: np.concatenate([state[name], getattr(splats, name)]) for name in PARAMETERS}


def first_splats(splats: Splats, count: int) -> Splats:
    """The first ``count`` splats."""
    if count == len(splats):
        return splats
    return subset(splats, slice(count))


def _schedule(views: Sequence[View], steps: int, first: int) -> list[tuple[int, int | None]]:
    """Number of steps per round of each view, and the step after its last; None if there is none.

    Steps count from 0; a fit that enters the schedule late begins with ``first``.
    """
    photos = sum(not isinstance(view, PseudoView) for view in views)
    others = len(views) - photos
    if not photos:
        return [(1, None)] * others
    each = max(1, -(-PHOTO_STEPS * others // photos))
    until = first + round((1.0 - PHOTOS_ONLY_FRACTION) * (steps - first))
    return [(1, until) if isinstance(view, PseudoView) else (each, None) for view in views]


def _mask(view: View) -> npt.NDArray[np.bool_] | npt.NDArray[np.float32] | None:
    """Mask [H, W] of a photo, or confidence weights of a pseudo-view."""
    if not isinstance(view, PseudoView):
        return None if view.mask is None else np.ascontiguousarray(view.mask)
    return np.ascontiguousarray(view.weights if view.mask is None else view.weights * view.mask)


def _depth(view: View) -> npt.NDArray[np.float32] | None:
    """Depth and confidence [H, W, 2]; the confidence is 0 where the depth is unknown."""
    if view.depth is None:
        return None
    known = (view.depth > 0.0).astype(np.float32)
    confidence = known if view.depth_confidence is None else known * view.depth_confidence
    if view.mask is not None:
        confidence = confidence * view.mask
    return np.stack([view.depth, confidence], axis=-1)


def _arrays(
    views: Sequence[View], origin: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Viewmats relative to the origin [V, 4, 4] and intrinsics [V, 4]."""
    return (
        np.stack([viewmat_about(origin, view.camera.viewmat) for view in views]),
        np.stack([intrinsics_of(view.camera.K) for view in views]),
    )


def _prior_arrays(
    priors: PosePriors, origin: npt.NDArray[np.float64]
) -> dict[str, npt.NDArray[np.float64]]:
    viewmats, intrinsics = _arrays(priors.views, origin)
    return {
        "viewmats": viewmats,
        "intrinsics": intrinsics,
        "information": priors.information,
        "focal_information": priors.focal_information,
    }


def _exposure_arrays(start: StartingExposures) -> dict[str, npt.NDArray[Any]]:
    exposures = [exposure or Exposure() for exposure in start.exposures]
    return {
        "gains": np.array([exposure.gain for exposure in exposures], np.float64),
        "offsets": np.array([exposure.offset for exposure in exposures], np.float64),
        "fitted": np.array([exposure is not None for exposure in start.exposures], np.bool_),
        "pulls": start.pulls,
    }


def fitted_exposures(views: Sequence[View], fitter: _core.Fitter) -> list[Exposure | None]:
    """Return the views' exposures; None if they are not optimized.

    Args:
        views: V views.
        fitter: of these views.
    """
    arrays = fitter.exposures()
    if arrays is None:
        return [None] * len(views)
    return [
        None if isinstance(view, PseudoView) else Exposure(tuple(gain), tuple(offset))
        for view, gain, offset in zip(views, arrays["gains"], arrays["offsets"], strict=True)
    ]


def without_exposures(views: Sequence[View], exposures: Sequence[Exposure | None]) -> list[View]:
    """The views with exposures removed from their pixels."""
    return [
        view if one is None else replace(view, image=one.remove_from(view.image), exposure=None)
        for view, one in zip(views, exposures, strict=True)
    ]


def fitted_cameras(
    views: Sequence[View], fitter: _core.Fitter, origin: npt.NDArray[np.float64]
) -> list[Camera]:
    """Return the views' cameras with the fitter's poses and focal lengths, in the world frame.

    Args:
        views: V views.
        fitter: of these views.
        origin: float64 [3], world position of the splats' origin.
    """
    arrays = fitter.cameras()
    return [
        replace(
            view.camera,
            viewmat=viewmat_about(-origin, viewmat),
            K=intrinsic_matrix(*(float(value) for value in intrinsics)),
        )
        for view, viewmat, intrinsics in zip(
            views, arrays["camera_viewmats"], arrays["camera_intrinsics"], strict=True
        )
    ]


def with_train_exposures(capture: Capture, exposures: Sequence[Exposure | None]) -> Capture:
    """The capture with other exposures of its train views, in their order."""
    if all(one is view.exposure for one, view in zip(exposures, capture.train_views, strict=True)):
        return capture
    each = iter(exposures)
    views = [
        replace(view, exposure=next(each)) if view.split == "train" else view
        for view in capture.views
    ]
    return Capture(capture.path, views, capture.points)


def with_train_cameras(capture: Capture, cameras: list[Camera]) -> Capture:
    """The capture with other cameras of its train views, in their order."""
    each = iter(cameras)
    views = [
        replace(view, camera=next(each)) if view.split == "train" else view
        for view in capture.views
    ]
    return Capture(capture.path, views, capture.points)


def camera_rows(views: Sequence[View]) -> npt.NDArray[np.float64]:
    """Poses and focal lengths, float64 [V, 14]: the viewmat's first three rows, fx, fy."""
    return np.stack(
        [
            np.concatenate([view.camera.viewmat[:3].reshape(-1), view.camera.K[[0, 1], [0, 1]]])
            for view in views
        ]
    )


def with_camera_rows(views: list[View], rows: npt.NDArray[np.float64] | None) -> list[View]:
    """Return the views with the cameras of ``camera_rows``, or unchanged if there are none.

    Raises:
        ValueError: there is not a finite row for each view.
    """
    if rows is None:
        return views
    if rows.shape != (len(views), 14) or not np.isfinite(rows).all():
        raise ValueError(f"cameras: must be 14 finite numbers for each of {len(views)} views")
    moved = []
    for view, row in zip(views, rows, strict=True):
        viewmat, K = np.eye(4), view.camera.K.copy()
        viewmat[:3] = row[:12].reshape(3, 4)
        K[[0, 1], [0, 1]] = row[12:]
        try:
            moved.append(replace(view, camera=replace(view.camera, viewmat=viewmat, K=K)))
        except IgsrError as error:
            raise ValueError(f"cameras: {error}") from error
    return moved
