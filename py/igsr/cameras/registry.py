"""Pose estimators by name."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from igsr._internal.extras import is_installed, naming_extra
from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.estimate import Estimator
from igsr.capture import Camera

if TYPE_CHECKING:
    from igsr.cameras.colmap.matchers import Choice


@dataclass(frozen=True)
class Entry:
    """An estimator.

    Attributes:
        make: creates the estimator; its parameters are the estimator's options.
        ready: whether packages and weights for these options are found.
    """

    make: Callable[..., Estimator]
    ready: Callable[[Mapping[str, Any]], bool]


def _dust3r(
    checkpoint: str | os.PathLike[str] | None = None,
    graph: str | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> Estimator:
    with naming_extra("estimator dust3r"):
        from igsr.cameras.dust3r.estimator import Dust3r

    return Dust3r(checkpoint=checkpoint, graph=graph, cameras=cameras)


def _colmap(matcher: Choice = "auto") -> Estimator:
    from igsr.cameras.colmap import Colmap

    return Colmap(matcher)


def _da3(
    checkpoint: str | os.PathLike[str] | None = None,
    bundle_adjustment: bool = True,
    matcher: Choice = "auto",
) -> Estimator:
    with naming_extra("estimator da3"):
        from igsr.cameras.da3.estimator import Da3

    return Da3(checkpoint=checkpoint, bundle_adjustment=bundle_adjustment, matcher=matcher)


def _is_ready(estimator: str) -> Callable[[Mapping[str, Any]], bool]:
    def is_ready(options: Mapping[str, Any]) -> bool:
        has_torch = is_installed("torch")
        return has_torch and find_checkpoint(estimator, options.get("checkpoint")) is not None

    return is_ready


ESTIMATORS = {
    "colmap": Entry(_colmap, lambda options: True),
    "dust3r": Entry(_dust3r, _is_ready("dust3r")),
    "da3": Entry(_da3, _is_ready("da3")),
}
#: Pose networks, in the order that "auto" looks for their weights.
NETWORKS = ("da3", "dust3r")
