"""``scene.html``: models and a viewer in one file, which needs nothing but a browser.

The page's parts are the files of ``web/``, one job each; this module puts them together.
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from igsr import _core
from igsr._internal.atomic_write import atomic_write
from igsr.capture import Camera
from igsr.errors import IgsrError
from igsr.rendering.scene_model import EmbeddedModel, embedded_model
from igsr.splats import Splats

#: Scripts in the order that they are put together; the last one starts the page.
SCRIPTS = (
    "unpack.js",
    "packed.js",
    "sort.js",
    "viewpoint.js",
    "painter.js",
    "gestures.js",
    "viewer.js",
    "models.js",
    "divider.js",
    "panel.js",
    "live.js",
    "main.js",
)
#: Shaders by the names that the painter knows.
SHADERS = {
    "harmonics": "harmonics.glsl",
    "splatVertex": "splat.vert",
    "splatFragment": "splat.frag",
    "presentVertex": "present.vert",
    "presentFragment": "present.frag",
}
#: Near plane of small scenes, in their radii, as in splat-view.
NEAR_PART = 0.05
#: Up axis of scenes without cameras, as COLMAP's and INRIA's scenes have it.
UP = (0.0, -1.0, 0.0)
#: Pages with more splats in all leave out the models that the last is compared with: two or three
#: times as many bytes would be too many to send.
MAX_COMPARED_SPLATS = 300_000


@dataclass(frozen=True)
class PageCamera:
    """A camera that the page can jump to.

    Attributes:
        name: what the page calls it, a photo's name.
        camera: pinhole camera, OpenCV axes, world frame of the capture.
    """

    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class PageModel:
    """One of several models in a page.

    Attributes:
        label: what the page calls it.
        splats: the model.
    """

    label: str
    splats: Splats


def write_scene_page(
    path: str | os.PathLike[str],
    splats: Splats | Sequence[PageModel],
    cameras: Sequence[PageCamera] = (),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    title: str = "scene",
) -> list[str]:
    """Write a page that shows a model, whole or not at all.

    The page asks no other file or address for anything. It starts at the first camera; without
    cameras, at a view of the whole scene from a little above.

    Args:
        path: where to; its folder is made if it is missing.
        splats: the model; or several, of which the last is shown and any two are compared at a
            divider. Splats that are not finite are left out.
        cameras: cameras to jump to, in the order of the page's list.
        background: RGB in [0, 1] behind the splats.
        title: the page's title, and the name of its screenshots.

    Returns:
        A message for each thing that the page cannot hold, such as clipped values.

    Raises:
        IgsrError: ``background`` is not three numbers in [0, 1], the page's packed format cannot
            hold the model, or the file cannot be written.
    """
    text, notes = scene_page(splats, cameras, background, title)
    with atomic_write(path) as temporary:
        # A photo may be named by bytes that are no text.
        temporary.write_text(text, encoding="utf-8", errors="xmlcharrefreplace")
    return notes


def scene_page(
    splats: Splats | Sequence[PageModel],
    cameras: Sequence[PageCamera] = (),
    background: Sequence[float] = (0.0, 0.0, 0.0),
    title: str = "scene",
    *,
    compares: bool = False,
) -> tuple[str, list[str]]:
    """The page of ``write_scene_page`` as text, and its messages.

    With ``compares`` it starts with the first of several models beside the last.
    """
    named = [PageModel(title, splats)] if isinstance(splats, Splats) else list(splats)
    models = [embedded_model(one.splats) for one in named]
    described = [
        {"label": one.label, **described_model(model)}
        for one, model in zip(named, models, strict=True)
    ]
    scene = {
        "live": False,
        "compares": compares and len(models) > 1,
        "models": described,
        **surroundings(cameras, background),
    }
    return _page(scene, models, title), models[-1].notes


def live_page(title: str) -> str:
    """A page without a model, which asks the server that it comes from for all there is to show."""
    return _page({"live": True, "models": [], **surroundings((), (0.0, 0.0, 0.0))}, [], title)


def compared(models: Sequence[PageModel]) -> list[PageModel]:
    """The models that a page has room for: all, or the last alone."""
    fits = sum(len(one.splats) for one in models) <= MAX_COMPARED_SPLATS
    return list(models) if fits else [models[-1]]


def described_model(model: EmbeddedModel) -> dict[str, Any]:
    """What the page's script reads of a model beside its bytes."""
    return {
        "count": model.count,
        "origin": model.origin.tolist(),
        "unit": model.unit,
        "radius": model.radius,
        "near": min(_core.NEAR_PLANE * model.unit, NEAR_PART * model.radius),
    }


