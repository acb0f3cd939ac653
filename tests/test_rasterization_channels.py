"""``rasterization``: any number of channels, backgrounds and masks per pixel, expected depth."""

import pytest
import torch
from gradients import check_gradients, check_scene, leaves
from scenes import HEIGHT, WIDTH, rasterized, torch_scene

BACKENDS = ["cpu", "reference"]


def feature_scene(channels, per_camera=False, dtype=torch.float32, **options):
    """A scene with direct colors [N, D] or [C, N, D] and without backgrounds."""
    scene = torch_scene(dtype=dtype, **options)
    count, cameras = len(scene["means"]), len(scene["viewmats"])
    generator = torch.Generator().manual_seed(5)
    shape = (cameras, count, channels) if per_camera else (count, channels)
    scene["colors"] = torch.randn(shape, generator=generator, dtype=torch.float64).to(dtype)
    del scene["backgrounds"]
    return scene


def random(*shape, dtype=torch.float32, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(shape, generator=generator, dtype=torch.float64).to(dtype)


def run(scene, **options):
    return rasterized(scene, sh_degree=None, **options)


def gradients(scene, loss):
    tensors = leaves(scene)
    loss(tensors).backward()
    return {name: tensor.grad for name, tensor in tensors.items()}


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("per_camera", [False, True])
@pytest.mark.parametrize("channels", [1, 2, 4, 7])
def test_each_channel_equals_a_render_of_it_alone(channels, per_camera, packed, backend):
    scene = feature_scene(channels, per_camera)
    backgrounds = random(2, channels)
    picture, alpha, _ = run(scene, backgrounds=backgrounds, packed=packed, backend=backend)
    assert picture.shape == (2, HEIGHT, WIDTH, channels)
    for channel in range(channels):
        gray = {**scene, "colors": scene["colors"][..., [channel] * 3]}
        behind = backgrounds[:, [channel] * 3]
        alone, alone_alpha, _ = run(gray, backgrounds=behind, packed=packed, backend=backend)
        assert torch.equal(picture[..., channel], alone[..., 0])
        assert torch.equal(alpha, alone_alpha)


@pytest.mark.parametrize("render_mode", ["RGB+D", "RGB+ED", "D", "ED"])
@pytest.mark.parametrize("channels", [1, 5])
def test_depth_does_not_depend_on_the_channels(channels, render_mode):
    scene = feature_scene(channels)
    plain = {**scene, "colors": scene["colors"][..., [0, 0, 0]]}
    picture, _, _ = run(scene, render_mode=render_mode)
    three, _, _ = run(plain, render_mode=render_mode)
    assert picture.shape[-1] == (channels + 1 if "+" in render_mode else 1)
    assert torch.equal(picture[..., -1], three[..., -1])


def test_no_picture_depends_on_channel_chunk():
    scene = feature_scene(5)
    picture, _, _ = run(scene)
    for chunk in (1, 4, 100):
        assert torch.equal(run(scene, channel_chunk=chunk)[0], picture)


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_gradients_of_channels_match_finite_differences(channels):
    scene = feature_scene(channels, dtype=torch.float64, count=5)
    scene["backgrounds"] = random(2, channels, dtype=torch.float64)
    names = ["means", "quats", "scales", "opacities", "colors", "backgrounds"]
    # Alpha and depth come from one of the passes: they must not count in each.
    check_scene(scene, names, sh_degree=None, render_mode="RGB+ED")


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("channels", [3, 5])
def test_a_constant_background_image_equals_a_color(channels, render_mode):
    scene = feature_scene(channels)
    uniform = random(2, channels)
    pixels = uniform[:, None, None].repeat(1, HEIGHT, WIDTH, 1)
    expected, expected_alpha, _ = run(scene, backgrounds=uniform, render_mode=render_mode)
    picture, alpha, _ = run(scene, backgrounds=pixels, render_mode=render_mode)
    assert (picture - expected).abs().max() <= 1e-6 * expected.abs().max()
    assert torch.equal(alpha, expected_alpha)


def test_backgrounds_are_weighted_by_the_exact_transmittance():
    # Three nearly opaque layers: 1 - alpha would be wrong in its fourth digit.
    scene = feature_scene(3, cameras=1, count=3, dtype=torch.float32)
    scene["means"] = torch.tensor([[0.0, 0, 4], [0, 0, 5], [0, 0, 6]])
    scene["scales"] = torch.full((3, 3), 1e4)
    scene["opacities"] = torch.tensor([0.95, 0.95, 0.955])
    scene["colors"] = torch.zeros(3, 3)
    bright = torch.full((1, HEIGHT, WIDTH, 3), 1e6)
    picture, _, _ = run(scene, backgrounds=bright)
    exact = (1 - scene["opacities"].double()).prod() * 1e6
    assert abs(picture[0, 10, 12, 0] / exact - 1) < 1e-5


@pytest.mark.parametrize("channels", [3, 4])
def test_gradients_of_pixel_backgrounds_match_finite_differences(channels):
    scene = feature_scene(channels, dtype=torch.float64, count=5)
    scene["backgrounds"] = random(2, HEIGHT, WIDTH, channels, dtype=torch.float64)
    masks = random(2, HEIGHT, WIDTH, seed=2) < 0.7
    names = ["means", "opacities", "colors"]
    along = random(*scene["backgrounds"].shape, dtype=torch.float64, seed=3)

    def render(step, *tensors):
        arguments = {**scene, **dict(zip(names, tensors, strict=True))}
        # One direction of all the background's numbers: there are too many to move one by one.
        arguments["backgrounds"] = scene["backgrounds"] + step * along
        picture, alpha, _ = run(arguments, backend="reference", render_mode="RGB+ED", masks=masks)
        return picture.square().sum() + alpha.square().sum()

    zero = torch.zeros((), dtype=torch.float64)
    check_gradients(render, [zero, *(scene[name] for name in names)])


@pytest.mark.parametrize("background", ["none", "uniform", "pixels"])
@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize("packed", [False, True])
def test_masked_pixels_show_the_background_and_pass_no_gradient(packed, channels, background):
    scene = feature_scene(channels)
    masks = random(2, HEIGHT, WIDTH) < 0.5
    if background != "none":
        shape = (2, channels) if background == "uniform" else (2, HEIGHT, WIDTH, channels)
        scene["backgrounds"] = random(*shape, seed=3)
    options = {"packed": packed, "render_mode": "RGB+ED", "render_normals": True}
    picture, alpha, meta = run(scene, masks=masks, **options)
    whole, whole_alpha, whole_meta = run(scene, **options)
    normals, whole_normals = meta["render_normals"], whole_meta["render_normals"]
    assert torch.equal(picture[masks], whole[masks])
    assert torch.equal(alpha[masks], whole_alpha[masks])
    assert torch.equal(normals[masks], whole_normals[masks])
    behind = torch.zeros(2, HEIGHT, WIDTH, channels)
    if background == "uniform":
        behind += scene["backgrounds"][:, None, None]
    elif background == "pixels":
        behind = scene["backgrounds"]
    assert torch.equal(picture[~masks][:, :-1], behind[~masks])
    assert not picture[~masks][:, -1].any()
    assert not alpha[~masks].any()
    assert not normals[~masks].any()

    def gradients_given(v_masked):
        tensors = leaves(scene)
        picture, alpha, meta = run(tensors, masks=masks, **options)
        shown = torch.cat([picture, alpha, meta["render_normals"]], dim=-1)
        v_shown = shown.detach().clone()
        v_shown[~masks] = v_masked
        shown.backward(v_shown)
        return {name: t.grad for name, t in tensors.items() if name != "backgrounds"}

    expected, found = gradients_given(0.0), gradients_given(float("nan"))
    for name, gradient in expected.items():
        assert gradient.any()
        assert torch.equal(found[name], gradient), name


def test_masked_pixels_give_the_background_its_gradient():
    scene = feature_scene(3)
    scene["backgrounds"] = random(2, 3)
    masks = torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    found = gradients(scene, lambda tensors: run(tensors, masks=masks)[0].sum())
    assert torch.equal(found["backgrounds"], torch.full((2, 3), float(WIDTH * HEIGHT)))
    for name in ("means", "opacities", "colors"):
        assert not found[name].any()


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("render_mode", ["ED", "RGB+ED"])
def test_expected_depth_is_zero_where_nothing_is_drawn(render_mode, backend):
    scene = feature_scene(3, count=2, cameras=1)
    scene["means"][:] = torch.tensor([0.0, 0.0, 4.0])
    scene["scales"][:] = 0.2
    options = {"render_mode": render_mode, "backend": backend}
    picture, alpha, _ = run(scene, **options)
    depth, empty = picture[..., -1], alpha[..., 0] == 0
    assert 0 < empty.sum() < empty.numel()
    assert not depth[empty].any()
    assert (depth[~empty] - 4.0).abs().max() < 1e-4

    def loss(tensors):
        # 1e30 on every pixel: a division by a clamped alpha would make it overflow.
        return 1e30 * run(tensors, **options)[0][..., -1][empty].sum()

    for name, gradient in gradients(scene, loss).items():
        assert not gradient.any(), name
