"""Representation, notebook pictures and equality of the API's objects."""

import base64
import dataclasses
import io
import json
import pickle
import re

import numpy as np
import pytest
import scenes
import torch
from PIL import Image

import igsr
from igsr.capture.types import Tracks
from igsr.evaluation.scores import ScoredView


def pictures(shown):
    """The pictures in some HTML."""
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', shown)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


@pytest.fixture
def capture():
    return scenes.capture(views=8)


def points():
    tracks = Tracks(["a", "b"], np.array([0, 1]), np.array([2, 2]), np.ones((2, 2)))
    return igsr.Points(np.eye(3), np.zeros((3, 3), np.uint8), np.ones(3), tracks)


def test_reprs_are_one_short_line(capture):
    splats = scenes.splats(origin=(1.0, 2.0, 3.5))
    view = capture.views[0]
    masked = dataclasses.replace(view, mask=np.ones(view.image.shape[:2], bool))
    assert repr(splats) == "Splats(40 splats, SH degree 1, origin 1, 2, 3.5)"
    assert repr(dataclasses.replace(splats, antialiased=True)).endswith("antialiased)")
    assert repr(view) == f"View({view.name!r}, test, 48x48)"
    assert repr(masked) == f"View({view.name!r}, test, 48x48, mask)"
    assert repr(view.camera).startswith("Camera(48x48, focal lengths ")
    assert repr(capture).endswith("8 views: 6 train, 2 test; no points)")
    assert repr(points()) == "Points(3 points, confidence, tracks)"
    assert repr(points().tracks) == "Tracks(2 observations in 2 photos)"
    assert repr(igsr.render(splats, view.camera, backend="cpu")) == "Render(48x48)"
    for one in (splats, view, view.camera, capture, points()):
        assert len(repr(one)) < 120
        assert "\n" not in repr(one)


def test_equality_compares_every_field(capture):
    splats = scenes.splats()
    for field in ("means", "quats", "scales", "opacities", "sh"):
        changed = getattr(splats, field).copy()
        changed.flat[3] += 1.0
        other = dataclasses.replace(splats, **{field: changed})
        assert (splats == other) is False
        assert (splats != other) is True
    assert (splats == scenes.splats()) is True
    assert splats != dataclasses.replace(splats, antialiased=True)
    assert splats != dataclasses.replace(splats, origin=np.ones(3))
    assert splats != scenes.splats(count=41)
    assert (splats == "splats") is False
    splats.means[3] = np.nan
    assert splats == dataclasses.replace(splats, means=splats.means.copy()), "NaN equals itself"

    same = pickle.loads(pickle.dumps(capture))
    assert (capture == same) is True
    assert capture.views == same.views
    assert capture.views[3] in same.views
    same.views[3].image[5, 5, 1] ^= 1
    assert capture.views[3] != same.views[3]
    assert capture != same
    assert capture != dataclasses.replace(capture, points=points())
    assert points() == points()
    moved = points()
    moved.tracks.xy[1, 1] = 9.0
    assert points() != moved


def test_equal_cameras_have_equal_hashes(capture):
    camera = capture.views[0].camera
    copy = igsr.Camera(camera.viewmat.copy(), camera.K.copy(), camera.width, camera.height)
    assert copy == camera
    assert len({copy, camera, capture.views[1].camera}) == 2
    with pytest.raises(TypeError, match="unhashable"):
        hash(scenes.splats())


def test_renders_and_scored_views_compare(capture):
    splats, camera = scenes.splats(), capture.views[0].camera
    one, other = (igsr.render(splats, camera, backend="cpu") for _ in range(2))
    assert one == other
    assert one != igsr.render(splats, camera, (1.0, 0.0, 0.0), backend="cpu")
    photo = np.zeros((4, 4, 3), np.uint8)
    scored = ScoredView("a", photo, photo, None, {"psnr": 20.0})
    assert scored == dataclasses.replace(scored, photo=photo.copy())
    assert scored != dataclasses.replace(scored, mask=np.ones((4, 4), bool))


def test_notebooks_show_splats_from_around():
    splats = scenes.splats(origin=(100.0, 0.0, 0.0))
    splats.scales -= 1.5  # a ball of small splats has an edge
    shown = splats._repr_html_()
    assert repr(splats) in shown
    for picture in pictures(shown):
        assert picture.shape == (240, 240, 3)
        assert (picture > 60).any(axis=2).mean() > 0.05, "the scene is in the picture"
        assert picture[0].any(axis=1).mean() < 0.5, "and does not fill it"
    nothing = dataclasses.replace(splats, means=np.full_like(splats.means, np.nan))
    assert repr(nothing) in nothing._repr_html_()
    assert pictures(nothing._repr_html_()) == []


