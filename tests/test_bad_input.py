"""Bad arguments of ``rasterization``, ``render`` and fits are named by the error message."""

from __future__ import annotations

import inspect

import gsplat
import numpy as np
import pytest
import scenes
import torch
from capture_files import assert_refused

import igsr
from igsr import _core, rasterization


def call(changes):
    scene = scenes.torch_scene(count=5)
    arguments = {**scene, "width": 24, "height": 20, "sh_degree": 2, "backend": "cpu", **changes}
    return rasterization(**arguments)


def broken(name, change):
    return {name: change(scenes.torch_scene(count=5)[name].clone())}


def with_entry(index, value):
    def change(tensor):
        tensor[index] = value
        return tensor

    return change


def features(*shape):
    return {"colors": torch.zeros(*shape), "sh_degree": None}


BAD = {
    "means dtype": broken("means", lambda t: t.double()),
    "means half": broken("means", lambda t: t.half()),
    "means shape": broken("means", lambda t: t[:, :2]),
    "means batch": broken("means", lambda t: t[None]),
    "means numpy": broken("means", lambda t: t.numpy()),
    "means None": {"means": None},
    "quats count": broken("quats", lambda t: t[:-1]),
    "quats width": broken("quats", lambda t: t[:, :3]),
    "scales dtype": broken("scales", lambda t: t.int()),
    "scales shape": broken("scales", lambda t: t[:, 0]),
    "opacities shape": broken("opacities", lambda t: t[:, None]),
    "opacities device": broken("opacities", lambda t: t.to("meta")),
    "colors sh": broken("colors", lambda t: t[:, :4]),
    "colors rank": broken("colors", lambda t: t[:, 0]),
    "colors channels": broken("colors", lambda t: t[..., :1]),
    "colors cameras": broken("colors", lambda t: t.repeat(3, 1, 1, 1)),
    "viewmats shape": broken("viewmats", lambda t: t[0]),
    "viewmats none": broken("viewmats", lambda t: t[:0]),
    "viewmats dtype": broken("viewmats", lambda t: t.int()),
    "viewmats nan": broken("viewmats", with_entry((0, 1, 3), float("nan"))),
    "viewmats scale": broken("viewmats", lambda t: t * 2),
    "viewmats mirror": broken("viewmats", with_entry((0, 0, 0), -1.0)),
    "viewmats row": broken("viewmats", with_entry((1, 3, 0), 1.0)),
    "Ks count": broken("Ks", lambda t: t[:1]),
    "Ks singular": broken("Ks", with_entry((0, 0, 0), 0.0)),
    "Ks infinite": broken("Ks", with_entry((0, 0, 2), float("inf"))),
    "Ks skew": broken("Ks", with_entry((1, 0, 1), 0.5)),
    "backgrounds shape": broken("backgrounds", lambda t: t[0]),
    "backgrounds nan": broken("backgrounds", lambda t: t * float("nan")),
    "width negative": {"width": -24},
    "width zero": {"width": 0},
    "height float": {"height": 20.0},
    "width huge": {"width": 1_000_000},
    "near_plane negative": {"near_plane": -1.0},
    "far_plane near": {"far_plane": 0.001},
    "radius_clip nan": {"radius_clip": float("nan")},
    "eps2d text": {"eps2d": "0.3"},
    "near_plane bool": {"near_plane": True},
    "sh_degree high": {"sh_degree": 5},
    "sh_degree float": {"sh_degree": 2.0},
    "sh_degree bool": {"sh_degree": True},
    "colors many": broken("colors", lambda t: t.repeat(1, 4, 1)),
    "render_mode unknown": {"render_mode": "normals"},
    "packed text": {"packed": "yes"},
    "rasterize_mode unknown": {"rasterize_mode": "smooth"},
    "rasterize_mode list": {"rasterize_mode": ["classic"]},
    "absgrad number": {"absgrad": 1},
    "absgrad features": {"absgrad": True, "backgrounds": None, **features(5, 4)},
    "absgrad normals": {"absgrad": True, "render_normals": True},
    "render_normals text": {"render_normals": "yes"},
    "masks dtype": {"masks": torch.ones(2, 20, 24)},
    "masks shape": {"masks": torch.ones(2, 24, 20, dtype=torch.bool)},
    "masks tiles": {"masks": torch.ones(2, 2, 2, dtype=torch.bool)},
    "masks numpy": {"masks": np.ones((2, 20, 24), dtype=bool)},
    "masks device": {"masks": torch.ones(2, 20, 24, dtype=torch.bool, device="meta")},
    "backgrounds channels": broken("backgrounds", lambda t: t[:, :2]),
    "backgrounds pixels": {"backgrounds": torch.zeros(2, 24, 20, 3)},
    "backgrounds pixel nan": {"backgrounds": torch.full((2, 20, 24, 3), float("nan"))},
    "backgrounds dtype": {"backgrounds": torch.zeros(2, 20, 24, 3, dtype=torch.float64)},
    "colors no channels": features(5, 0),
    "colors per camera": features(3, 5, 8),
    "backgrounds features": {"backgrounds": torch.zeros(2, 3), **features(5, 8)},
    "backend unknown": {"backend": "abacus"},
    "backend None": {"backend": None},
    "backend list": {"backend": ["cpu"]},
}

