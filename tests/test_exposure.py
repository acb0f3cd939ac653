"""Exposures of photos: how they are found, fitted, written and removed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import refinements
import scenes
import torch
from capture_files import assert_refused
from made_up_tracks import tracked
from PIL import Image

import igsr
from igsr.capture import Capture, Exposure, View
from igsr.capture.exif import read_exif
from igsr.capture.write_transforms import write_cameras
from igsr.evaluation.scores import render_of
from igsr.fitting import fit_capture
from igsr.fitting.exposures import (
    LOG_GAIN_PER_STOP,
    MIN_SPREAD,
    gains_from_exif,
    gains_from_points,
    starting_exposures,
)
from igsr.fitting.fitter import fitter_of, splat_arrays, without_exposures
from igsr.refinement.cut_highlights import with_cut_highlights


def with_exposure(view, exposure):
    """The photo with an exposure applied to its colors."""
    colors = exposure.apply_to(view.image[..., :3].astype(np.float32) / 255.0)
    pixels = np.floor(np.clip(colors, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return replace(view, image=np.concatenate([pixels, view.image[..., 3:]], axis=2))


def random_exposures(count, max_log_gain=0.3, max_offset=0.03, seed=0):
    """Exposures with a mean log gain and a mean offset of zero."""
    random = np.random.default_rng(seed)
    logs, offsets = random.uniform(-1.0, 1.0, (2, count, 3))
    logs, offsets = max_log_gain * (logs - logs.mean(0)), max_offset * (offsets - offsets.mean(0))
    return [Exposure(tuple(np.exp(a)), tuple(b)) for a, b in zip(logs, offsets, strict=True)]


def wall(count=6, points=240, noise=2.0, seed=1):
    """Photos of one texture from one place, and points with tracks."""
    random = np.random.default_rng(seed)
    texture = np.kron(random.uniform(60, 190, (12, 12, 3)), np.ones((8, 8, 1)))
    camera = scenes.ring_camera(0.0, 96)
    views = []
    for k in range(count):
        pixels = np.clip(texture + noise * random.normal(size=texture.shape), 0, 255)
        views.append(View(f"{k}.png", camera, "train", pixels.astype(np.uint8)))
    xyz = random.uniform(-0.8, 0.8, (points, 3)) * [1.0, 1.0, 0.1]
    return views, tracked(views, xyz)


def exposed(views, exposures):
    return [with_exposure(view, one) for view, one in zip(views, exposures, strict=True)]


@pytest.mark.parametrize("seed", range(3))
def test_points_determine_gains_and_offsets(seed):
    views, points = wall(seed=seed)
    exposures = random_exposures(len(views), seed=seed)
    start = starting_exposures(exposed(views, exposures), points, "auto")
    assert (start.pulls > 1.0).all()
    for found, true in zip(start.exposures, exposures, strict=True):
        np.testing.assert_allclose(found.gain, true.gain, rtol=0.03)
        np.testing.assert_allclose(found.offset, true.offset, atol=0.015)


def test_equal_exposures_are_not_optimized():
    views, points = wall(noise=12.0)
    assert gains_from_points(views, points).spread < MIN_SPREAD
    assert starting_exposures(views, points, "auto") is None
    assert starting_exposures(views, points, "off") is None
    assert starting_exposures(views, points, "on") is not None


def test_gains_within_their_errors_are_not_optimized():
    # Each photo is brighter on its left or right side, which no gain explains.
    views, points = wall(count=4)
    ramp = np.linspace(-0.5, 0.5, 96)[None, :, None]
    uneven = [
        replace(view, image=(view.image * np.exp(sign * ramp)).clip(0, 255).astype(np.uint8))
        for view, sign in zip(views, (1.0, -1.0, 1.0, -1.0), strict=True)
    ]
    assert np.sqrt(np.mean(gains_from_points(uneven, points).error ** 2)) > 0.02
    assert starting_exposures(uneven, points, "auto") is None


def test_gains_that_drift_slowly_are_not_optimized():
    """As in a video whose camera adapts: each photo shares points with the next ones only."""
    views, points = wall(count=16, points=1600)
    tracks = points.tracks
    # Photo k sees the points from 100 k to 100 k + 300.
    first = 100 * tracks.view
    kept = (tracks.point >= first) & (tracks.point < first + 300)
    tracks = replace(tracks, view=tracks.view[kept], point=tracks.point[kept], xy=tracks.xy[kept])
    points = replace(points, tracks=tracks)
    angles = 2 * np.pi * np.arange(16) / 16

    def photos(log_gains):
        return exposed(views, [Exposure((gain,) * 3) for gain in np.exp(log_gains)])

    drift, jumps = 0.3 * np.sin(angles), 0.2 * (-1.0) ** np.arange(16)
    drifting, jumping = (gains_from_points(photos(gains), points) for gains in (drift, jumps))
    assert np.abs(drifting.log_gain[:, 0]).max() > 0.2
    assert drifting.log_gain.std() > 0.9 * jumping.log_gain.std()
    assert jumping.spread > 2.0 * drifting.spread
    assert starting_exposures(photos(drift / 1.5), points, "auto") is None
    assert starting_exposures(photos(jumps), points, "auto") is not None


def test_few_points_determine_no_gains():
    views, points = wall(points=12)
    photos = exposed(views, random_exposures(len(views)))
    assert gains_from_points(photos, points) is None
    assert starting_exposures(photos, points, "auto") is None
    assert starting_exposures(photos, None, "auto") is None


def test_exif_determines_gains_without_points():
    views, _ = wall(count=3)

    def photos(*values):
        pairs = zip(views, values, strict=True)
        return [replace(view, exposure_value=value) for view, value in pairs]

    start = starting_exposures(photos(3.0, 4.0, 5.0), None, "auto")
    gain = np.exp(LOG_GAIN_PER_STOP)
    np.testing.assert_allclose([one.gain[0] for one in start.exposures], [1 / gain, 1.0, gain])
    assert (start.pulls < 1.0).all(), "tone curves differ between cameras"
    assert starting_exposures(photos(4.0, 4.0, 4.0), None, "auto") is None
    assert gains_from_exif(photos(3.0, 4.0, None)) is None


def test_impossible_exif_is_ignored(tmp_path):
    def value(**fields):
        tags = {"time": 0x829A, "f": 0x829D, "iso": 0x8827}
        image, exif = Image.new("RGB", (8, 8)), Image.Exif()
        exif.get_ifd(0x8769).update({tags[name]: field for name, field in fields.items()})
        image.save(tmp_path / "photo.jpg", exif=exif)
        with Image.open(tmp_path / "photo.jpg") as opened:
            return read_exif(opened).exposure_value

    assert value(time=1 / 64, f=4.0, iso=400) == pytest.approx(-6 - 4 + 2, abs=1e-3)
    for wrong in ({"time": 0.0}, {"f": 0.0}, {"iso": 0}):
        assert value(**{"time": 1 / 64, "f": 4.0, "iso": 400, **wrong}) is None
    assert value(time=1 / 64, f=4.0) is value() is None


def test_taking_an_exposure_out_undoes_it():
    view = wall(count=1)[0][0]
    exposure = Exposure((1.2, 0.9, 1.0), (0.01, 0.03, -0.02))
    back = exposure.remove_from(with_exposure(view, exposure).image)
    assert np.abs(back.astype(int) - view.image).max() <= 1
    alpha = np.full((*view.image.shape[:2], 1), 77, np.uint8)
    with_alpha = exposure.remove_from(np.concatenate([view.image, alpha], axis=2))
    assert (with_alpha[..., 3] == 77).all()
    for bad in ({"gain": (1.0, 0.0, 1.0)}, {"gain": (1.0, 2.0)}, {"offset": (0.0, np.nan, 0.0)}):
        assert_refused(next(iter(bad)), Exposure, **bad)


@pytest.fixture(scope="module")
def capture():
    """Photos without alpha, every fourth held out."""
    return scenes.capture(views=12, size=40)


def with_exposures(capture, exposures):
    """The capture with exposures applied to its train photos."""
    train = exposed(capture.train_views, exposures)
    return Capture(capture.path, [*train, *capture.test_views], capture.points)


def fit(capture, **options):
    given = {"steps": 900, "backend": "cpu", "max_splats": 400, "sh_degree": 1, **options}
    return fit_capture(capture, **given)


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize("seed", range(3))
def test_a_fit_finds_exposures_and_the_colors_of_the_mean_photo(alpha, seed):
    # All photos see the same side, so that they share many points.
    capture = scenes.capture(views=16, size=40, alpha=alpha, arc=1.0)
    exposures = random_exposures(len(capture.train_views), 0.25, 0.0, seed)
    photos = with_exposures(capture, exposures)
    off, on = (fit(photos, steps=1500, exposure=mode, seed=seed) for mode in ("off", "on"))
    log_gains = np.log([view.exposure.gain for view in on.capture.train_views])
    errors = log_gains - np.log([one.gain for one in exposures])
    assert np.sqrt(np.mean(errors**2)) < 0.05
    assert np.abs(log_gains.mean(axis=0)).max() < 1e-9
    before, after = (igsr.evaluate(one.splats, capture, backend="cpu") for one in (off, on))
    assert after.psnr > before.psnr + 0.5
    assert after.cc_psnr > before.cc_psnr
    # Fitted photos are scored with their exposures, held-out ones without.
    assert all(view.exposure is None for view in on.capture.test_views)
    bare = Capture(capture.path, [replace(view, exposure=None) for view in on.capture.views])
    scores = (igsr.evaluate(on.splats, c, "train", backend="cpu") for c in (on.capture, bare))
    with_them, without = (score.psnr for score in scores)
    assert with_them > without + 2.0


def test_equal_exposures_change_no_bits(capture):
    off, auto, on = (fit(capture, steps=60, exposure=mode) for mode in ("off", "auto", "on"))
    assert auto.splats == off.splats
    assert auto.capture == capture
    assert on.splats != off.splats
    assert on.exposures.keys() == {view.name for view in capture.train_views}


def test_pseudo_views_have_no_exposure(capture):
    pseudo = scenes.pseudo_view(capture.train_views[0], name="made-up")
    result = fit(Capture(capture.path, [*capture.views, pseudo]), steps=60, exposure="on")
    views = result.capture.train_views
    exposures = [view.exposure for view in views]
    assert exposures[-1] is None
    assert None not in exposures[:-1]
    # Fits continue from the exposures of their views.
    assert starting_exposures(views, None, "auto").exposures == exposures
    assert all(view.exposure is None for view in without_exposures(views, exposures))


def test_fit_writes_exposures(capture, tmp_path):
    photos = with_exposures(capture, random_exposures(len(capture.train_views)))
    options = {"steps": 60, "exposure": "on", "backend": "cpu", "max_splats": 300}
    result = igsr.fit(photos, out=tmp_path, **options)
    frames = json.loads((tmp_path / "cameras.json").read_text())["frames"]
    exposures = {name: exposure.plain() for name, exposure in result.exposures.items()}
    assert {frame["file_path"]: frame["exposure"] for frame in frames} == exposures
    assert result.report["exposures"] == exposures
    assert result.report["exposure"] == "on"
    write_cameras(tmp_path / "without.json", capture.train_views)
    assert "exposure" not in (tmp_path / "without.json").read_text()


def test_apply_exposure_matches_the_renderer():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 5, 4, 3, generator=generator, dtype=torch.float64)
    gain = 0.3 + 0.4 * torch.rand(2, 3, generator=generator, dtype=torch.float64)
    offset = 0.1 + 0.1 * torch.rand(2, 3, generator=generator, dtype=torch.float64)
    for tensor in (image, gain, offset):
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(igsr.apply_exposure, (image, gain, offset))
    one = Exposure(tuple(gain[0].tolist()), tuple(offset[0].tolist()))
    expected = one.apply_to(image[0].detach().numpy().astype(np.float32))
    got = igsr.apply_exposure(image, gain, offset)[0].detach().numpy()
    np.testing.assert_allclose(got, expected, atol=1e-6)

    # Above 1, colors are clipped and have gradients toward 1 only.
    white = torch.full((1, 2, 3), 0.9, requires_grad=True)
    clipped = igsr.apply_exposure(white, torch.full((3,), 2.0), torch.zeros(3))
    assert (clipped == 1.0).all()
    (clipped * torch.tensor([[[1.0], [-1.0]]])).sum().backward()
    assert white.grad[0, :, 0].tolist() == [2.0, 0.0]
    assert_refused("gain must have shape", igsr.apply_exposure, image, gain[:1], offset)
    assert_refused("image must have shape", igsr.apply_exposure, image[..., :2], gain, offset)


def test_a_view_with_an_exposure_is_rendered_with_it(capture):
    splats, view = scenes.splats(), capture.views[0]
    exposure = Exposure((1.3, 1.0, 0.8), (0.05, 0.0, 0.0))
    views = (replace(view, exposure=one) for one in (None, exposure))
    plain, seen = (render_of(splats, one, (0, 0, 0)) for one in views)
    expected = with_exposure(replace(view, image=plain), exposure).image
    assert np.abs(seen.astype(int) - expected).max() <= 2


def test_starting_exposures_of_another_count_are_refused(capture):
    views = capture.train_views
    start = starting_exposures(views, None, "on")
    settings = {"exposures": True, "sh_degree": 1, "steps": 1}
    state = splat_arrays(scenes.splats())
    with pytest.raises(ValueError, match="gains"):
        fitter_of(views[:1], state.pop("origin"), state, settings, "cpu", exposures=start)


def test_a_refinement_uses_photos_without_their_exposures(ball_photos, rendered):
    """Denoising and warping see the colors of the mean photo."""
    exposures = random_exposures(len(ball_photos.train_views), 0.2, 0.0)
    photos = with_exposures(ball_photos, exposures)
    train = [replace(v, exposure=e) for v, e in zip(photos.train_views, exposures, strict=True)]
    photos = Capture(photos.path, [*train, *photos.test_views])
    both = ball_photos, photos
    refined = refinements.refine(photos, 1, refinements.contented, exposure="auto")
    assert len(rendered) == 1
    true, given = ({v.name: v.image[..., :3].astype(int) for v in c.views} for c in both)
    for view in (view for model in rendered for view in model.photos):
        colors = given[view.name]
        unclipped = (colors > 0) & (colors < 255)
        errors = (np.abs(one - true[view.name]) for one in (view.image[..., :3], colors))
        after, before = (error[unclipped].mean() for error in errors)
        assert after < 0.5 * before
        assert view.exposure is None
    assert all(view.exposure is not None for view in refined.capture.train_views)
    assert all(view.exposure is None for view in refined.capture.test_views)


@pytest.mark.parametrize("gain", [4.0, 0.7])
def test_clipped_highlights_are_as_bright_as_the_fit_shows(gain):
    """Without its exposure, white would be gray."""
    exposure, model = Exposure((gain,) * 3), scenes.splats(60, degree=0)
    views, true = [], []
    for view in scenes.capture(views=3, scene=model).views:
        color = igsr.render(model, view.camera, backend="cpu").color
        pixels = np.clip(255.0 * np.stack([color, exposure.apply_to(color)]) + 0.5, 0.0, 255.0)
        image, exposed = pixels.astype(np.uint8)
        views.append(replace(view, image=exposed, exposure=exposure))
        true.append(image.astype(int))
    plain = without_exposures(views, [exposure] * 3)
    lifted = with_cut_highlights(plain, views, model, (0.0, 0.0, 0.0), "cpu")

    def error(photos):
        return max(np.abs(p.image - image).max() for p, image in zip(photos, true, strict=True))

    assert (error(plain) > 20) == (gain > 1.0)
    assert error(lifted) <= 2
    assert all(view.exposure is None for view in lifted)
    # A fit that is darker does not make photos darker.
    dark = replace(model, opacities=model.opacities - 20.0)
    assert with_cut_highlights(plain, views, dark, (0.0, 0.0, 0.0), "cpu") == plain
