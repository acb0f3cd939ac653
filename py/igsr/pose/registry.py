"""The pose estimators by name; a new one is a file of its own and an entry here."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from igsr._internal.extras import is_installed, naming_extra
from igsr.capture import Camera
from igsr.pose.estimate import Estimator

if TYPE_CHECKING:
    from igsr.pose.colmap.matcher import Matcher


@dataclass(frozen=True)
class Entry:
    """How an estimator is made.

    Attributes:
        make: makes it; its parameters are the options of the estimator.
        ready: whether it can run here with these options; "auto" takes the first that can. A
            network without torch is ready only where its checkpoint was named, for the message that
            says what is missing.
    """

    make: Callable[..., Estimator]
    ready: Callable[[Mapping[str, Any]], bool]


def _dust3r(
    checkpoint: str | os.PathLike[str] | None = None,
    graph: str | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> Estimator:
    with naming_extra("estimator dust3r"):
        from igsr.pose.dust3r.estimator import Dust3r

    return Dust3r(checkpoint=checkpoint, graph=graph, cameras=cameras)


def _dust3r_is_ready(options: Mapping[str, Any]) -> bool:
    if not is_installed("torch"):
        return options.get("checkpoint") is not None
    from igsr.pose.dust3r.checkpoint import find_checkpoint

    return find_checkpoint(options.get("checkpoint")) is not None


def _colmap(matcher: str | Matcher = "sift") -> Estimator:
    from igsr.pose.colmap import Colmap

    return Colmap(matcher)


def _da3(
    checkpoint: str | os.PathLike[str] | None = None,
    cameras: Mapping[str, Camera] | None = None,
    cameras_from: str = "decoder",
    bundle_adjustment: bool = True,
    matcher: str | Matcher = "sift",
) -> Estimator:
    with naming_extra("estimator da3"):
        from igsr.pose.da3.estimator import Da3

    return Da3(
        checkpoint=checkpoint,
        cameras=cameras,
        cameras_from=cameras_from,
        bundle_adjustment=bundle_adjustment,
        matcher=matcher,
    )


def _da3_is_ready(options: Mapping[str, Any]) -> bool:
    if not is_installed("torch"):
        return options.get("checkpoint") is not None
    from igsr.pose.da3.checkpoint import find_checkpoint

    return find_checkpoint(options.get("checkpoint")) is not None


#: In the order that "auto" tries them. Depth Anything 3 comes before COLMAP, whose cameras stand
#: there, too, where it places all photos. COLMAP is always ready, and is last.
ESTIMATORS = {
    "dust3r": Entry(_dust3r, _dust3r_is_ready),
    "da3": Entry(_da3, _da3_is_ready),
    "colmap": Entry(_colmap, lambda options: True),
}