def test_notebooks_show_photos(capture):
    view = capture.views[2]
    (picture,) = pictures(view._repr_html_())
    assert np.array_equal(picture, view.image)
    strip = pictures(capture._repr_html_())
    assert len(strip) == 5
    assert np.array_equal(strip[0], capture.views[0].image)
    assert pictures(igsr.Capture(capture.path, [])._repr_html_()) == []
    large = np.zeros((600, 1200, 4), np.uint8)
    camera = igsr.Camera(np.eye(4), view.camera.K, 1200, 600)
    (reduced,) = pictures(igsr.View("<b>", camera, "train", large)._repr_html_())
    assert reduced.shape == (120, 240, 4)
    assert "&lt;b&gt;" in igsr.View("<b>", camera, "train", large)._repr_html_()
    render = igsr.render(scenes.splats(), view.camera, backend="cpu")
    assert np.array_equal(pictures(render._repr_html_())[0], render.to_uint8())


def test_scores_are_a_dictionary_with_typed_attributes(capture):
    scores = igsr.evaluate(scenes.splats(seed=1), capture, backend="cpu")
    assert isinstance(scores, igsr.Scores)
    for name in ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr", "cc_ssim", "protocol", "views"):
        assert getattr(scores, name) == scores[name]
    assert json.loads(json.dumps(scores)) == {**scores}
    assert pickle.loads(pickle.dumps(scores)) == scores
    assert repr(scores).startswith(f"Scores(PSNR {scores.psnr:.2f} dB, SSIM ")
    corrected = f"color-corrected PSNR {scores.cc_psnr:.2f} dB"
    assert repr(scores).endswith(f"MS-SSIM -, FLIP {scores.flip:.4f}, {corrected}; 2 test views)")
    assert [row["name"] for row in scores.views] == [view.name for view in capture.test_views]


def rasterized(tensors, camera, viewmat):
    return igsr.rasterization(
        **tensors,
        viewmats=torch.tensor(viewmat)[None],
        Ks=torch.tensor(camera.K)[None],
        width=camera.width,
        height=camera.height,
        backend="cpu",
    )


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (3.0, -2.0, 1.5)])
def test_rasterization_of_to_torch_equals_render(antialiased, origin):
    splats = dataclasses.replace(scenes.splats(degree=2, origin=origin), antialiased=antialiased)
    camera = scenes.ring_camera(0.7, center=origin)
    expected = igsr.render(splats, camera, backend="cpu")
    color, alpha, _ = rasterized(splats.to_torch(), camera, camera.viewmat)
    assert expected.alpha.max() > 0.5
    np.testing.assert_allclose(color[0], expected.color, atol=2e-5)
    np.testing.assert_allclose(alpha[0, ..., 0], expected.alpha, atol=2e-5)


def test_to_torch_keeps_far_scenes_precise():
    far = (5e6, 4e5, 30.0)
    splats = scenes.splats(origin=far)
    camera = scenes.ring_camera(0.7, center=far)
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] += viewmat[:3, :3] @ splats.origin
    color, _, _ = rasterized(splats.to_torch(origin=splats.origin), camera, viewmat)
    expected = igsr.render(splats, camera, backend="cpu").color
    np.testing.assert_allclose(color[0], expected, atol=2e-5)
    for wrong in ((1.0, np.nan, 0.0), "here"):
        with pytest.raises(igsr.IgsrError, match="origin must be three finite numbers"):
            splats.to_torch(origin=wrong)


def test_to_torch_returns_independent_leaves():
    splats = scenes.splats()
    before = splats.means.copy()
    tensors = splats.to_torch(requires_grad=True)
    leaves = {name: value for name, value in tensors.items() if isinstance(value, torch.Tensor)}
    assert set(leaves) == {"means", "quats", "scales", "opacities", "colors"}
    camera = scenes.ring_camera(0.7)
    color, _, _ = rasterized(tensors, camera, camera.viewmat)
    assert (leaves["scales"] > 0).all()
    assert ((leaves["opacities"] > 0) & (leaves["opacities"] < 1)).all()
    color.sum().backward()
    for name, leaf in leaves.items():
        assert leaf.is_leaf, name
        assert leaf.dtype == torch.float32, name
        assert leaf.grad.abs().sum() > 0, name
    with torch.no_grad():
        for leaf in leaves.values():
            leaf.zero_()
    assert np.array_equal(splats.means, before)
    assert not any(getattr(value, "requires_grad", False) for value in splats.to_torch().values())
