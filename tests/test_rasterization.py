"""``rasterization``: gradients, gsplat's conventions, backends, and gsplat's own strategies."""

import math

import gsplat
import pytest
import torch
from gradients import check_gradients, intrinsic_matrices, leaves, lenses_of, weighted_sum
from gsplat.utils import normalized_quat_to_rotmat
from scenes import HEIGHT, WIDTH, torch_scene
from scenes import rasterized as run

from igsr import rasterization

MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D"])
def test_reference_gradients_match_finite_differences(packed, render_mode):
    scene = torch_scene(count=6, dtype=torch.float64)
    # The camera's free numbers: gradcheck would also move the fixed rows, which no camera has.
    poses, lenses = scene["viewmats"][:, :3].clone(), lenses_of(scene["Ks"])
    names = ["means", "quats", "scales", "opacities", "colors", "backgrounds"]

    def render(*tensors):
        arguments = dict(zip(names, tensors, strict=False))
        arguments["viewmats"] = torch.cat([tensors[-2], scene["viewmats"][:, 3:]], dim=1)
        arguments["Ks"] = intrinsic_matrices(tensors[-1])
        options = {"backend": "reference", "packed": packed, "render_mode": render_mode}
        color, alpha, _ = run(arguments, **options)
        return weighted_sum(color) + alpha.square().sum()

    check_gradients(render, [scene[name] for name in names] + [poses, lenses])


@pytest.mark.parametrize("fast", ["cpu", "gpu"])
@pytest.mark.parametrize("render_mode", MODES)
@pytest.mark.parametrize("sh_degree", [None, 0, 2])
def test_backends_match_reference(fast, render_mode, sh_degree):
    results = {}
    for backend, dtype in ((fast, torch.float32), ("reference", torch.float64)):
        scene = {name: tensor.to(dtype) for name, tensor in torch_scene(count=30).items()}
        if sh_degree is None:
            scene["colors"] = scene["colors"][:, 0].abs()
        scene = leaves(scene)
        options = {"backend": backend, "sh_degree": sh_degree, "render_mode": render_mode}
        color, alpha, _ = run(scene, packed=False, **options)
        (weighted_sum(color) + alpha.square().sum()).backward()
        gradients = {name: tensor.grad for name, tensor in scene.items()}
        results[backend] = (color.detach(), alpha.detach(), gradients)
    color, alpha, gradients = results[fast]
    exact_color, exact_alpha, exact_gradients = results["reference"]
    assert color.dtype == torch.float32
    assert exact_color.dtype == torch.float64
    # Depths are in world units, about 4 here, so the bound for pictures scales with them.
    assert (color - exact_color).abs().max() <= 1e-4 * (4 if "D" in render_mode else 1)
    assert (alpha - exact_alpha).abs().max() <= 1e-4
    for name, exact in exact_gradients.items():
        if exact is None:
            assert gradients[name] is None
            continue
        bound = (1e-4 if fast == "cpu" else 1e-3) * exact.abs().max().clamp(min=1e-6)
        assert (gradients[name] - exact).abs().max() <= bound, name


def test_packed_gives_the_same_picture_and_gradients():
    outcomes = []
    for packed in (False, True):
        scene = torch_scene(count=30)
        scene["means"][:5, 2] = -3.0  # behind the cameras
        scene = leaves(scene)
        color, alpha, meta = run(scene, packed=packed, render_mode="RGB+ED")
        meta["means2d"].retain_grad()
        color.square().sum().backward()
        outcomes.append((color, alpha, meta, [tensor.grad for tensor in scene.values()]))
    (color, alpha, meta, gradients), (color_p, alpha_p, meta_p, gradients_p) = outcomes
    assert torch.equal(color, color_p)
    assert torch.equal(alpha, alpha_p)
    for a, b in zip(gradients, gradients_p, strict=True):
        assert torch.equal(a, b)
    visible = (meta["radii"] > 0).all(dim=-1)
    assert 0 < visible.sum() < visible.numel()
    assert torch.equal(
        torch.stack(torch.where(visible)),
        torch.stack([meta_p["camera_ids"], meta_p["gaussian_ids"]]),
    )
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert torch.equal(meta[name][visible], meta_p[name])
    assert torch.equal(meta["means2d"].grad[visible], meta_p["means2d"].grad)
    assert not visible[:, :5].any()


INPUTS = ["means", "quats", "scales", "opacities", "colors", "viewmats", "Ks"]


def changed_before_backward(change, cameras, packed):
    """The gradients, or None if backward() refuses to compute them."""
    scene = leaves(torch_scene(cameras=cameras))
    render_mode = "RGB" if cameras == 1 else "RGB+ED"
    color, alpha, meta = run(scene, packed=packed, render_mode=render_mode)
    with torch.no_grad():
        change(scene, color, alpha, meta)
    try:
        (color.sum() + alpha.sum()).backward()
    except RuntimeError as refusal:
        assert "modified by an inplace operation" in str(refusal)
        return None
    return [tensor.grad for tensor in scene.values()]


