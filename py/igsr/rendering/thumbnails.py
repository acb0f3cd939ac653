"""Pictures of splats, renders and refinements for notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from igsr._internal.choices import Backend
from igsr._internal.notebook import MAX_SIDE_PX, Picture
from igsr.rendering.renders import Render, render

if TYPE_CHECKING:
    from igsr.splats import Splats

#: A render for a notebook is made on the CPU: small, without waking a GPU.
BACKEND: Backend = "cpu"
#: Pictures of splats: as many sides of the scene.
SIDES = 2


def splats_pictures(splats: Splats) -> list[Picture]:
    """The scene from a few sides, each at a distance that frames it."""
    from igsr.geometry.camera_paths import cameras_around

    cameras = cameras_around(splats, SIDES, MAX_SIDE_PX)
    return [render(splats, camera, backend=BACKEND).to_uint8() for camera in cameras]


def render_pictures(picture: Render) -> list[Picture]:
    """The render itself."""
    return [picture.to_uint8()]


def refined_pictures(refined: Any) -> list[Picture]:
    """The scene of a refinement, as ``splats_pictures``."""
    return splats_pictures(refined.splats)
