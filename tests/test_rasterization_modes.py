"""``rasterization``: absolute gradients for density control, and the antialiased mode."""

import gsplat
import pytest
import torch
from gradients import check_scene, leaves
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from scenes import HEIGHT, WIDTH, torch_scene
from scenes import rasterized as run

from igsr import rasterization


def small_scene(count=6, **options):
    """A scene for 8 x 5 pixels, each with a separate loss."""
    scene = torch_scene(count=count, **options)
    scene["Ks"][:, :2] = scene["Ks"][:, :2] / 3.0
    return scene


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D"])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize(("backend", "bound"), [("reference", 1e-12), ("cpu", 1e-5)])
def test_absgrad_sums_the_absolute_gradients_of_all_pixels(
    backend, bound, cameras, packed, render_mode
):
    dtype = torch.float64 if backend == "reference" else torch.float32
    scene = small_scene(cameras=cameras, dtype=dtype)
    scene["means"][1, 2] = -3.0  # one that is not drawn
    size = {"width": 8, "height": 5, "sh_degree": 2}
    options = {"packed": packed, "render_mode": render_mode, "backend": backend}
    picture, alpha, meta = rasterization(**leaves(scene), **size, **options, absgrad=True)
    weights = torch.linspace(-1.0, 2.0, picture.numel(), dtype=dtype).reshape(picture.shape)
    pixels = (picture * weights).sum(dim=-1) + alpha[..., 0].square()
    means2d = meta["means2d"]
    expected, total = torch.zeros_like(means2d), torch.zeros_like(means2d)
    for pixel in pixels.flatten():
        (of_pixel,) = torch.autograd.grad(pixel, means2d, retain_graph=True)
        expected += of_pixel.abs()
        total += of_pixel
    means2d.retain_grad()
    pixels.sum().backward()
    assert means2d.absgrad.shape == means2d.shape
    assert means2d.absgrad.dtype == dtype
    scale = expected.max()
    assert scale > 1.2 * total.abs().max()  # signs do cancel here
    assert (means2d.absgrad - expected).abs().max() <= bound * scale
    assert (means2d.grad - total).abs().max() <= bound * scale


def test_absgrad_changes_nothing_else_and_is_of_the_last_backward():
    outcomes = []
    for absgrad in (False, True):
        scene = leaves(torch_scene(count=30))
        picture, _, meta = run(scene, absgrad=absgrad)
        picture.square().sum().backward(retain_graph=True)
        outcomes.append([picture, *(tensor.grad for tensor in scene.values())])
        assert hasattr(meta["means2d"], "absgrad") == absgrad
    assert all(map(torch.equal, *outcomes))
    first = meta["means2d"].absgrad.clone()
    (2.0 * picture.square().sum()).backward()
    assert torch.equal(meta["means2d"].absgrad, 2.0 * first)


@pytest.mark.parametrize("packed", [False, True])
def test_gsplats_strategy_reads_absgrad(packed):
    scene = torch_scene(count=30, cameras=2)
    params = torch.nn.ParameterDict(
        {name: torch.nn.Parameter(scene[name]) for name in ("means", "quats", "scales")}
        | {"opacities": torch.nn.Parameter(torch.logit(scene["opacities"]))}
    )
    optimizers = {name: torch.optim.Adam([params[name]]) for name in params}
    strategy = gsplat.DefaultStrategy(absgrad=True)
    state = strategy.initialize_state()
    arguments = {**scene, **params, "opacities": torch.sigmoid(params["opacities"])}
    picture, _, meta = run(arguments, absgrad=True, packed=packed)
    strategy.step_pre_backward(params, optimizers, state, 0, meta)
    picture.square().sum().backward()
    strategy.step_post_backward(params, optimizers, state, 0, meta, packed=packed)
    assert state["grad2d"].shape == (30,)
    assert state["grad2d"].max() > 0


@pytest.mark.parametrize("eps2d", [0.3, 1.5])
def test_antialiased_opacities_match_gsplat(eps2d):
    """Against gsplat's own formula, in its plain-torch twin of the CUDA kernel."""
    scene = torch_scene(count=20, dtype=torch.float64)
    scene["scales"] = scene["scales"] * torch.logspace(-3, 0, 20, dtype=torch.float64)[:, None]
    options = {"backend": "reference", "packed": False, "eps2d": eps2d}
    _, _, meta = run(scene, rasterize_mode="antialiased", **options)
    _, _, classic = run(scene, **options)
    covars, _ = _quat_scale_to_covar_preci(scene["quats"], scene["scales"], True, False, False)
    cameras = (scene["viewmats"], scene["Ks"], WIDTH, HEIGHT)
    _, _, _, conics, compensations = _fully_fused_projection(
        scene["means"], covars, *cameras, eps2d, calc_compensations=True
    )
    expected = scene["opacities"] * compensations
    drawn = (meta["radii"] > 0).all(dim=-1)
    assert torch.allclose(meta["opacities"][drawn], expected[drawn], rtol=1e-6, atol=1e-9)
    assert torch.allclose(meta["conics"][drawn], conics[drawn], rtol=1e-6, atol=1e-9)
    assert drawn.any()
    assert (meta["opacities"][drawn] < 0.9 * classic["opacities"][drawn]).any()
    # Opacities under 1/255 are not drawn.
    was_drawn = (classic["radii"] > 0).all(dim=-1)
    assert (expected[was_drawn & ~drawn] < 1 / 255).all()
    assert (was_drawn & ~drawn).any()


def test_antialiased_without_blur_equals_classic():
    scene = torch_scene(count=20)
    plain, _, _ = run(scene, eps2d=0.0)
    antialiased, _, _ = run(scene, eps2d=0.0, rasterize_mode="antialiased")
    assert (antialiased - plain).abs().max() <= 1e-6
    assert not torch.equal(run(scene)[0], run(scene, rasterize_mode="antialiased")[0])


@pytest.mark.parametrize("packed", [False, True])
def test_antialiased_gradients_match_finite_differences(packed):
    scene = torch_scene(count=6, dtype=torch.float64)
    scene["scales"] = scene["scales"] * 0.3  # small ones, whose opacity depends on their size
    names = ["means", "quats", "scales", "opacities", "colors"]
    options = {"render_mode": "RGB+ED", "rasterize_mode": "antialiased"}
    check_scene(scene, names, packed=packed, **options)
