"""Floaters: evidence of photos, stray splats, removal from fits, ``igsr clean``."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import scenes
from scenes import round_splats
from typer.testing import CliRunner

import igsr
from igsr.cli import app
from igsr.fitting import fit_capture
from igsr.floaters import photo_evidence, removal
from igsr.floaters.photo_evidence import needed_by_others, sightings
from igsr.floaters.removal import alone, stray_splats, unsupported_splats
from igsr.splats import joined, subset

BLACK = (0.0, 0.0, 0.0)
BALL = scenes.splats(60, degree=0)


def before(view, distance=1.2):
    """A place before a view's camera, between it and the ball."""
    camera = view.camera
    return camera.center + distance * camera.viewmat[2, :3]


def ball_and(means, **options):
    """The ball, and specks after it."""
    return joined([BALL, round_splats(means, **options)])


def photos_of(scene=BALL, views=6, **options):
    return scenes.capture(views=views, scene=scene, **options).views


ABOVE = [0.0, 40.0, 0.0]  # outside of all photos


# ---- evidence of photos ------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_sightings_count_cameras_that_see_a_splat(backend):
    views = photos_of()
    model = ball_and([before(views[0]), ABOVE], size=0.02, opacity=-1.0)
    seen = sightings(model, [view.camera for view in views], backend)
    assert seen.shown[-2:].tolist() == [1, 0]
    assert seen.before[-2:].tolist() == [1, 0]
    assert seen.area[-1] == 0.0
    assert not seen.before[:60].any()
    alpha = sum(igsr.render(model, view.camera, backend=backend).alpha.sum() for view in views)
    assert seen.area.sum() == pytest.approx(alpha, rel=1e-4)


def test_needed_by_others_is_the_growth_of_the_squared_error(monkeypatch):
    monkeypatch.setattr(photo_evidence, "PROBES_PER_PHOTO", 2000)
    views = photos_of(scenes.splats(8, seed=5), views=3, size=32)
    model = scenes.splats(8, degree=1)
    model.opacities[:] = np.linspace(-1.0, 1.0, 8)  # below the clamp at 0.99
    estimated = needed_by_others(model, views, BLACK, backend="reference")

    def errors(splats):
        renders = [igsr.render(splats, v.camera, BLACK, "reference").color for v in views]
        pairs = zip(renders, views, strict=True)
        return np.array([np.square(color - v.image / 255.0).sum() for color, v in pairs])

    for k in range(8):
        growth = errors(subset(model, np.arange(8) != k)) - errors(model)
        assert estimated[k] == pytest.approx(growth.sum() - growth.max(), rel=0.1, abs=0.3)


def test_masked_pixels_need_nothing():
    views = scenes.capture(views=3, size=24).views
    masked = [replace(view, mask=np.zeros((24, 24), np.bool_)) for view in views]
    assert not needed_by_others(BALL, masked, BLACK, backend="cpu").any()
    assert needed_by_others(BALL, views, BLACK, backend="cpu").any()


def with_masks_of(views, splats):
    """The views with masks of the pixels that these splats cover."""
    alphas = [igsr.render(splats, view.camera, backend="cpu").alpha for view in views]
    return [replace(view, mask=alpha > 0.05) for view, alpha in zip(views, alphas, strict=True)]


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_sightings_measure_the_unmasked_area(backend):
    views = with_masks_of(photos_of(), subset(BALL, slice(8)))
    cameras, masks = [view.camera for view in views], [view.mask for view in views]
    seen = sightings(BALL, cameras, backend, masks)
    alphas = [igsr.render(BALL, camera, backend=backend).alpha for camera in cameras]
    inside = sum(alpha[mask].sum() for alpha, mask in zip(alphas, masks, strict=True))
    assert seen.counted.sum() == pytest.approx(inside, rel=1e-4)
    assert seen.counted.sum() < 0.9 * seen.area.sum()
    everywhere = sightings(BALL, cameras, backend)
    assert np.array_equal(everywhere.counted, everywhere.area)


def unsupported(model, views, backend="cpu"):
    """Indices of the splats that photos do not support, by kind."""
    kinds = unsupported_splats(model, views, BLACK, backend=backend)
    return {kind: np.flatnonzero(mask).tolist() for kind, mask in kinds.items()}


def test_masked_splats_are_found_unless_a_photo_counts_them():
    scene = ball_and([[0.0, -1.5, 0.0], [0.3, -1.5, 0.0]], size=0.08)
    views = photos_of(scene)
    masked = with_masks_of(views, BALL)
    assert unsupported(scene, masked)["masked"] == [60, 61]
    assert unsupported(scene, views)["masked"] == []
    assert unsupported(scene, [*masked[:3], *views[3:]])["masked"] == []
    # Pseudo-views are not evidence, since they show the fit.
    pseudo = [scenes.pseudo_view(view) for view in views]
    assert unsupported(scene, [*masked, *pseudo])["masked"] == [60, 61]


