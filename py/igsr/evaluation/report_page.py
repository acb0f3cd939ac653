"""Shared parts of ``report.html`` pages: templates, pictures and cameras.

A page is one self-contained file that extends ``templates/page.html.jinja``; all text is escaped.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr._internal.atomic_write import atomic_write
from igsr.capture import Camera, Capture
from igsr.errors import IgsrError
from igsr.evaluation.contact_sheet import ERROR_WHITE, error_picture
from igsr.evaluation.scores import ScoredView
from igsr.rendering.notebook_page import framed
from igsr.rendering.scene_page import (
    MAX_COMPARED_SPLATS,
    PageCamera,
    PageModel,
    compared,
    scene_page,
)

#: Longest side of pictures shown side by side.
PICTURE_PX = 480
SCENE_HEIGHT_PX = 560
#: Kinds of cameras, which the page's script draws differently.
PHOTO, ADDED, REJECTED = 0, 1, 2


def write_template(path: Path, templates: Path, name: str, variables: Mapping[str, Any]) -> None:
    """Write a page from the template ``name`` in the folder ``templates``."""
    shared = Path(__file__).with_name("templates")
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([templates, shared]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    text = environment.get_template(name).render(variables)
    with atomic_write(path) as temporary:
        # File names may contain bytes that are not text.
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace")


def photos_and_renders(views: Sequence[ScoredView]) -> list[dict[str, Any]]:
    """Prepare photo, render and error of each view, scored by PSNR, for the template."""
    return [
        {
            "name": one.name,
            "psnr": one.scores["psnr"],
            "white": ERROR_WHITE,
            "photo": jpeg(one.photo, PICTURE_PX),
            "render": jpeg(one.render, PICTURE_PX),
            "error": jpeg(error_picture(one), PICTURE_PX),
        }
        for one in views
    ]


def scene_frame(
    models: Sequence[PageModel],
    cameras: Sequence[PageCamera],
    background: Sequence[float],
    title: str,
) -> str | None:
    """Embed an interactive view of the scene in a report.

    Args:
        models: the last one is shown, and compared with earlier ones if they fit.
        cameras: of the fitted photos, from ``fitted_cameras``.
        background: RGB in [0, 1] behind the splats.
        title: of the page, and the name of its screenshots.

    Returns:
        HTML of a frame; None if the scene has more than ``MAX_COMPARED_SPLATS`` splats (about
        10 MB) or cannot be packed.
    """
    shown = compared(models)
    if sum(len(one.splats) for one in shown) > MAX_COMPARED_SPLATS:
        return None
    try:
        page, _ = scene_page(shown, cameras, background, title, compares=True)
    except IgsrError:
        return None
    return framed(page, SCENE_HEIGHT_PX)


def fitted_cameras(capture: Capture) -> list[PageCamera]:
    """Return the cameras of the train views."""
    return [PageCamera(view.name, view.camera) for view in capture.train_views]


def part_rows(
    parts: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Return the rows of the table of time and memory; ``names`` are display names of parts."""
    return [{"name": names.get(name, name), **usage} for name, usage in parts.items()]


def number(value: float | None, digits: int) -> str:
    """Format a score with ``digits`` decimals; "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def drawn_cameras(
    kinds: Sequence[tuple[int, Sequence[Camera]]], size_of: Sequence[Camera]
) -> list[tuple[int, list[list[float]]]]:
    """Compute the camera frustums that the page's script draws.

    Args:
        kinds: cameras by kind, in drawing order.
        size_of: cameras that define the coordinates: their mean center is the origin, and the
            farthest center has distance 1. At least one.

    Returns:
        The kind of each camera, and its center and picture corners, [5, 3].
    """
    centers = np.stack([camera.center for camera in size_of])
    origin = centers.mean(axis=0)
    size = max(float(np.linalg.norm(centers - origin, axis=1).max()), 1e-9)
    return [
        (kind, np.round((_frustum(camera, 0.18 * size) - origin) / size, 4).tolist())
        for kind, cameras in kinds
        for camera in cameras
    ]


def jpeg(picture: npt.NDArray[np.uint8], longest: int) -> str:
    """Encode a picture, uint8 [H, W] or [H, W, 3], as JPEG of ``longest`` pixels in base64."""
    image = Image.fromarray(picture)
    image.thumbnail((longest, longest), Image.Resampling.BOX)
    file = io.BytesIO()
    image.convert("RGB").save(file, format="JPEG", quality=88)
    return base64.b64encode(file.getvalue()).decode("ascii")


def _frustum(camera: Camera, depth: float) -> npt.NDArray[np.float64]:
    """The camera's center and its picture's corners at a depth, [5, 3], world frame."""
    K, w, h = camera.K, camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    rays = np.concatenate([(corners - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((4, 1))], axis=1)
    world: npt.NDArray[np.float64] = depth * rays @ camera.viewmat[:3, :3] + camera.center
    return np.concatenate([camera.center[None], world])
