"""What the pages of ``report.html`` share: templates, pictures and cameras.

A page is one file with everything inside. It extends ``templates/page.html.jinja``; all text is
escaped.
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
    MOST_COMPARED,
    PageCamera,
    PageModel,
    compared,
    scene_page,
)

#: Longest side of pictures beside each other, pixels.
BESIDE = 480
#: Height of the scene, pixels.
SCENE_HEIGHT = 560
#: How the page's script draws cameras, by the first number of each.
PHOTO, ADDED, REJECTED = 0, 1, 2


def write_template(path: Path, templates: Path, name: str, variables: Mapping[str, Any]) -> None:
    """Write a page, whole or not at all; it needs nothing but a browser.

    Args:
        path: where to.
        templates: folder of the page's own template.
        name: of the template.
        variables: what is put into it.

    Raises:
        IgsrError: the file cannot be written.
    """
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
        # A file may be named by bytes that are no text.
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace")


def beside(views: Sequence[ScoredView]) -> list[dict[str, Any]]:
    """Photo, render and error of each view, as the template has them.

    Args:
        views: with "psnr" among their scores.
    """
    return [
        {
            "name": one.name,
            "psnr": one.scores["psnr"],
            "white": ERROR_WHITE,
            "photo": jpeg(one.photo, BESIDE),
            "render": jpeg(one.render, BESIDE),
            "error": jpeg(error_picture(one), BESIDE),
        }
        for one in views
    ]


def scene_frame(
    models: Sequence[PageModel],
    cameras: Sequence[PageCamera],
    background: Sequence[float],
    title: str,
) -> str | None:
    """The scene to turn, as HTML of a frame; None where it cannot be within a report.

    It cannot where it has more than ``MOST_COMPARED`` splats, which make a page of some 10 MB, or
    where the page's format cannot hold it: the report stands without.

    Args:
        models: the last is shown, and compared with the others where there is room for them.
        cameras: of the photos that were fitted, to which the page jumps; see ``fitted_cameras``.
        background: RGB in [0, 1] behind the splats.
        title: of the page, and the name of its screenshots.
    """
    shown = compared(models)
    if sum(len(one.splats) for one in shown) > MOST_COMPARED:
        return None
    try:
        page, _ = scene_page(shown, cameras, background, title, compares=True)
    except IgsrError:
        return None
    return framed(page, SCENE_HEIGHT)


def fitted_cameras(capture: Capture) -> list[PageCamera]:
    """The cameras of the photos that were fitted."""
    return [PageCamera(view.name, view.camera) for view in capture.train_views]


def part_rows(
    parts: Mapping[str, Mapping[str, Any]], names: Mapping[str, str]
) -> list[dict[str, Any]]:
    """Rows of the table of seconds and memory.

    Args:
        parts: the usage of each part, as reports have it.
        names: what the page calls parts, where that differs.
    """
    return [{"name": names.get(name, name), **usage} for name, usage in parts.items()]


def number(value: float | None, digits: int) -> str:
    """A score with so many decimals; "-" where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def drawn_cameras(
    kinds: Sequence[tuple[int, Sequence[Camera]]], size_of: Sequence[Camera]
) -> list[tuple[int, list[list[float]]]]:
    """What the page's script draws: a kind, and a camera's centre and corners, [5, 3].

    Coordinates are relative to the middle of some cameras' centres, of which the farthest is at
    distance 1.

    Args:
        kinds: cameras of each kind, drawn in this order.
        size_of: the cameras that place and size are taken from; at least one.
    """
    centres = np.stack([camera.center for camera in size_of])
    middle = centres.mean(axis=0)
    size = max(float(np.linalg.norm(centres - middle, axis=1).max()), 1e-9)
    return [
        (kind, np.round((_frustum(camera, 0.18 * size) - middle) / size, 4).tolist())
        for kind, cameras in kinds
        for camera in cameras
    ]


def jpeg(picture: npt.NDArray[np.uint8], longest: int) -> str:
    """A picture, uint8 [H, W] or [H, W, 3], as a JPEG of at most so many pixels, in base64."""
    image = Image.fromarray(picture)
    image.thumbnail((longest, longest), Image.Resampling.BOX)
    file = io.BytesIO()
    image.convert("RGB").save(file, format="JPEG", quality=88)
    return base64.b64encode(file.getvalue()).decode("ascii")


def _frustum(camera: Camera, depth: float) -> npt.NDArray[np.float64]:
    """The camera's centre and its picture's corners at a depth, [5, 3], world."""
    K, w, h = camera.K, camera.width, camera.height
    corners = np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]])
    rays = np.concatenate([(corners - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones((4, 1))], axis=1)
    world: npt.NDArray[np.float64] = depth * rays @ camera.viewmat[:3, :3] + camera.center
    return np.concatenate([camera.center[None], world])