def test_tiny_masked_splats_are_left_to_pseudo_views():
    scene = ball_and([[0.1, -1.4, 0.0]], size=0.004, opacity=-1.0)
    views = photos_of(scene)
    area = sightings(scene, [view.camera for view in views], "cpu").area[-1]
    assert 0.0 < area < photo_evidence.MIN_AREA_PX
    pseudo = [scenes.pseudo_view(view) for view in views]
    found = unsupported(scene, [*with_masks_of(views, BALL), *(pseudo * 40)])
    assert not any(60 in indices for indices in found.values())


@pytest.mark.parametrize("backend", ["cpu", "gpu", "reference"])
def test_unseen_and_floating_splats_are_found(backend):
    views = photos_of()
    model = ball_and([ABOVE, before(views[2])], size=0.03, opacity=-1.0)
    expected = {"unseen": [60], "masked": [], "floating": [61]}
    assert unsupported(model, views, backend) == expected


def test_near_objects_that_all_photos_show_are_kept():
    """A thin veil around the ball: in front of it in every photo, and needed by all of them."""
    angles = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    ring = [[2.4 * np.sin(a), y, -2.4 * np.cos(a)] for a in angles for y in (-0.3, 0.0, 0.3)]
    scene = ball_and(ring, size=0.12, opacity=-2.0, color=0.9)
    views = photos_of(scene, views=12)
    seen = sightings(scene, [view.camera for view in views], "cpu")
    assert (seen.before[60:] > 0).sum() > 60
    assert not (seen.shown[unsupported(scene, views)["floating"]] > 1).any()
    # Photos without the veil do not need it, even from behind.
    floating = unsupported(scene, photos_of(views=12))["floating"]
    assert floating
    assert min(floating) >= 60


def test_splats_of_photos_that_are_not_sampled_are_kept(monkeypatch):
    views = photos_of(arc=0.3)
    model = ball_and([before(views[3])], size=0.03, opacity=-1.0)
    assert sightings(model, [view.camera for view in views], "cpu").shown[60] > 1
    assert unsupported(model, views)["floating"] == [60]
    monkeypatch.setattr(removal, "MAX_NEED_PHOTOS", 1)
    elsewhere = scenes.ring_camera(0.0, center=(50.0, 0.0, 0.0))
    photos = [replace(views[0], camera=elsewhere), *views]
    assert unsupported(model, photos)["floating"] == []


def test_pseudo_views_keep_splats_but_find_no_floaters():
    views = photos_of()
    model = ball_and([before(views[2])], size=0.03, opacity=-1.0)
    others = [*views[:2], *views[3:]]
    assert unsupported(model, others)["unseen"] == [60]
    found = unsupported(model, [*others, scenes.pseudo_view(views[2])])
    assert found["unseen"] == found["floating"] == []


# ---- stray splats ------------------------------------------------------------------------------


def plane(count=20, scale=1.0):
    """A plane of splats that touch each other."""
    grid = np.indices((count, count)).reshape(2, -1).T
    means = np.concatenate([grid, np.zeros((len(grid), 1))], axis=1)
    return round_splats(means * 0.1 * scale, size=0.05 * scale)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_an_isolated_splat_is_alone(scale):
    speck = round_splats([[1.0 * scale, 1.0 * scale, 30.0 * scale]], size=0.05 * scale)
    found = alone(joined([plane(scale=scale), speck]))
    assert np.flatnonzero(found).tolist() == [400]


def test_large_distant_splats_are_not_alone_and_extreme_positions_do_not_overflow():
    far = round_splats([[0.0, 0.0, 30.0], [20.0, 0.0, 30.0]], size=15.0)
    assert not alone(joined([plane(), far])).any()
    hard = joined([plane(), round_splats([[3e38, -3e38, 0.0], [0.0, 0.0, 1.0]])])
    hard.scales[400:] = [[88.0], [-69.0]]
    found = alone(hard)
    assert found[401]
    assert not found[:400].any()
    # A scene of isolated splats is kept.
    lonely = round_splats([[10.0 * k, 0.0, 0.0] for k in range(30)])
    assert alone(lonely).all()
    assert not stray_splats(lonely)["alone"].any()


def test_removing_invisible_splats_keeps_renders_identical():
    model = joined([plane(), round_splats([[1.0, 1.0, 0.1], [np.nan] * 3])])
    model.opacities[400] = -5.6
    cleaned = igsr.remove_floaters(model)
    assert cleaned.removed == {"invisible": 2, "alone": 0}
    assert cleaned.splats == plane()
    camera = scenes.ring_camera(0.0)
    for backend in ("cpu", "reference"):
        was, now = (igsr.render(s, camera, backend=backend) for s in (model, cleaned.splats))
        assert np.array_equal(was.color, now.color)


