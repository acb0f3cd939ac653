"""Inputs of the denoiser: buffers, photos warped to a render, network channels."""

from dataclasses import replace

import numpy as np
import pytest
import scenes
from capture_files import assert_refused

import igsr
from igsr.capture import Camera, View
from igsr.denoiser import Buffers, Source, photo_sources, photo_support, render_buffers, warping
from igsr.denoiser.inputs import BUFFERS, CHANNELS, COLOR, PHOTOS, network_inputs
from igsr.denoiser.warping import MAX_SOURCES, Warped, warp_photos
from igsr.evaluation.scores import BLACK


def camera(x=0.0, size=32, focal=40.0):
    """Looks along +z from (x, 0, -4)."""
    viewmat = np.eye(4)
    viewmat[:3, 3] = [-x, 0.0, 4.0]
    K = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1.0]])
    return Camera(viewmat, K, size, size)


def splats(means, scales, opacity=0.95):
    return scenes.round_splats(means, scales, np.log(opacity / (1 - opacity)), color=0.64)


def test_buffers_of_a_flat_splat():
    flat = splats([[0.0, 0.0, 0.0]], [2.0, 2.0, 0.01])
    empty = np.zeros((32, 32, 3), np.uint8)
    photos = [View(f"{x}.png", camera(x), "train", empty) for x in (0.0, 0.5, 50.0)]
    seen = photo_support(flat, photos, "cpu")
    assert seen.tolist() == [2.0], "the third photo looks past it"
    masked = replace(photos[0], mask=np.zeros((32, 32), np.bool_))
    assert photo_support(flat, [masked, *photos[1:]], "cpu").tolist() == [1.0]
    buffers = render_buffers(flat, camera(), seen, (1.0, 1.0, 1.0), "cpu")
    drawn = igsr.render(flat, camera(), (1.0, 1.0, 1.0), "cpu")
    assert np.array_equal(buffers.color, drawn.color)
    assert np.array_equal(buffers.alpha, drawn.alpha)
    middle = (16, 16)
    assert buffers.depth[middle] == pytest.approx(4.0, rel=1e-5)
    assert buffers.depth_deviation[middle] == pytest.approx(0.0, abs=1e-3)
    assert np.allclose(buffers.normal[middle], [0.0, 0.0, -1.0], atol=1e-5)
    size = np.exp(np.log([2.0, 2.0, 0.01]).mean()) * 40.0 / 4.0
    assert buffers.footprint[middle] == pytest.approx(np.log2(size), rel=1e-4)
    assert buffers.support[middle] == pytest.approx(2.0, rel=1e-4)
    arrays = [array for name, array in vars(buffers).items() if name != "camera"]
    assert all(np.isfinite(array).all() for array in arrays)


def test_depth_deviation_of_two_blended_surfaces():
    two = splats([[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]], [3.0, 3.0, 0.01], opacity=0.5)
    buffers = render_buffers(two, camera(), np.ones(2, np.float32), backend="cpu")
    a, b = 0.5, 0.25
    mean = (a * 4.0 + b * 6.0) / (a + b)
    deviation = np.sqrt((a * (4.0 - mean) ** 2 + b * (6.0 - mean) ** 2) / (a + b))
    assert buffers.depth[16, 16] == pytest.approx(mean, rel=1e-3)
    assert buffers.depth_deviation[16, 16] == pytest.approx(deviation / mean, rel=2e-3)


def test_empty_pixels_are_zero():
    behind = splats([[0.0, 0.0, -9.0], [0.0, 0.0, -4.0]], 0.1)
    buffers = render_buffers(behind, camera(), np.ones(2, np.float32), backend="cpu")
    for name in ("color", "alpha", "depth", "depth_deviation", "normal", "footprint", "support"):
        assert not getattr(buffers, name).any(), name
    assert np.isfinite(network_inputs(buffers, warped_of(buffers, []))).all()