@pytest.mark.parametrize("changed", INPUTS)
def test_backward_refuses_changed_inputs(changed):
    def change(scene, *_):
        scene[changed].mul_(1.2)

    assert changed_before_backward(change, cameras=2, packed=False) is None


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("cameras", [1, 2])
@pytest.mark.parametrize("changed", ["color", "alpha", "backgrounds", "meta"])
def test_changes_of_outputs_are_refused_or_have_no_effect(changed, cameras, packed):
    def change(scene, color, alpha, meta):
        tensors = {"color": color, "alpha": alpha, **scene, **meta}
        names = ("means2d", "depths", "opacities", "conics") if changed == "meta" else (changed,)
        for name in names:
            tensors[name].mul_(0.5)

    gradients = changed_before_backward(change, cameras, packed)
    if changed == "meta":
        assert gradients is None  # density control reads means2d's gradient
        return
    untouched = changed_before_backward(lambda *_: None, cameras, packed)
    assert all(map(torch.equal, gradients, untouched))


def test_backward_from_changed_meta_is_refused():
    scene = torch_scene(cameras=1)
    scene["means"].requires_grad_()
    _, _, meta = run(scene, packed=False)
    with torch.no_grad():
        meta["means2d"].mul_(0.5)  # saved for the backward pass
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        meta["depths"].sum().backward()


def test_shapes_and_meta_follow_gsplat():
    scene = torch_scene(count=9, cameras=3)
    for mode, channels in zip(MODES, (3, 1, 1, 4, 4), strict=True):
        color, alpha, _ = run(scene, render_mode=mode)
        assert color.shape == (3, HEIGHT, WIDTH, channels)
        assert alpha.shape == (3, HEIGHT, WIDTH, 1)
    _, _, meta = run(scene, packed=False)
    assert meta["means2d"].shape == (3, 9, 2)
    assert meta["radii"].shape == (3, 9, 2)
    assert meta["radii"].dtype == torch.int32
    assert meta["conics"].shape == (3, 9, 3)
    assert meta["depths"].shape == meta["opacities"].shape == (3, 9)
    assert (meta["width"], meta["height"], meta["n_cameras"]) == (WIDTH, HEIGHT, 3)


def test_conics_invert_the_projected_covariance():
    # A splat straight ahead: covariance (f s / z)^2 + eps2d on both axes, no correlation.
    scene = torch_scene(count=1, cameras=1)
    scene["means"] = torch.tensor([[0.0, 0.0, 5.0]])
    scene["scales"] = torch.full((1, 3), 0.5)
    _, _, meta = run(scene, packed=False, eps2d=0.3)
    variances = torch.tensor([(30 * 0.5 / 5) ** 2 + 0.3, (31 * 0.5 / 5) ** 2 + 0.3])
    xx, xy, yy = meta["conics"][0, 0]
    assert torch.allclose(torch.stack([xx, yy]), 1 / variances, rtol=1e-5)
    assert abs(xy) < 1e-7
    assert torch.allclose(meta["means2d"][0, 0], torch.tensor([12.0, 10.0]), atol=1e-5)


def test_one_splat_by_hand():
    scene = torch_scene(count=1, cameras=1)
    scene["means"] = torch.tensor([[0.5 * 4 / 30, 0.5 * 4 / 31, 4.0]])  # on a pixel's center
    scene["opacities"] = torch.tensor([0.5])
    scene["colors"] = torch.tensor([[0.2, 0.4, 0.6]])
    scene["backgrounds"] = torch.tensor([[1.0, 0.0, 0.5]])
    color, alpha, _ = run(scene, sh_degree=None, render_mode="RGB+D")
    expected = 0.5 * scene["colors"] + 0.5 * scene["backgrounds"]
    assert torch.allclose(color[0, 10, 12, :3], expected[0], atol=1e-6)
    assert color[0, 10, 12, 3] == pytest.approx(2.0, abs=1e-5)
    assert alpha[0, 10, 12, 0] == pytest.approx(0.5, abs=1e-6)


def test_no_splats_show_the_background():
    scene = torch_scene(count=1)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        scene[name] = scene[name][:0].requires_grad_()
    for packed in (False, True):
        color, alpha, _ = run(scene, packed=packed)
        assert torch.equal(color, scene["backgrounds"][:, None, None].expand_as(color))
        assert not alpha.any()
        color.sum().backward()


