"""``rasterization``: many cameras at once, gradients of poses and lenses, tensors of any layout."""

import pytest
import torch
from gradients import check_gradients, intrinsic_matrices, leaves, lenses_of, weighted_sum
from scenes import HEIGHT, WIDTH, torch_scene
from scenes import rasterized as run

PER_CAMERA = ("viewmats", "Ks", "backgrounds")


@pytest.mark.parametrize("per_camera_colors", [False, True])
@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("cameras", [1, 2, 5])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_batch_equals_its_cameras_one_by_one(backend, cameras, packed, per_camera_colors):
    scene = torch_scene(count=20, cameras=cameras)
    scene["means"][:4, 2] = -3.0  # behind the cameras
    if per_camera_colors:
        scale = torch.linspace(0.5, 1.0, cameras)
        scene["colors"] = scene["colors"] * scale[:, None, None, None]
    names = (*PER_CAMERA, "colors") if per_camera_colors else PER_CAMERA
    options = {"backend": backend, "packed": packed, "render_mode": "RGB+ED"}

    batch = leaves(scene)
    picture, alpha, _ = run(batch, **options)
    weights = torch.linspace(-1.0, 1.0, picture.numel()).reshape(picture.shape)
    (picture * weights).sum().backward()

    single = leaves(scene)
    # Autograd adds up the last camera's gradients first.
    for c in reversed(range(cameras)):
        of_camera = {
            name: tensor[c : c + 1] if name in names else tensor for name, tensor in single.items()
        }
        one, one_alpha, _ = run(of_camera, **options)
        assert torch.equal(picture[c], one[0])
        assert torch.equal(alpha[c], one_alpha[0])
        (one[0] * weights[c]).sum().backward()
    for name, tensor in single.items():
        if name in names:
            assert torch.equal(batch[name].grad, tensor.grad), name
        else:  # sums over cameras, perhaps in another order
            bound = 1e-6 * tensor.grad.abs().max()
            assert (batch[name].grad - tensor.grad).abs().max() <= bound, name


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
@pytest.mark.parametrize("center", [(12.0, 10.0), (3.0, 17.5), (-6.0, 25.0)])
def test_gradients_of_rotated_cameras_and_shifted_principal_points(
    center, rasterize_mode, render_mode
):
    scene = torch_scene(count=10, dtype=torch.float64)
    scene["scales"] = scene["scales"] * 1.5
    generator = torch.Generator().manual_seed(7)
    scene["Ks"][:, 0, 2], scene["Ks"][:, 1, 2] = center
    # So that the splats are in the picture despite the shifted principal point.
    shift = (torch.tensor([12.0, 10.0]) - torch.tensor(center)) / 30.0 * 4.0
    scene["means"][:, :2] += shift
    skew = torch.randn(2, 3, generator=generator, dtype=torch.float64) * 0.1
    twist = torch.cat([skew, scene["viewmats"][:, :3, 3]], dim=1)

    def render(twist, lenses, backgrounds):
        a, b, c = twist[:, :3].unbind(dim=1)
        zero = torch.zeros_like(a)
        cross = torch.stack([zero, -c, b, c, zero, -a, -b, a, zero], dim=1).reshape(-1, 3, 3)
        pose = torch.cat([torch.matrix_exp(cross), twist[:, 3:, None]], dim=2)
        viewmats = torch.cat([pose, scene["viewmats"][:, 3:]], dim=1)
        cameras = {"viewmats": viewmats, "Ks": intrinsic_matrices(lenses)}
        options = {"render_mode": render_mode, "rasterize_mode": rasterize_mode}
        arguments = {**scene, **cameras, "backgrounds": backgrounds}
        picture, alpha, _ = run(arguments, backend="reference", **options)
        return weighted_sum(picture) + alpha.square().sum()

    inputs = [twist, lenses_of(scene["Ks"]), scene["backgrounds"]]
    check_gradients(render, inputs)
    for gradient in torch.autograd.grad(render(*inputs), inputs):
        assert gradient.abs().max() > 1e-3


def test_fixed_entries_of_cameras_have_no_gradient():
    scene = leaves(torch_scene())
    run(scene)[0].sum().backward()
    v_viewmats, v_Ks = scene["viewmats"].grad, scene["Ks"].grad
    assert v_viewmats[:, :3].any()
    assert not v_viewmats[:, 3].any()
    fixed = torch.tensor([[False, True, False], [True, False, False], [True, True, True]])
    assert not v_Ks[:, fixed].any()
    assert (v_Ks[:, ~fixed] != 0).all()


@pytest.mark.parametrize("packed", [False, True])
def test_strided_tensors_give_the_same_result(packed):
    scene = torch_scene(count=20)
    scene["backgrounds"] = torch.rand(2, HEIGHT, WIDTH, 3)
    expected_scene = leaves(scene)
    options = {"packed": packed, "render_mode": "RGB+ED", "render_normals": True}

    def outcome(arguments):
        picture, alpha, meta = run(arguments, **options)
        normals = meta["render_normals"]
        # Gradients that are expanded, transposed and strided views.
        loss = picture.sum() + alpha.transpose(1, 2)[:, ::2].sum() + normals[..., ::2].sum()
        return picture, alpha, normals, loss

    expected = outcome(expected_scene)
    expected[-1].backward()

    strided = {}
    for name, tensor in scene.items():
        strided[name] = torch.stack([tensor, torch.full_like(tensor, 9.0)], dim=-1)
        strided[name].requires_grad_()
    views = {name: tensor[..., 0] for name, tensor in strided.items()}
    assert not any(view.is_contiguous() for view in views.values())
    found = outcome(views)
    found[-1].backward()
    for a, b in zip(expected, found, strict=True):
        assert torch.equal(a, b)
    for name, tensor in expected_scene.items():
        assert torch.equal(tensor.grad, strided[name].grad[..., 0]), name


def test_only_leaves_that_require_grad_get_gradients():
    scene = torch_scene()
    scene["colors"].requires_grad_()
    picture, _, _ = run(scene)
    picture.sum().backward()
    assert scene["colors"].grad.any()
    assert all(tensor.grad is None for name, tensor in scene.items() if name != "colors")
    with torch.no_grad():
        silent, _, _ = run(scene)
    assert not silent.requires_grad
    assert torch.equal(silent, picture)


def test_cameras_in_float32_and_float64():
    scene = torch_scene()
    double = {**scene, "viewmats": scene["viewmats"].double(), "Ks": scene["Ks"].double()}
    for arguments in (scene, double):
        for name in ("viewmats", "Ks"):
            arguments[name].requires_grad_()
    picture, double_picture = run(scene)[0], run(double)[0]
    assert torch.equal(picture, double_picture)
    assert double_picture.dtype == torch.float32
    picture.square().sum().backward()
    double_picture.square().sum().backward()
    for name in ("viewmats", "Ks"):
        assert double[name].grad.dtype == torch.float64
        assert torch.equal(scene[name].grad, double[name].grad.float())