#: gsplat's arguments that igsr does not implement, with another value than the default.
UNSUPPORTED = {
    "sparse_grad": True,
    "distributed": True,
    "camera_model": "fisheye",
    "segmented": True,
    "covars": torch.eye(3).repeat(5, 1, 1),
    "with_ut": True,
    "with_eval3d": True,
    "radial_coeffs": torch.zeros(2, 6),
    "tangential_coeffs": torch.zeros(2, 2),
    "thin_prism_coeffs": torch.zeros(2, 4),
    "ftheta_coeffs": object(),
    "rolling_shutter": 1,
    "viewmats_rs": torch.eye(4).repeat(2, 1, 1),
    "render_mode": "RGB-d",
}
#: Those of gsplat's development branch, with their defaults.
NEWER = {"macro_tile": False, "return_normals": False, "global_z_order": True}
NEWER |= dict.fromkeys(
    ["tile_size", "rays", "lidar_coeffs", "external_distortion_coeffs", "ut_params"]
    + ["extra_signals", "extra_signals_sh_degree", "renderer_config", "nht_params"]
)
UNSUPPORTED |= {
    name: torch.ones(2) if default is None else not default for name, default in NEWER.items()
}
BAD |= {f"{name} unsupported": {name: value} for name, value in UNSUPPORTED.items()}


def test_numpy_numbers_are_numbers():
    numbers = {"near_plane": np.float32(0.5), "eps2d": np.float64(0.25), "sh_degree": np.int64(2)}
    color, _, _ = call(numbers)
    assert color.shape == (2, 20, 24, 3)
    assert torch.equal(color, call({"near_plane": 0.5, "eps2d": 0.25})[0])


@pytest.mark.parametrize("case", BAD)
def test_messages_begin_with_the_name_of_a_bad_argument(case):
    with pytest.raises(ValueError, match=f"^{case.split()[0]}"):
        call(BAD[case])


def defaults(function):
    parameters = inspect.signature(function).parameters.values()
    return {p.name: p.default for p in parameters if p.default is not p.empty}


def test_defaults_of_gsplat_are_accepted():
    ours, theirs = map(defaults, (rasterization, gsplat.rasterization))
    for name in ours.keys() & theirs.keys():
        assert ours[name] == theirs[name], name
    color, _, _ = call({**theirs, "sh_degree": 2})
    assert torch.equal(color, call({"backgrounds": None})[0])
    # Those of its development branch too.
    color, _, meta = call(NEWER)
    assert torch.equal(color, call({})[0])
    assert meta["tile_size"] == 16


def test_only_the_first_arguments_are_positional():
    scene = scenes.torch_scene()
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    given = [scene[name] for name in names]
    color, _, _ = rasterization(*given, 24, 20, sh_degree=2, backend="cpu")
    assert torch.equal(color, call({**scene, "backgrounds": None})[0])
    with pytest.raises(TypeError, match="positional"):
        rasterization(*given, 24, 20, 0.01)
    with pytest.raises(TypeError, match="unexpected keyword argument 'near'"):
        call({"near": 0.01})


