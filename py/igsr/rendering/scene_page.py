"""``scene.html``: models and a viewer in one self-contained file, from the parts in ``web/``."""

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

#: Scripts in the order of concatenation; the last one starts the page.
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
#: Shaders by their names in ``painter.js``.
SHADERS = {
    "harmonics": "harmonics.glsl",
    "splatVertex": "splat.vert",
    "splatFragment": "splat.frag",
    "presentVertex": "present.vert",
    "presentFragment": "present.frag",
}
#: Up axis of scenes without cameras, as in COLMAP's and INRIA's scenes.
UP = (0.0, -1.0, 0.0)
#: Maximum total number of splats of a page with several models.
MAX_COMPARED_SPLATS = 300_000


@dataclass(frozen=True)
class PageCamera:
    """A camera that the page can jump to.

    Attributes:
        name: name of the photo.
        camera: pinhole camera, OpenCV axes, world frame of the capture.
    """

    name: str
    camera: Camera


@dataclass(frozen=True, eq=False)
class PageModel:
    """One of several models in a page.

    Attributes:
        label: its name on the page.
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
    """Write a self-contained page that shows models.

    The view starts at the first camera; without cameras, it frames the whole scene.

    Args:
        path: the file to write; its folder is created.
        splats: a model, or several to compare at a divider, the main one last. Splats that are not
            finite are left out.
        cameras: cameras to jump to, in the order of the page's list.
        background: RGB in [0, 1] behind the splats.
        title: the page's title, and the name of its screenshots.

    Returns:
        Messages about data that the page cannot hold, such as clipped values.

    Raises:
        IgsrError: ``background`` is not three numbers in [0, 1], the page's packed format cannot
            hold the model, or the file cannot be written.
    """
    text, notes = scene_page(splats, cameras, background, title)
    with atomic_write(path) as temporary:
        # File names may contain bytes that are not text.
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
    """Return the page of ``write_scene_page`` and its messages.

    With ``compares``, it starts with a comparison of the first and the last model.
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
    """Return a page without a model, which requests everything from its server."""
    return _page({"live": True, "models": [], **surroundings((), (0.0, 0.0, 0.0))}, [], title)


def compared(models: Sequence[PageModel]) -> list[PageModel]:
    """Return all models if they fit into a page, else only the last one."""
    fits = sum(len(one.splats) for one in models) <= MAX_COMPARED_SPLATS
    return list(models) if fits else [models[-1]]


def described_model(model: EmbeddedModel) -> dict[str, Any]:
    """Return the metadata of a model for the page's script."""
    return {
        "count": model.count,
        "origin": model.origin.tolist(),
        "unit": model.unit,
        "radius": model.radius,
        "near": model.near,
    }


def surroundings(cameras: Sequence[PageCamera], background: Sequence[float]) -> dict[str, Any]:
    """Return cameras, up axis and background for the page's script."""
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
    # In one pass, since values may look like placeholders.
    return re.sub(r"@([A-Z]+)@", lambda match: values[match[1]], _part("page.html"))


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
    """The mean up axis of the cameras; the default without cameras or a common axis."""
    up = np.asarray(UP)
    if cameras:
        mean = -np.mean([one.camera.viewmat[1, :3] for one in cameras], axis=0)
        length = float(np.linalg.norm(mean))
        up = mean / length if length > 1e-6 else up
    return [float(number) for number in up]


def _content_security_policy(script: str, style: str, *, is_live: bool) -> str:
    """Allow only this script and style, its workers, and for a live page requests to its server."""
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
    """JSON that is safe in an HTML script element."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def _part(name: str) -> str:
    return resources.files("igsr.rendering").joinpath("web", name).read_text(encoding="utf-8")