def test_radius_clip_drops_small_splats():
    scene = torch_scene(count=20)
    _, _, meta = run(scene, packed=False)
    largest = meta["radii"].max(dim=-1).values
    limit = float(largest.float().median())
    # Rounded radii are compared, so a fraction makes no difference.
    for clip in (limit, limit - 0.3):
        _, _, clipped = run(scene, packed=False, radius_clip=clip)
        kept = (clipped["radii"] > 0).all(dim=-1)
        assert torch.equal(kept, largest > clip)


def trainable(count=60):
    """Parameters and optimizers as in gsplat's examples, and a target to fit."""
    truth = torch_scene(count=count, cameras=3, seed=3)
    with torch.no_grad():
        target, _, _ = run(truth, packed=False)
    start = torch_scene(count=count, cameras=3, seed=4)
    params = torch.nn.ParameterDict(
        {
            "means": torch.nn.Parameter(start["means"]),
            "quats": torch.nn.Parameter(start["quats"]),
            "scales": torch.nn.Parameter(start["scales"].log()),
            "opacities": torch.nn.Parameter(torch.logit(start["opacities"])),
            "sh": torch.nn.Parameter(start["colors"]),
        }
    )
    rates = {"means": 2e-3, "quats": 1e-2, "scales": 1e-2, "opacities": 3e-2, "sh": 1e-2}
    optimizers = {name: torch.optim.Adam([params[name]], lr=rate) for name, rate in rates.items()}
    return params, optimizers, truth, target


def train(strategy, state, params, optimizers, truth, target, steps, packed, post):
    """gsplat's documented training loop with only the import of rasterization changed."""
    losses, counts = [], []
    for step in range(steps):
        color, _, info = rasterization(
            params["means"],
            params["quats"],
            torch.exp(params["scales"]),
            torch.sigmoid(params["opacities"]),
            params["sh"],
            truth["viewmats"],
            truth["Ks"],
            WIDTH,
            HEIGHT,
            sh_degree=2,
            packed=packed,
            backgrounds=truth["backgrounds"],
            backend="cpu",
        )
        if hasattr(strategy, "step_pre_backward"):
            strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (color - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, **post)
        losses.append(loss.item())
        counts.append(len(params["means"]))
    return losses, counts


@pytest.mark.parametrize("packed", [False, True])
def test_gsplat_default_strategy_runs_unchanged(packed):
    torch.manual_seed(0)
    params, optimizers, truth, target = trainable()
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=5, refine_every=10, grow_grad2d=1e-3, reset_every=1000
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    losses, counts = train(
        strategy, state, params, optimizers, truth, target, 45, packed, {"packed": packed}
    )
    assert max(counts) > 60  # it did grow
    assert losses[-1] < 0.6 * losses[0]


def relocation_in_torch(opacities, scales, ratios, binoms):
    """Equation 9 of "3DGS as Markov Chain Monte Carlo" (Kheradmand et al. 2024)."""
    n_max = len(binoms)
    ratios = ratios.clamp(1, n_max)
    new_opacities = 1 - (1 - opacities) ** (1 / ratios)
    new_scales = torch.empty_like(scales)
    for row, (opacity, new, n) in enumerate(
        zip(opacities.tolist(), new_opacities.tolist(), ratios.tolist(), strict=True)
    ):
        denominator = sum(
            math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
            for i in range(1, n + 1)
            for k in range(i)
        )
        new_scales[row] = opacity / denominator * scales[row]
    return new_opacities, new_scales


def covariance_in_torch(quats, scales, compute_covar, compute_preci, triu):
    assert compute_covar
    assert not compute_preci
    assert not triu
    rotations = normalized_quat_to_rotmat(torch.nn.functional.normalize(quats, dim=-1))
    factor = rotations * scales[:, None, :]
    return factor @ factor.transpose(1, 2), None


def test_gsplat_mcmc_strategy_runs_unchanged(monkeypatch):
    # gsplat computes these two in CUDA only, whatever renders: plain torch stands in for them.
    # The strategy itself, its sampling and its noise are gsplat's own code.
    monkeypatch.setattr(gsplat.strategy.ops, "compute_relocation", relocation_in_torch)
    monkeypatch.setattr(gsplat.strategy.ops, "quat_scale_to_covar_preci", covariance_in_torch)
    torch.manual_seed(0)
    params, optimizers, truth, target = trainable()
    with torch.no_grad():
        params["opacities"][:7] = -8.0  # dead: there is something to relocate
    strategy = gsplat.MCMCStrategy(cap_max=70, refine_start_iter=5, refine_every=10, noise_lr=1.0)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    losses, counts = train(
        strategy, state, params, optimizers, truth, target, 45, True, {"lr": 2e-3}
    )
    assert counts[-1] == 70
    assert torch.sigmoid(params["opacities"]).min() > 0.001
    assert losses[-1] < 0.6 * losses[0]