def test_buffers_of_other_shapes_and_types_are_refused():
    color = np.zeros((4, 5, 3), np.float32)
    assert_refused("color must be of floats", Buffers, color=color.astype(np.uint8))
    assert_refused(r"^color must be \[H, W, 3\], not \[4, 5\]$", Buffers, color=color[..., 0])
    with pytest.raises(igsr.IgsrError, match=r"^alpha must be \[4, 5\] as color, not \[5, 4\]$"):
        Buffers(color=color, alpha=np.zeros((5, 4), np.float32))
    with pytest.raises(igsr.IgsrError, match="camera is of a 32x32 picture, color is 5x4"):
        Buffers(color=color, camera=camera())


def plane_photo(at, z=0.0):
    """A camera's picture of the plane z, painted by a smooth function of x and y."""
    columns, rows = np.meshgrid(np.arange(at.width) + 0.5, np.arange(at.height) + 0.5)
    depth = z + 4.0
    x = (columns - at.K[0, 2]) / at.K[0, 0] * depth + at.center[0]
    y = (rows - at.K[1, 2]) / at.K[1, 1] * depth
    color = np.stack([np.sin(2 * x), np.cos(3 * y), np.sin(x + y)], -1) * 0.4 + 0.5
    return color.astype(np.float32), np.full((at.height, at.width), depth, np.float32)


def source(x, z=0.0):
    color, depth = plane_photo(camera(x), z)
    return Source(camera(x), color, np.ones(depth.shape, np.bool_), depth)


def plane_buffers():
    color, depth = plane_photo(camera())
    return Buffers(color, np.ones_like(depth), depth, camera=camera())


def warped_of(buffers, sources, keep=PHOTOS):
    return warp_photos(buffers.camera, buffers.depth, buffers.alpha, sources, keep)


def test_photos_are_warped_in_the_order_of_angles():
    buffers = plane_buffers()
    warped = warped_of(buffers, [source(0.8), source(-0.3), source(0.5)])
    # The camera at -0.3 is nearest and sees all but a strip at one side.
    inner = warped.valid[0] & warped.valid[1]
    assert inner[:, 8:28].all()
    assert np.abs(warped.color[0] - buffers.color)[:, 8:28].max() < 0.01
    assert np.allclose(warped.angle[0][16, 16], np.arctan(0.3 / 4.0), atol=2e-2)
    assert (warped.angle[0] <= warped.angle[1]).all()
    assert not warped.valid[0][:, :1].any() or not warped.valid[1][:, :1].any()


def test_occluded_masked_and_missing_photos_are_not_valid():
    buffers = plane_buffers()
    hidden = source(0.1)
    hidden.depth[:, :16] = 2.0  # something stands before the left half
    warped = warped_of(buffers, [hidden])
    assert not warped.valid[0][:, :14].any()
    assert warped.valid[0][:, 18:30].all()
    assert not warped.valid[1].any(), "there is one photo only"
    assert not warped.color[1].any()
    masked = source(0.1)
    masked.usable[:] = False
    assert not warped_of(buffers, [masked]).valid.any()
    assert not warped_of(buffers, []).valid.any()
    transparent = replace(buffers, alpha=np.zeros_like(buffers.alpha))
    assert not warped_of(transparent, [source(0.1)]).valid.any(), "there is no surface"


def test_only_the_nearest_of_many_photos_are_warped():
    buffers = plane_buffers()
    near = [source(x) for x in np.linspace(-0.4, 0.4, MAX_SOURCES)]
    far = [source(x) for x in (-1.2, 1.2, 1.5)]
    few, many = warped_of(buffers, near, 3), warped_of(buffers, [far[0], *near, *far[1:]], 3)
    assert few.valid[0].any()
    for name in ("color", "valid", "angle"):
        assert np.array_equal(getattr(few, name), getattr(many, name))


def nothing_warped(height, width):
    empty = np.zeros((PHOTOS, height, width), np.float32)
    return Warped(np.zeros((*empty.shape, 3), np.float32), empty > 0, empty + np.float32(np.pi))


