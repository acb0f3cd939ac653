"""Properties of ``rasterization`` for random sizes, counts and poisoned values.

The profile in conftest.py makes the draws the same on every run.
"""

import numpy as np
import torch
from gradients import leaves
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import torch_scene

from igsr import rasterization

SPLATS = ("means", "quats", "scales", "opacities", "colors")
TINY = float(np.finfo(np.float32).tiny)
POISONS = [
    *(float("nan"), float("inf"), -float("inf")),
    *(1e38, -1e38, 3.4e38, TINY, TINY / 1024, -TINY / 1024, 0.0, -0.0),
]


@st.composite
def calls(draw, least=0):
    """Arguments of a call: any mode, count, size and number of channels."""
    count = draw(st.integers(least, 24))
    cameras = draw(st.integers(1, 3))
    width = draw(st.sampled_from([1, 2, 15, 16, 17, 33, 50]))
    height = draw(st.sampled_from([1, 3, 16, 19, 32]))
    scene = torch_scene(count=count, cameras=cameras, degree=1, seed=draw(st.integers(0, 999)))
    focal = 1.3 * max(width, height)
    scene["Ks"][:, 0, 0] = scene["Ks"][:, 1, 1] = focal
    scene["Ks"][:, 0, 2], scene["Ks"][:, 1, 2] = width * draw(st.floats(0, 1)), height / 2
    options = {
        "width": width,
        "height": height,
        "sh_degree": draw(st.sampled_from([None, 0, 1])),
        "packed": draw(st.booleans()),
        "render_mode": draw(st.sampled_from(["RGB", "D", "ED", "RGB+D", "RGB+ED"])),
        "rasterize_mode": draw(st.sampled_from(["classic", "antialiased"])),
        "render_normals": draw(st.booleans()),
        "backend": draw(st.sampled_from(["cpu", "reference"])),
    }
    channels = 3
    if options["sh_degree"] is None:
        channels = draw(st.integers(1, 7))
        scene["colors"] = scene["colors"].flatten(1)[:, :channels]
    generator = torch.Generator().manual_seed(draw(st.integers(0, 999)))
    if draw(st.booleans()):
        scene["backgrounds"] = torch.rand(cameras, height, width, channels, generator=generator)
    else:
        scene["backgrounds"] = torch.rand(cameras, channels, generator=generator)
    if draw(st.booleans()):
        options["masks"] = torch.rand(cameras, height, width, generator=generator) < 0.7
    return scene, options


def outcome(scene, options):
    """The picture, alpha and normals, and the gradients of all inputs of one loss of them."""
    tensors = leaves(scene)
    picture, alpha, meta = rasterization(**tensors, **options)
    normals = [meta["render_normals"]] if options["render_normals"] else []
    shown = torch.cat([picture, alpha, *normals], dim=-1)
    # Chosen by the picture's place only, so that it is the same whatever a splat does to the rest.
    weights = torch.linspace(-1.0, 1.0, shown.numel(), dtype=shown.dtype).reshape(shown.shape)
    shown.backward(weights)
    gradients = {
        name: torch.zeros_like(tensor) if tensor.grad is None else tensor.grad
        for name, tensor in tensors.items()
    }
    return shown.detach(), meta, gradients


def same(a, b):
    return a.shape == b.shape and torch.equal(a, b)


@given(call=calls())
@settings(max_examples=60)
def test_every_call_has_the_right_shapes_and_finite_numbers(call):
    scene, options = call
    shown, meta, gradients = outcome(scene, options)
    cameras, count = len(scene["viewmats"]), len(scene["means"])
    channels = {"D": 0, "ED": 0}.get(options["render_mode"], scene["backgrounds"].shape[-1])
    channels += "D" in options["render_mode"]
    channels += 1 + 3 * options["render_normals"]
    assert shown.shape == (cameras, options["height"], options["width"], channels)
    assert torch.isfinite(shown).all()
    for name, gradient in gradients.items():
        assert gradient.shape == scene[name].shape
        assert torch.isfinite(gradient).all(), name
    drawn = meta["radii"].shape[0] if options["packed"] else count
    assert meta["means2d"].shape[-2:] == (drawn, 2)


@given(call=calls())
@settings(max_examples=25)
def test_every_call_is_deterministic_with_and_without_packed(call):
    scene, options = call
    shown, _, gradients = outcome(scene, options)
    for packed in (options["packed"], not options["packed"]):
        again, _, gradients_again = outcome(scene, {**options, "packed": packed})
        assert same(shown, again)
        for name, gradient in gradients.items():
            assert same(gradient, gradients_again[name]), name


@given(
    call=calls(least=1),
    poison=st.sampled_from(POISONS),
    name=st.sampled_from(SPLATS),
    place=st.integers(0, 10_000),
)
@settings(max_examples=250)
def test_poisoned_splats_are_dropped_or_finite(call, poison, name, place):
    scene, options = call
    count = len(scene["means"])
    scene[name] = scene[name].contiguous()
    slots = scene[name].view(count, -1)
    splat, slot = place % count, place // count % slots.shape[1]
    slots[splat, slot] = poison
    shown, meta, gradients = outcome(scene, options)
    assert torch.isfinite(shown).all()
    for key, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), key

    if options["packed"]:
        drawn = (meta["gaussian_ids"] == splat).any()
    else:
        drawn = (meta["radii"][:, splat] > 0).any()
    degree = options["sh_degree"]
    unused = name == "colors" and degree is not None and slot >= 3 * (degree + 1) ** 2
    if not np.isfinite(poison) and not unused:
        assert not drawn
    if drawn:
        return
    kept = torch.arange(count) != splat
    without = {key: t[kept] if key in SPLATS else t for key, t in scene.items()}
    shown_without, _, gradients_without = outcome(without, options)
    assert same(shown, shown_without)
    for key, gradient in gradients.items():
        if key in SPLATS:
            assert not gradient[splat].any(), key
            gradient = gradient[kept]
        assert same(gradient, gradients_without[key]), key


@given(call=calls(least=2), order=st.randoms(use_true_random=False))
@settings(max_examples=25)
def test_the_picture_does_not_depend_on_the_order_of_splats(call, order):
    scene, options = call
    count = len(scene["means"])
    shuffled = list(range(count))
    order.shuffle(shuffled)
    moved = {key: t[shuffled] if key in SPLATS else t for key, t in scene.items()}
    shown, _, gradients = outcome(scene, options)
    shown_moved, _, gradients_moved = outcome(moved, options)
    assert same(shown, shown_moved)
    for key in SPLATS:
        assert same(gradients[key][shuffled], gradients_moved[key]), key
