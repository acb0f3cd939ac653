"""Small seeded scenes that several tests share."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from igsr import rasterization
from igsr.capture import Camera, Capture, PseudoView, View
from igsr.fitting import fit_capture
from igsr.rendering.renders import render
from igsr.splats import Splats


def torch_scene(count=12, cameras=2, degree=2, seed=0, dtype=torch.float32):
    """Arguments of ``rasterization`` up to Ks, for a 24 x 20 picture, and backgrounds."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(0.0, 0.2, cameras)
    K = torch.tensor([[30.0, 0, 12], [0, 31, 10], [0, 0, 1]], dtype=torch.float64)
    scene = {
        "means": normal(count, 3) * 0.5 + torch.tensor([0.0, 0.0, 4.0]),
        "quats": normal(count, 4),
        "scales": torch.exp(normal(count, 3) * 0.3 - 1.4),
        "opacities": torch.sigmoid(normal(count)),
        "colors": normal(count, (degree + 1) ** 2, 3) * 0.3,
        "viewmats": viewmats,
        "Ks": K.repeat(cameras, 1, 1),
        "backgrounds": torch.rand(cameras, 3, generator=generator, dtype=torch.float64),
    }
    return {name: tensor.to(dtype) for name, tensor in scene.items()}


#: Size of the picture of ``torch_scene``.
WIDTH, HEIGHT = 24, 20


def rasterized(scene, **options):
    """``rasterization`` of ``torch_scene``, by default of SH degree 2 on the CPU."""
    arguments = {"sh_degree": 2, "backend": "cpu", **options}
    return rasterization(**scene, width=WIDTH, height=HEIGHT, **arguments)


def splats(count=40, degree=1, seed=0, origin=(0.0, 0.0, 0.0)):
    """A ball of opaque colored splats around ``origin``."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    return Splats(
        means=random.normal(scale=0.35, size=(count, 3)).astype(np.float32),
        quats=quats.astype(np.float32),
        scales=random.uniform(-2.3, -1.4, size=(count, 3)).astype(np.float32),
        opacities=random.uniform(0.0, 3.0, size=count).astype(np.float32),
        sh=random.normal(scale=0.7, size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
        origin=np.asarray(origin, dtype=np.float64),
    )


def round_splats(means, size=0.05, opacity=2.0, color=0.5):
    """Round splats of one size (standard deviation), opacity (logit) and color."""
    count = len(means)
    gray = np.broadcast_to(np.asarray(color), (count, 1, 3))
    return Splats(
        means=np.ascontiguousarray(means, np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        scales=np.full((count, 3), np.log(size), np.float32),
        opacities=np.full(count, opacity, np.float32),
        sh=((gray - 0.5) / 0.28209479177387814).astype(np.float32),
    )


def ring_camera(angle, size=48, distance=4.0, center=(0.0, 0.0, 0.0)):
    """A camera on a ring in the x-z plane, y down, looking at ``center``."""
    back = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    z = -back
    y = np.array([0.0, 1.0, 0.0])
    x = np.cross(y, z)
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.stack([x, y, z])
    viewmat[:3, 3] = -viewmat[:3, :3] @ (np.asarray(center) + distance * back)
    K = np.array([[1.5 * size, 0.0, size / 2], [0.0, 1.5 * size, size / 2], [0.0, 0.0, 1.0]])
    return Camera(viewmat, K, size, size)


def perturbed_camera(camera, degrees, moved, seed):
    """The camera rotated by an angle about a random axis, its center moved by about a distance."""
    random = np.random.default_rng(seed)
    axis = random.normal(size=3)
    x, y, z = np.radians(degrees) * axis / np.linalg.norm(axis)
    rotation = np.linalg.qr(np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]))[0]
    rotation *= np.sign(np.diag(rotation))
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation @ camera.viewmat[:3, :3]
    center = camera.center + moved * random.normal(size=3) / np.sqrt(3.0)
    viewmat[:3, 3] = -viewmat[:3, :3] @ center
    return replace(camera, viewmat=viewmat)


def capture(views=8, size=48, alpha=False, scene=None, arc=2.0 * np.pi):
    """Photos of a scene by the reference, along an arc; every fourth is a test view."""
    scene = splats() if scene is None else scene
    result = []
    for i in range(views):
        camera = ring_camera(arc * i / views, size)
        picture = render(scene, camera, backend="reference")
        image = picture.to_uint8()
        if alpha:
            coverage = np.clip(picture.alpha, 1e-6, 1.0)
            straight = np.clip(picture.color / coverage[..., None], 0.0, 1.0)
            rgba = np.concatenate([straight, picture.alpha[..., None]], axis=-1)
            image = np.floor(rgba * 255.0 + 0.5).astype(np.uint8)
        split = "test" if i % 4 == 0 else "train"
        result.append(View(f"photos/{i:02d}.png", camera, split, image))
    return Capture(Path("made-up"), result)


def pseudo_view(view, **changes):
    """The view as a pseudo-view, by default with a weight of 1 for each pixel."""
    weights = np.ones(view.image.shape[:2], np.float32)
    return PseudoView(**{**vars(view), "weights": weights, **changes})


def write_capture(folder, made):
    """A made-up capture as transforms.json and PNG files; returns the folder."""
    frames = []
    for view in made.views:
        path = folder / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(view.image).save(path)
        pose = np.linalg.inv(view.camera.viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
        K = view.camera.K
        frame = {"file_path": view.name, "transform_matrix": pose.tolist()}
        frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        frames.append(frame | {"w": view.camera.width, "h": view.camera.height})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def project_call():
    """Arguments of ``_core.project`` that draw the small scene."""
    scene, camera = splats(), ring_camera(0.0)
    return {
        **{name: getattr(scene, name) for name in ("means", "quats", "scales", "opacities")},
        "colors": scene.sh,
        "sh_degree": 1,
        "raw_parameters": True,
        "viewmat": camera.viewmat,
        "intrinsics": np.array([72.0, 72.0, 24.0, 24.0]),
        "width": 48,
        "height": 48,
        "near": 0.01,
        "far": 100.0,
        "eps2d": 0.3,
        "antialiased": False,
        "backend": "cpu",
    }


def fit(capture, steps=None, **options):
    """The splats of a fit, without files or scores; see ``fit_capture``."""
    return fit_capture(capture, steps=steps, **options).splats


def fit_with_cameras(capture, steps=None, **options):
    """The splats of a fit, and the capture with fitted cameras, exposures and masks."""
    result = fit_capture(capture, steps=steps, **options)
    return result.splats, result.capture


def resumed_fit(capture, checkpoint, stop, **options):
    """The result of a fit that a listener ends at step ``stop`` and that is then resumed."""
    with pytest.raises(Stop):
        fit_capture(capture, checkpoint=checkpoint, report=stop_at(stop), **options)
    return fit_capture(capture, checkpoint=checkpoint, resume=True, **options)


class Stop(Exception):
    """Raised by listeners that end a run."""


def stop_at(step):
    """A listener that ends a fit at a step."""

    def listener(event):
        if event.stage == "fit" and event.done >= step:
            raise Stop

    return listener