def surroundings(cameras: Sequence[PageCamera], background: Sequence[float]) -> dict[str, Any]:
    """What the page's script reads that is no model: cameras, up axis, background.

    Raises:
        IgsrError: ``background`` is not three numbers in [0, 1].
    """
    color = [float(channel) for channel in background]
    if len(color) != 3 or not all(0.0 <= channel <= 1.0 for channel in color):
        raise IgsrError("background must be three numbers in [0, 1]")
    return {"up": _up(cameras), "background": color, "cameras": [_camera(one) for one in cameras]}


def _page(scene: dict[str, Any], models: Sequence[EmbeddedModel], title: str) -> str:
    script = '"use strict";\n(() => {\n' + "\n".join(map(_part, SCRIPTS)) + "})();\n"
    style = _part("style.css")
    fixed = {
        "constants": {
            "BLUR": _core.EPS2D,
            "ALPHA_MIN": _core.ALPHA_MIN,
            "ALPHA_MAX": _core.ALPHA_MAX,
            "JACOBIAN_MARGIN": _core.JACOBIAN_MARGIN,
        },
        "shaders": {name: _part(file) for name, file in SHADERS.items()},
    }
    texts = [base64.b64encode(model.packed).decode("ascii") for model in models]
    values = {
        "CSP": _content_security_policy(script, style, is_live=scene["live"]),
        "VERSION": _core.__version__,
        "TITLE": html.escape(title),
        "STYLE": style,
        "SCENE": _json({**scene, **fixed}),
        "MODELS": "\n".join(
            f'<script type="text/plain" id="model-{k}">{text}</script>'
            for k, text in enumerate(texts)
        ),
        "SCRIPT": script,
    }
    # In one pass: what is put in may itself look like a place.
    return re.sub(r"@([A-Z]+)@", lambda place: values[place[1]], _part("page.html"))


def _camera(one: PageCamera) -> dict[str, Any]:
    camera = one.camera
    K = camera.K
    lens = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], camera.width, camera.height]
    return {
        "name": one.name,
        "rows": camera.viewmat[:3].ravel().tolist(),
        "lens": [float(number) for number in lens],
    }


def _up(cameras: Sequence[PageCamera]) -> list[float]:
    """The mean up axis of the cameras; -y where there are none, or they have none in common."""
    up = np.asarray(UP)
    if cameras:
        mean = -np.mean([one.camera.viewmat[1, :3] for one in cameras], axis=0)
        length = float(np.linalg.norm(mean))
        up = mean / length if length > 1e-6 else up
    return [float(number) for number in up]


def _content_security_policy(script: str, style: str, *, is_live: bool) -> str:
    """Allows this script and style alone, and a worker made of the script's text.

    A live page may ask the server that it comes from; any other may ask nothing.
    """
    hashes = {
        name: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")
        for name, text in (("script", script), ("style", style))
    }
    own = "connect-src 'self'; img-src 'self' data: blob:" if is_live else "img-src data: blob:"
    return (
        f"default-src 'none'; script-src 'sha256-{hashes['script']}'; "
        f"style-src 'sha256-{hashes['style']}'; worker-src blob:; {own}"
    )


def _json(value: dict[str, Any]) -> str:
    """JSON that may stand in an HTML script element, whatever names it holds."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _part(name: str) -> str:
    return resources.files("igsr.rendering").joinpath("web", name).read_text(encoding="utf-8")