def test_messages_on_unsupported_arguments_name_an_alternative():
    with pytest.raises(ValueError, match=r"return_normals: .*render_normals=True"):
        call({"return_normals": True})
    for model, alternative in (
        ("ortho", "a pinhole far off: move it back"),
        ("fisheye", "as igsr.load_capture makes of fisheye lenses"),
        ("ftheta", "give pinhole views of the photos"),
        ("panorama", "gsplat's others are ortho, fisheye, ftheta"),
    ):
        with pytest.raises(ValueError, match=f"camera_model: only 'pinhole' .*{alternative}"):
            call({"camera_model": model})


def test_a_distant_pinhole_is_nearly_orthographic():
    """As the message on "ortho" advises: splats at different depths keep their distance."""
    scale, distance = 10.0, 200.0
    viewmat = torch.eye(4)
    viewmat[2, 3] = distance
    K = torch.tensor([[scale * distance, 0, 16], [0, scale * distance, 16], [0, 0, 1]])
    columns = []
    for mean in ([-0.5, 0.0, -0.5], [0.5, 0.0, 0.5]):
        splat = torch.tensor([mean]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.1)
        look = torch.tensor([0.9]), torch.ones(1, 3)
        _, alpha, _ = rasterization(*splat, *look, viewmat[None], K[None], 32, 32)
        weights = alpha[0, ..., 0].double().sum(0)
        columns.append(float((weights * (torch.arange(32) + 0.5)).sum() / weights.sum()))
    assert abs(columns[1] - columns[0] - scale) < 0.05


@pytest.mark.parametrize("slot", ["means", "quats", "scales", "opacities", "colors"])
@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf"), 1e38])
def test_a_splat_that_is_not_finite_changes_no_other(slot, value):
    scene = scenes.torch_scene(count=8)
    kept = [0, 1, 2, 4, 5, 6, 7]
    poisoned = {name: tensor.clone() for name, tensor in scene.items()}
    poisoned[slot].view(8, -1)[3, 0] = value
    for tensor in poisoned.values():
        tensor.requires_grad_()
    color, alpha, _ = call({**poisoned, "render_mode": "RGB+ED"})
    assert torch.isfinite(color).all()
    (color.sum() + alpha.sum()).backward()
    for name, tensor in poisoned.items():
        assert torch.isfinite(tensor.grad).all(), name
    # An infinitely dark splat is black; splats with other infinities are not drawn.
    if not np.isfinite(value) and (slot, value) != ("colors", -float("inf")):
        without = {
            name: tensor[kept] if len(tensor) == 8 else tensor for name, tensor in scene.items()
        }
        clean, _, _ = call({**without, "render_mode": "RGB+ED"})
        assert torch.equal(color, clean)


def test_render_names_bad_backgrounds_cameras_and_backends():
    camera = scenes.ring_camera(0.0)
    for background in ((0.0, 0.0), (0.0, float("nan"), 0.0), "white"):
        assert_refused("background", igsr.render, scenes.splats(), camera, background, "cpu")
    assert_refused("backend", igsr.render, scenes.splats(), camera, backend="abacus")
    wide = igsr.Camera(np.eye(4), camera.K, 20_000, 8)
    assert_refused("width", igsr.render, scenes.splats(), wide, backend="cpu")


def test_core_names_arrays_of_the_wrong_kind():
    splats, camera = scenes.splats(), scenes.ring_camera(0.0)
    good = scenes.project_call()
    assert len(_core.project(**good)["means2d"]) == len(splats)
    for name, wrong in (
        ("means", splats.means.astype(np.float64)),
        ("quats", splats.quats[:, ::-1]),
        ("scales", splats.scales[:-1]),
        ("opacities", [0.0] * len(splats)),
        ("colors", splats.sh[..., :2].copy()),
        ("viewmat", camera.viewmat[:3].copy()),
        ("intrinsics", np.zeros(3)),
        ("backend", "auto"),
    ):
        with pytest.raises(ValueError, match=name):
            _core.project(**{**good, name: wrong})


@pytest.mark.parametrize("command", ["fit", "refine"])
def test_an_out_that_is_a_file_is_refused_first(command, tmp_path, igsr_here):
    file = tmp_path / "scene.ply"
    file.write_text("mine")
    for out in (file, file / "below"):
        refused = igsr_here(command, tmp_path / "nowhere", "--out", out)
        assert refused.returncode == 1
        assert refused.stderr == f"out is {out}, and {file} is a file; name a folder.\n"
    assert file.read_text() == "mine"
