"""Exposures of photos: what tells of them, what a fit makes of them, and what is left without."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import refinements
import scenes
import torch
from made_up_tracks import tracked
from PIL import Image

import igsr
from igsr import _core
from igsr.capture import Capture, Exposure, View
from igsr.capture.exif import read_exif
from igsr.capture.write_transforms import write_cameras, write_transforms
from igsr.evaluation.scores import render_of
from igsr.fitting.exposures import (
    LEAST_SPREAD,
    LOG_GAIN_OF_STOP,
    gains_by_exif,
    gains_by_points,
    starting_exposures,
)
from igsr.fitting.fitter import without_exposures
from igsr.refinement.cut_highlights import with_cut_highlights

NONE = Exposure()


def taken(view: View, exposure: Exposure) -> View:
    """The photo as it would have been taken with an exposure."""
    colors = exposure.given_to(view.image[..., :3].astype(np.float32) / 255.0)
    pixels = np.floor(np.clip(colors, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    return replace(view, image=np.concatenate([pixels, view.image[..., 3:]], axis=2))


def made_up(count, largest=0.3, offset=0.03, seed=0):
    """Exposures with means of log gain and of offset of zero."""
    random = np.random.default_rng(seed)
    logs, offsets = random.uniform(-1.0, 1.0, (2, count, 3))
    logs, offsets = largest * (logs - logs.mean(0)), offset * (offsets - offsets.mean(0))
    return [Exposure(tuple(np.exp(a)), tuple(b)) for a, b in zip(logs, offsets, strict=True)]


def wall(count=6, points=240, noise=2.0, seed=1):
    """Photos from one place of one texture, with tracks of points all over it."""
    random = np.random.default_rng(seed)
    texture = np.kron(random.uniform(60, 190, (12, 12, 3)), np.ones((8, 8, 1)))
    camera = scenes.ring_camera(0.0, 96)
    views = []
    for k in range(count):
        pixels = np.clip(texture + noise * random.normal(size=texture.shape), 0, 255)
        views.append(View(f"{k}.png", camera, "train", pixels.astype(np.uint8)))
    xyz = random.uniform(-0.8, 0.8, (points, 3)) * [1.0, 1.0, 0.1]
    return views, tracked(views, xyz)


def test_points_tell_gains_and_offsets():
    views, points = wall()
    exposures = made_up(len(views))
    photos = [taken(view, one) for view, one in zip(views, exposures, strict=True)]
    found = starting_exposures(photos, points, "auto")
    assert (found.pulls > 1.0).all()
    for one, true in zip(found.exposures, exposures, strict=True):
        np.testing.assert_allclose(one.gain, true.gain, rtol=0.03)
        np.testing.assert_allclose(one.offset, true.offset, atol=0.015)


def test_photos_of_one_exposure_are_left_alone():
    views, points = wall(noise=12.0)
    gains = gains_by_points(views, points)
    assert gains.spread < LEAST_SPREAD
    assert starting_exposures(views, points, "auto") is None
    assert starting_exposures(views, points, "off") is None
    assert starting_exposures(views, points, "on") is not None


def test_gains_that_are_not_told_apart_from_their_errors_are_left_alone():
    # Each photo is brighter on one side and darker on the other: no gain explains that.
    views, points = wall(count=4)
    ramp = np.linspace(-0.5, 0.5, 96)[None, :, None]
    uneven = [
        replace(view, image=(view.image * np.exp(sign * ramp)).clip(0, 255).astype(np.uint8))
        for view, sign in zip(views, (1.0, -1.0, 1.0, -1.0), strict=True)
    ]
    gains = gains_by_points(uneven, points)
    assert np.sqrt(np.mean(gains.error**2)) > 0.02
    assert starting_exposures(uneven, points, "auto") is None


def test_gains_that_drift_slowly_from_photo_to_photo_are_left_alone():
    """As of a video whose camera adapts: each photo shares points with the next ones alone."""
    views, points = wall(count=16, points=1600)
    tracks = points.tracks
    # Photo k sees the points from 100 k to 100 k + 300.
    first = 100 * tracks.view
    kept = (tracks.point >= first) & (tracks.point < first + 300)
    tracks = replace(tracks, view=tracks.view[kept], point=tracks.point[kept], xy=tracks.xy[kept])
    points = replace(points, tracks=tracks)
    drift = [Exposure((np.exp(0.3 * np.sin(2 * np.pi * k / 16)),) * 3) for k in range(16)]
    jumps = [Exposure((np.exp(0.2 * (-1.0) ** k),) * 3) for k in range(16)]
    one, other = (
        gains_by_points([taken(v, e) for v, e in zip(views, each, strict=True)], points)
        for each in (drift, jumps)
    )
    assert np.abs(one.log_gain[:, 0]).max() > 0.2
    assert one.log_gain.std() > 0.9 * other.log_gain.std()
    assert other.spread > 2.0 * one.spread
    slow = [Exposure((np.exp(0.2 * np.sin(2 * np.pi * k / 16)),) * 3) for k in range(16)]
    of_slow, of_jumps = (
        starting_exposures([taken(v, e) for v, e in zip(views, each, strict=True)], points, "auto")
        for each in (slow, jumps)
    )
    assert of_slow is None
    assert of_jumps is not None


def test_few_points_tell_nothing():
    views, points = wall(points=12)
    photos = [taken(view, one) for view, one in zip(views, made_up(len(views)), strict=True)]
    assert gains_by_points(photos, points) is None
    assert starting_exposures(photos, points, "auto") is None
    assert starting_exposures(photos, None, "auto") is None


def test_exif_decides_where_no_point_does():
    views, _ = wall(count=3)
    stops = [
        replace(view, exposure_value=value)
        for view, value in zip(views, (3.0, 4.0, 5.0), strict=True)
    ]
    found = starting_exposures(stops, None, "auto")
    gain = np.exp(LOG_GAIN_OF_STOP)
    np.testing.assert_allclose([one.gain[0] for one in found.exposures], [1 / gain, 1.0, gain])
    assert (found.pulls < 1.0).all(), "cameras of strangers have other tone curves"
    same = [replace(view, exposure_value=4.0) for view in views]
    assert starting_exposures(same, None, "auto") is None
    assert gains_by_exif([*stops[:2], views[2]]) is None, "one of them does not tell"


def test_what_exif_says_is_believed_only_where_it_can_be(tmp_path):
    def value(**fields):
        tags = {"time": 0x829A, "f": 0x829D, "iso": 0x8827}
        image, exif = Image.new("RGB", (8, 8)), Image.Exif()
        exif.get_ifd(0x8769).update({tags[name]: field for name, field in fields.items()})
        image.save(tmp_path / "photo.jpg", exif=exif)
        with Image.open(tmp_path / "photo.jpg") as opened:
            return read_exif(opened).exposure_value

    assert value(time=1 / 64, f=4.0, iso=400) == pytest.approx(-6 - 4 + 2, abs=1e-3)
    assert value(time=0.0, f=4.0, iso=400) is None
    assert value(time=1 / 64, f=0.0, iso=400) is None
    assert value(time=1 / 64, f=4.0, iso=0) is None
    assert value(time=1 / 64, f=4.0) is None
    assert value() is None


def test_an_exposure_is_taken_out_as_it_is_given():
    view = wall(count=1)[0][0]
    exposure = Exposure((1.2, 0.9, 1.0), (0.01, 0.03, -0.02))
    back = exposure.taken_out_of(taken(view, exposure).image)
    assert np.abs(back.astype(int) - view.image).max() <= 1
    alpha = np.full((*view.image.shape[:2], 1), 77, np.uint8)
    with_alpha = exposure.taken_out_of(np.concatenate([view.image, alpha], axis=2))
    assert (with_alpha[..., 3] == 77).all()
    for bad in ({"gain": (1.0, 0.0, 1.0)}, {"gain": (1.0, 2.0)}, {"offset": (0.0, np.nan, 0.0)}):
        with pytest.raises(igsr.IgsrError, match=next(iter(bad))):
            Exposure(**bad)


@pytest.fixture(scope="module")
def capture():
    """Photos without alpha, every fourth held out."""
    return scenes.capture(views=12, size=40)


def with_exposures(capture, exposures):
    each = iter(exposures)
    views = [taken(v, next(each)) if v.split == "train" else v for v in capture.views]
    return Capture(capture.path, views, capture.points)


def fitted(capture, **options):
    given = {"steps": 900, "backend": "cpu", "max_splats": 400, "sh_degree": 1, **options}
    return scenes.fit_with_cameras(capture, **given)


@pytest.mark.parametrize("alpha", [False, True])
def test_a_fit_finds_exposures_and_the_colors_of_the_mean_photo(alpha):
    # All see the same side: what only few photos show tells little of the others.
    capture = scenes.capture(views=16, size=40, alpha=alpha, arc=1.0)
    count = len(capture.train_views)
    exposures = made_up(count, largest=0.25, offset=0.0)
    photos = with_exposures(capture, exposures)
    (plain, _), (splats, found) = (fitted(photos, steps=1500, exposure=m) for m in ("off", "on"))
    gains = np.array([view.exposure.gain for view in found.train_views])
    off = np.log(gains / [one.gain for one in exposures])
    assert np.sqrt(np.mean(off**2)) < 0.05, np.sqrt(np.mean(off**2))
    assert np.abs(np.log(gains).mean(axis=0)).max() < 1e-9
    before, after = (igsr.evaluate(one, capture, backend="cpu") for one in (plain, splats))
    assert after.psnr > before.psnr + 0.5
    assert after.cc_psnr > before.cc_psnr
    # Fitted photos are scored with their exposures, held-out ones without.
    assert all(view.exposure is None for view in found.test_views)
    train = igsr.evaluate(splats, found, "train", backend="cpu").psnr
    bare = Capture(found.path, [replace(view, exposure=None) for view in found.views])
    assert train > igsr.evaluate(splats, bare, "train", backend="cpu").psnr + 2.0


def test_without_exposures_bits_are_as_ever(capture):
    (off, same), (auto, _) = (fitted(capture, steps=60, exposure=m) for m in ("off", "auto"))
    assert off == auto
    assert same is capture
    on, _ = fitted(capture, steps=60, exposure="on")
    assert on != off


def test_a_fit_of_exposures_is_resumed_with_the_same_bits(capture, tmp_path):
    photos = with_exposures(capture, made_up(len(capture.train_views)))
    whole = fitted(photos, steps=120, exposure="on")
    kept = tmp_path / "checkpoint.npz"
    given = {"steps": 120, "exposure": "on", "checkpoint": kept}
    fitted(photos, progress=lambda now: now.step < 50, **given)
    resumed = fitted(photos, resume=True, **given)
    assert resumed[0] == whole[0]
    assert [v.exposure for v in resumed[1].views] == [v.exposure for v in whole[1].views]
    with pytest.raises(igsr.IgsrError, match="exposure"):
        fitted(photos, resume=True, **{**given, "exposure": "off"})


def test_pseudo_views_have_the_splats_colors(capture):
    train = capture.train_views
    size = train[0].image.shape[:2]
    pseudo = replace(train[0], name="made-up", weights=np.ones(size, np.float32))
    more = Capture(capture.path, [*capture.views, pseudo])
    _, found = fitted(more, steps=60, exposure="on")
    exposures = [view.exposure for view in found.train_views]
    assert exposures[-1] is None
    assert None not in exposures[:-1]
    # A fit goes on from the exposures that views bring.
    assert starting_exposures(found.train_views, None, "auto").exposures == exposures
    alike = without_exposures(found.train_views, exposures)
    assert all(view.exposure is None for view in alike)


def test_the_command_writes_exposures(capture, tmp_path, igsr_here):
    photos = with_exposures(capture, made_up(len(capture.train_views)))
    write_transforms(photos, tmp_path / "photos")
    ran = igsr_here(
        *("fit", tmp_path / "photos", "--out", tmp_path / "out", "--steps", 60, "--exposure", "on"),
        *("--backend", "cpu", "--holdout", 4, "--max-splats", 300),
    )
    assert ran.returncode == 0, ran.stderr
    report = json.loads((tmp_path / "out/report.json").read_text())
    frames = json.loads((tmp_path / "out/cameras.json").read_text())["frames"]
    assert report["exposure"] == "on"
    assert set(report["exposures"]) == {frame["file_path"] for frame in frames}
    for frame in frames:
        assert frame["exposure"] == report["exposures"][frame["file_path"]]
        assert len(frame["exposure"]["gain"]) == len(frame["exposure"]["offset"]) == 3
    assert {"cc_psnr", "cc_ssim"} <= set(report)


def test_cameras_without_exposure_are_written_without(capture, tmp_path):
    write_cameras(tmp_path / "cameras.json", capture.train_views)
    assert "exposure" not in (tmp_path / "cameras.json").read_text()


def test_apply_exposure_is_what_the_renderer_does():
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 5, 4, 3, generator=generator, dtype=torch.float64)
    gain = 0.3 + 0.4 * torch.rand(2, 3, generator=generator, dtype=torch.float64)
    offset = 0.1 + 0.1 * torch.rand(2, 3, generator=generator, dtype=torch.float64)
    for tensor in (image, gain, offset):
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(igsr.apply_exposure, (image, gain, offset))
    one = Exposure(tuple(gain[0].tolist()), tuple(offset[0].tolist()))
    expected = one.given_to(image[0].detach().numpy().astype(np.float32))
    got = igsr.apply_exposure(image, gain, offset)[0].detach().numpy()
    np.testing.assert_allclose(got, expected, atol=1e-6)

    # Brighter than white: cut, and only brought back.
    white = torch.full((1, 2, 3), 0.9, requires_grad=True)
    cut = igsr.apply_exposure(white, torch.full((3,), 2.0), torch.zeros(3))
    assert (cut == 1.0).all()
    (cut * torch.tensor([[[1.0], [-1.0]]])).sum().backward()
    assert white.grad[0, :, 0].tolist() == [2.0, 0.0]
    with pytest.raises(igsr.IgsrError, match="gain must have shape"):
        igsr.apply_exposure(image, gain[:1], offset)
    with pytest.raises(igsr.IgsrError, match="image must have shape"):
        igsr.apply_exposure(image[..., :2], gain, offset)


def test_a_view_with_an_exposure_is_rendered_with_it(capture):
    splats, view = scenes.splats(), capture.views[0]
    exposure = Exposure((1.3, 1.0, 0.8), (0.05, 0.0, 0.0))
    plain, seen = (
        render_of(splats, replace(view, exposure=e), (0, 0, 0)) for e in (None, exposure)
    )
    expected = taken(replace(view, image=plain), exposure).image
    assert np.abs(seen.astype(int) - expected).max() <= 2


def test_bad_starts_are_named(capture):
    arrays = {
        "gains": np.ones((2, 3)),
        "offsets": np.zeros((2, 3)),
        "fitted": np.ones(2, bool),
        "pulls": np.ones(2),
    }
    view = capture.views[0]
    with pytest.raises(ValueError, match="gains"):
        _core.Fitter(
            [view.image],
            [None],
            [None],
            [(1, None)],
            view.camera.viewmat[None],
            np.array([[60.0, 60.0, 20.0, 20.0]]),
            {
                name: getattr(scenes.splats(), name)
                for name in ("means", "quats", "scales", "opacities", "sh")
            },
            {"exposures": True, "sh_degree": 1},
            "cpu",
            None,
            arrays,
        )


@pytest.mark.usefixtures("small_fits")
def test_a_refinement_sees_photos_without_their_exposures(ball_photos, rendered):
    """What is denoised, warped and cross-validated has the colors of the mean photo."""
    count = len(ball_photos.train_views)
    exposures = made_up(count, largest=0.2, offset=0.0)
    photos = with_exposures(ball_photos, exposures)
    each = iter(exposures)
    photos = Capture(
        photos.path,
        [replace(v, exposure=next(each)) if v.split == "train" else v for v in photos.views],
    )
    refined = refinements.refine(photos, 1, refinements.lying, exposure="auto")
    refinements.refine(photos, 1, refinements.lying, exposure="auto", cross_validate=False)
    assert [one.name for one in rendered] == ["fold0", "fold1", "fold2", "whole"]
    by_name = {view.name: view for view in ball_photos.views}
    was = {view.name: view.image[..., :3].astype(int) for view in photos.views}
    for view in (view for one in rendered for view in one.photos):
        true = by_name[view.name].image[..., :3].astype(int)
        whole = (was[view.name] > 0) & (was[view.name] < 255)
        off, before = (
            np.abs(one - true)[whole].mean()
            for one in (view.image[..., :3].astype(int), was[view.name])
        )
        assert off < 0.5 * before
        assert view.exposure is None
    assert all(view.exposure is not None for view in refined.capture.train_views)
    assert all(view.exposure is None for view in refined.capture.test_views)


@pytest.mark.parametrize("gain", [4.0, 0.7])
def test_what_a_photo_cuts_to_white_is_as_bright_as_the_fit_shows(gain):
    """With the exposure taken out, white would be grey."""
    exposure = Exposure((gain,) * 3, (0.0, 0.0, 0.0))
    model = scenes.splats(60, degree=0)
    views, true = [], []
    for view in scenes.capture(views=3, scene=model).views:
        color = igsr.render(model, view.camera, backend="cpu").color
        taken = np.clip(255.0 * exposure.given_to(color) + 0.5, 0.0, 255.0).astype(np.uint8)
        views.append(replace(view, image=taken, exposure=exposure))
        true.append(np.clip(255.0 * color + 0.5, 0.0, 255.0).astype(np.uint8).astype(int))
    plain = without_exposures(views, [exposure] * 3)
    lifted = with_cut_highlights(plain, views, model, (0.0, 0.0, 0.0), "cpu")
    off = [np.abs(view.image - one).max() for view, one in zip(plain, true, strict=True)]
    assert (max(off) > 20) == (gain > 1.0)
    for view, one in zip(lifted, true, strict=True):
        assert np.abs(view.image - one).max() <= 2
    assert all(view.exposure is None for view in lifted)
    # A fit that is darker than white with the exposure taken out does not make photos darker.
    dark = replace(model, opacities=model.opacities - 20.0)
    still = with_cut_highlights(plain, views, dark, (0.0, 0.0, 0.0), "cpu")
    assert all(np.array_equal(a.image, b.image) for a, b in zip(still, plain, strict=True))
