"""Pictures of splats, renders and refinements for notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from igsr._internal.choices import Backend
from igsr._internal.notebook import MAX_SIDE_PX, Picture
from igsr.rendering.renders import Render, render

if TYPE_CHECKING:
    from igsr.splats import Splats

#: Small renders need no GPU.
BACKEND: Backend = "cpu"
#: Number of pictures of a scene, from different sides.
VIEWS = 2


def splats_pictures(splats: Splats) -> list[Picture]:
    """Render the scene from a few sides."""
    from igsr.geometry.camera_paths import cameras_around

    cameras = cameras_around(splats, VIEWS, MAX_SIDE_PX)
    return [render(splats, camera, backend=BACKEND).to_uint8() for camera in cameras]


def render_pictures(picture: Render) -> list[Picture]:
    """Return the render."""
    return [picture.to_uint8()]


def refined_pictures(refined: Any) -> list[Picture]:
    """Render the scene of a refinement; see ``splats_pictures``."""
    return splats_pictures(refined.splats)
