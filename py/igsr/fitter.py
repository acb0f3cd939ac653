"""The renderer's fitter, made from views and read back as cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from . import _core
from .capture import Camera, View
from .capture.types import intrinsic_matrix
from .rendering import intrinsics_of, viewmat_about


def fitter_of(
    views: Sequence[View],
    origin: npt.NDArray[np.float64],
    state: dict[str, Any],
    settings: dict[str, Any],
    backend: str,
) -> _core.Fitter:
    """A fit in progress of ``state``, relative to ``origin``, to the views; see ``_core.Fitter``.

    Raises:
        ValueError: a view, the state or a setting cannot be used; the message names it.
    """
    return _core.Fitter(
        [np.ascontiguousarray(view.image) for view in views],
        [None if view.mask is None else np.ascontiguousarray(view.mask) for view in views],
        np.stack([viewmat_about(origin, view.camera.viewmat) for view in views]),
        np.stack([intrinsics_of(view.camera.K) for view in views]),
        state,
        settings,
        backend,
    )


def fitted_cameras(
    views: Sequence[View], fitter: _core.Fitter, origin: npt.NDArray[np.float64]
) -> list[Camera]:
    """The views' cameras with poses and focal lengths as a fitter has them.

    Args:
        views: V views.
        fitter: of these views.
        origin: [3] of the splats, which the fitter's poses are relative to.
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