# ---- removal -----------------------------------------------------------------------------------


def test_removal_by_photos_keeps_the_order():
    capture = scenes.capture(views=8, scene=BALL)
    floating = round_splats([before(capture.views[2])], size=0.03, opacity=-1.0)
    model = joined([round_splats([[0.0, 40.0, 0.0]]), BALL, floating])
    origin = np.array([1.0, 0.0, 0.0])
    model = replace(model, origin=origin, means=(model.means - origin).astype(np.float32))
    cleaned = igsr.remove_floaters(model, capture, backend="cpu")
    assert cleaned.removed == {"unseen": 1, "masked": 0, "floating": 1}
    assert np.array_equal(cleaned.splats.means, model.means[1:-1])
    assert np.array_equal(cleaned.splats.origin, model.origin)


def test_a_scene_of_floaters_only_is_kept_and_a_capture_without_train_views_refused():
    capture = scenes.capture(views=4)
    cleaned = igsr.remove_floaters(round_splats([[0.0, 40.0, 0.0]]), capture, backend="cpu")
    assert len(cleaned.splats) == 1
    assert cleaned.removed == {"unseen": 0, "masked": 0, "floating": 0}
    nothing = replace(capture, views=capture.test_views)
    with pytest.raises(igsr.IgsrError, match="no train views"):
        igsr.remove_floaters(BALL, nothing, backend="cpu")


# ---- fits --------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_fits_remove_and_count_floaters(tmp_path, seed):
    capture, path = scenes.capture(views=8, size=32, scene=BALL), tmp_path / "checkpoint.npz"
    options = {"steps": 60, "max_splats": 300, "start": "random", "backend": "cpu", "seed": seed}
    whole = fit_capture(capture, remove_floaters=False, checkpoint=path, **options)
    assert whole.removed == {}
    kinds = unsupported_splats(whole.splats, capture.train_views, BLACK, seed=seed, backend="cpu")
    # Checkpoints keep floaters, since they are removed after the last step.
    for checkpoint in ({}, {"checkpoint": path, "resume": True}):
        result = fit_capture(capture, **checkpoint, **options)
        assert result.removed == {name: int(kind.sum()) for name, kind in kinds.items()}
        assert result.removed["unseen"] > 0
        assert result.splats == subset(whole.splats, ~np.any(list(kinds.values()), axis=0))


# ---- igsr clean --------------------------------------------------------------------------------


def command(*arguments):
    return CliRunner().invoke(app, ["clean", *map(str, arguments)])


@pytest.fixture
def scene(tmp_path):
    """A scene with a speck far away that no photo shows, and its photos."""
    capture = scenes.capture(views=8, scene=BALL)
    joined([BALL, round_splats([[0.0, 40.0, 0.0]])]).save(tmp_path / "scene.ply")
    scenes.write_capture(tmp_path / "photos", capture)
    return tmp_path / "scene.ply", tmp_path / "photos"


def test_clean_removes_unseen_splats(scene, tmp_path):
    path, photos = scene
    out = tmp_path / "clean.ply"
    words = ["--capture", photos, "--holdout", 4, "--out", out, "--backend", "cpu"]
    result = command(path, *words, "--json")
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["removed"] == {"unseen": 1, "masked": 0, "floating": 0}
    assert (report["before"], report["splats"]) == (61, 60)
    assert report["held_out"]["before"] == report["held_out"]["after"]
    assert report["held_out"]["after"]["views"] == 2
    assert igsr.Splats.load(out) == BALL
    first = out.read_bytes()
    assert "removed 1 splats: 1 that no photo shows" in command(path, *words).stdout
    assert out.read_bytes() == first


def test_clean_without_photos_removes_stray_splats(tmp_path):
    joined([plane(), round_splats([[1.0, 1.0, 30.0]])]).save(tmp_path / "scene.ply")
    result = command(tmp_path / "scene.ply")
    assert result.exit_code == 0, result.output
    assert "removed 1 splats: 0 too faint to be drawn, 1 with few neighbors" in result.stdout
    assert igsr.Splats.load(tmp_path / "scene.clean.ply") == plane()


def test_clean_refuses_bad_arguments(scene):
    path, _ = scene
    before = sorted(path.parent.iterdir())
    for words, message in (
        ([path, "--holdout", "4"], "--holdout needs photos; give --capture"),
        ([path, "--max-size", "64"], "--max-size needs photos; give --capture"),
        ([path, "--capture", "nowhere"], "nowhere"),
        ([path, "--out", "scene.xyz"], "scene.xyz"),
        ([path.parent / "none.ply"], "none.ply"),
    ):
        result = command(*words)
        assert result.exit_code == 1
        assert message in result.stderr
        assert sorted(path.parent.iterdir()) == before
