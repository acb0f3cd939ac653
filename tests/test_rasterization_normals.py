"""``rasterization(render_normals=True)``: the axis, the frame and the weights."""

import math

import pytest
import torch
from gradients import check_gradients, weighted_sum
from scenes import HEIGHT, WIDTH, rasterized, torch_scene


def run(scene, **options):
    return rasterized(scene, **{"render_normals": True, **options})


def disc(shortest, quat=(1.0, 0.0, 0.0, 0.0)):
    """One big disc in front of the camera, thin along one axis."""
    scene = torch_scene(count=1, cameras=1)
    scene["means"] = torch.tensor([[0.0, 0.0, 4.0]])
    scene["scales"] = torch.full((1, 3), 0.8)
    scene["scales"][0, shortest] = 0.05
    scene["quats"] = torch.tensor([quat])
    scene["opacities"] = torch.tensor([0.9])
    return scene


HALF = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("shortest", "quat", "expected"),
    [
        (2, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        # A quarter turn about y takes x to -z and z to x; one about x takes y to z.
        (0, (HALF, 0.0, HALF, 0.0), (0.0, 0.0, -1.0)),
        (1, (HALF, HALF, 0.0, 0.0), (0.0, 0.0, -1.0)),
        (1, (-5.0, -5.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
        # An eighth of a turn about y: the normal z leans along +x or -x, and is turned to face.
        (2, (math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0), (-HALF, 0.0, -HALF)),
        (2, (math.cos(math.pi / 8), 0.0, -math.sin(math.pi / 8), 0.0), (HALF, 0.0, -HALF)),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_normals_are_shortest_axes_facing_the_camera(shortest, quat, expected, packed):
    _, alpha, meta = run(disc(shortest, quat), packed=packed)
    normals = meta["render_normals"]
    assert normals.shape == (1, HEIGHT, WIDTH, 3)
    assert alpha.max() > 0.5
    assert torch.allclose(normals, alpha * torch.tensor(expected), atol=2e-6)


def test_normals_are_in_the_world_frame():
    scene = disc(2)
    # A camera behind the disc, looking back at it: the world's normal turns round.
    behind = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    behind[2, 3] = 8.0
    scene["viewmats"] = torch.stack([scene["viewmats"][0], behind])
    scene["Ks"] = scene["Ks"].repeat(2, 1, 1)
    scene["backgrounds"] = scene["backgrounds"].repeat(2, 1)
    _, alpha, meta = run(scene)
    assert (alpha.amax(dim=(1, 2, 3)) > 0.5).all()
    assert torch.allclose(meta["render_normals"][0], alpha[0] * torch.tensor([0.0, 0, -1.0]))
    assert torch.allclose(meta["render_normals"][1], alpha[1] * torch.tensor([0.0, 0, 1.0]))


@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED", "D", "ED"])
@pytest.mark.parametrize("packed", [False, True])
def test_normals_have_the_weights_of_the_colors_and_change_no_picture(render_mode, packed):
    scene = torch_scene(count=30)
    picture, alpha, meta = run(scene, packed=packed, render_mode=render_mode)
    plain, plain_alpha, plain_meta = run(
        scene, packed=packed, render_mode=render_mode, render_normals=False
    )
    assert torch.equal(picture, plain)
    assert torch.equal(alpha, plain_alpha)
    assert "render_normals" not in plain_meta

    # The same normals as colors, computed independently.
    w, x, y, z = torch.nn.functional.normalize(scene["quats"].double(), dim=-1).unbind(dim=-1)
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(-1, 3, 3)
    rotations = torch.eye(3) + 2 * w[:, None, None] * cross + 2 * cross @ cross
    count = torch.arange(30)
    normals = rotations[count, :, scene["scales"].argmin(dim=-1)]
    centers = -scene["viewmats"][:, :3, 3]  # these cameras are not turned
    towards = centers[:, None].double() - scene["means"]
    facing = (towards * normals).sum(dim=-1, keepdim=True).sign() * normals
    plain_scene = {**scene, "colors": facing.float(), "backgrounds": None}
    expected, _, _ = rasterized(plain_scene, sh_degree=None)
    assert (meta["render_normals"] - expected).abs().max() <= 2e-6


def test_gradients_of_normals_match_finite_differences():
    scene = torch_scene(count=6, dtype=torch.float64)
    names = ["means", "quats", "scales", "opacities"]

    def render(*tensors):
        arguments = {**scene, **dict(zip(names, tensors, strict=True))}
        picture, _, meta = run(arguments, backend="reference", render_mode="RGB+D")
        return weighted_sum(meta["render_normals"]) + picture.square().sum()

    inputs = [scene[name] for name in names]
    check_gradients(render, inputs)
    _, _, meta = run(scene, backend="reference")
    (from_normals,) = torch.autograd.grad(meta["render_normals"][..., 0].sum(), inputs[1])
    assert from_normals.abs().max() > 1e-3