def test_missing_and_nonfinite_inputs_are_zero():
    color = np.full((6, 7, 3), np.nan, np.float32)
    color[0, 0] = [0.25, 7.0, -1.0]
    inputs = network_inputs(Buffers(color), nothing_warped(6, 7))
    assert inputs.shape == (CHANNELS, 6, 7)
    assert inputs[:COLOR, 0, 0].tolist() == [0.25, 1.0, 0.0]
    assert not inputs[:COLOR, 1:].any()
    assert not inputs[COLOR:].any()


def test_the_background_is_an_input():
    color = np.full((8, 8, 3), 0.9, np.float32)
    at = COLOR + BUFFERS + PHOTOS * 5
    behind = np.array([0.2, 0.4, 0.6], np.float32)
    inputs = network_inputs(Buffers(color, background=behind), nothing_warped(8, 8))
    assert np.allclose(inputs[at : at + 5, 0, 0], [0.2, 0.4, 0.6, 1.0, 0.0])
    assert np.ptp(inputs[at:], axis=(1, 2)).max() == 0.0, "the same everywhere"
    assert not network_inputs(Buffers(color), nothing_warped(8, 8))[at:].any()
    assert_refused(r"background must be \[3\], not \[2\]", Buffers, color, background=behind[:2])


def test_buffers_have_the_background():
    scene, view = scenes.splats(40), scenes.ring_camera(0.0, size=24)
    seen = np.ones(40, np.float32)
    white = render_buffers(scene, view, seen, (1.0, 1.0, 1.0), "cpu")
    none = render_buffers(scene, view, seen, backend="cpu")
    assert white.background.tolist() == [1.0, 1.0, 1.0]
    assert none.background is None
    gap = (1.0 - none.alpha)[..., None]
    assert np.allclose(white.color, none.color + gap, atol=1e-5), "none is drawn over black"


def test_depth_channels_do_not_depend_on_units():
    color, depth = plane_photo(camera())
    depth = depth + np.linspace(0, 1, 32, dtype=np.float32)[:, None]
    alpha = np.ones_like(depth)
    near = network_inputs(Buffers(color, alpha, depth), nothing_warped(32, 32))
    far = network_inputs(Buffers(color, alpha, 1000.0 * depth), nothing_warped(32, 32))
    assert np.allclose(near, far, atol=1e-5)
    assert near[COLOR + 1].std() > 0.01


def test_warping_in_bands_equals_the_whole(monkeypatch):
    scene = scenes.splats(60)
    photos = scenes.capture(views=6, size=40, scene=scene).views
    sources = photo_sources(scene, photos, BLACK, "cpu")
    view = scenes.ring_camera(0.1, 40)
    buffers = render_buffers(scene, view, photo_support(scene, photos, "cpu"), backend="cpu")
    whole = warp_photos(view, buffers.depth, buffers.alpha, sources, PHOTOS)
    monkeypatch.setattr(warping, "BAND_PIXELS", 7 * 40)
    bands = warp_photos(view, buffers.depth, buffers.alpha, sources, PHOTOS)
    assert whole.valid.any()
    for name in ("color", "valid", "angle"):
        assert np.array_equal(getattr(whole, name), getattr(bands, name))


def test_no_splats_give_an_empty_picture():
    none = splats(np.zeros((0, 3)), 0.1)
    photos = scenes.capture(views=2, size=32).views
    buffers = render_buffers(none, camera(), photo_support(none, photos, "cpu"), backend="cpu")
    assert not buffers.color.any()
    picture, confidence = igsr.denoise(buffers, photo_sources(none, photos, BLACK, "cpu"))
    assert np.isfinite(picture).all()
    assert np.isfinite(confidence).all()


def test_a_far_pixel_does_not_change_other_depths():
    depth = np.full((8, 8), 2.0, np.float32)
    depth[0, :2], depth[3, 3] = [1e5, 0.0], 4.0
    buffers = Buffers(color=np.zeros((8, 8, 3), np.float32), depth=depth)
    channel = network_inputs(buffers, nothing_warped(8, 8))[4]
    assert channel[[3, 3, 0], [3, 4, 1]] == pytest.approx([1.0, 0.0, 0.0])
