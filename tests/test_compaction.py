"""``igsr compact``: contribution of splats, search for the smallest model, command."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
import scenes
from capture_files import assert_refused

import igsr
from igsr.compaction import contribution, validation
from igsr.compaction.validation import loss_of_change, photo_validation, self_validation
from igsr.evaluation import metrics
from igsr.splats import joined, subset


def wall(count=2000, seed=0):
    """A flat wall of one color, made of many small splats."""
    random = np.random.default_rng(seed)
    columns = round(math.sqrt(count * 1.25))
    grid = np.indices((columns, -(-count // columns))).reshape(2, -1).T[:count]
    means = np.zeros((count, 3))
    means[:, :2] = 2.0 * grid / columns - 1.0
    means += random.normal(scale=[0.01, 0.01, 0.001], size=means.shape)
    return scenes.round_splats(means, [0.04, 0.04, 0.002], opacity=3.0, color=0.7)


def beads(colors, opacities, depths):
    """Round splats in a row on the axis of ``ring_camera(0)``, the nearest first."""
    means, colors = [[0, 0, depth] for depth in depths], np.asarray(colors)[:, None]
    return scenes.round_splats(means, 0.3, opacities, colors)


@pytest.fixture(autouse=True)
def small_pictures(monkeypatch):
    """Without a capture: fewer and smaller pictures than users get, for the time it takes."""
    monkeypatch.setattr(validation, "AROUND_CAMERAS", 15)
    monkeypatch.setattr(validation, "AROUND_SIDE_PX", 56)


@pytest.fixture(scope="module")
def photos():
    """A capture of a scene, and a model of it with wrong colors and 120 superfluous splats."""
    scene = scenes.splats(count=40, degree=1)
    wrong = np.random.default_rng(7).normal(scale=0.1, size=scene.sh.shape).astype(np.float32)
    off = replace(scene, sh=scene.sh + wrong)
    rest = [scenes.splats(count=40, degree=1, seed=seed) for seed in (1, 2, 3)]
    for useless in rest:
        useless.opacities[:] = -5.0
    return scenes.capture(views=8, size=40, alpha=True, scene=scene), joined([off, *rest])


# ---- contribution ------------------------------------------------------------------------------


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_weights_add_up_to_the_opacity_of_the_pictures(backend):
    splats = scenes.splats(count=30)
    cameras = [scenes.ring_camera(angle) for angle in (0.0, 1.0, 2.5)]
    weight = contribution(splats, cameras, backend=backend).weight
    alpha = sum(igsr.render(splats, camera, backend=backend).alpha.sum() for camera in cameras)
    assert weight.shape == (30,)
    assert weight.sum() == pytest.approx(alpha, rel=1e-4)


def test_change_is_the_derivative_of_the_picture():
    splats = scenes.splats(count=6, degree=0)
    camera = scenes.ring_camera(0.4, size=32)
    seeds = range(200)
    changes = [contribution(splats, [camera], seed, "reference").change for seed in seeds]
    estimate = np.mean(np.square(changes), axis=0)
    backgrounds = [np.random.default_rng([seed, 0xC047]).uniform(size=3) for seed in seeds]
    for i in range(6):
        opacity = 1.0 / (1.0 + math.exp(-splats.opacities[i]))
        renders = []
        for step in (0.01, -0.01):
            moved = replace(splats, opacities=splats.opacities.copy())
            moved.opacities[i] += step
            renders.append(igsr.render(moved, camera, backend="reference"))
        # d logit = d opacity / (opacity (1 - opacity)); to be multiplied with the opacity.
        per_logit = 0.02 * (1.0 - opacity)
        color = (renders[0].color - renders[1].color).astype(np.float64) / per_logit
        open_share = (renders[0].transmittance - renders[1].transmittance)[..., None] / per_logit
        truth = np.mean([np.square(color + open_share * behind).sum() for behind in backgrounds])
        assert estimate[i] == pytest.approx(truth, rel=0.25)


def test_hidden_splats_are_not_important():
    red, green = (0.9, 0.1, 0.1), (0.1, 0.9, 0.1)
    camera = [scenes.ring_camera(0.0)]
    before_own = contribution(beads([red, red], [3, 6], [-0.5, 0.5]), camera, backend="cpu")
    before_other = contribution(beads([red, green], [3, 6], [-0.5, 0.5]), camera, backend="cpu")
    assert before_own.importance[0] < 0.5 * before_other.importance[0]
    assert before_own.weight[0] == pytest.approx(before_other.weight[0])
    many = beads([red, red, red, green], [8, 8, 8, 8], [-0.6, -0.5, -0.4, 0.6])
    hidden = contribution(many, camera, backend="cpu").importance
    assert hidden[3] < 0.05 * hidden[0]


# ---- validation views --------------------------------------------------------------------------


def test_loss_of_a_change():
    assert loss_of_change(30.0, 30.0) == pytest.approx(10.0 * math.log10(2.0))
    assert loss_of_change(46.3, 30.0) == pytest.approx(0.1, abs=0.002)
    assert loss_of_change(100.0, 30.0) < 1e-5


def test_no_view_is_both_trained_on_and_validated_on(photos):
    capture, model = photos
    train_views = [replace(view, split="train") for view in capture.views]
    without_tests = igsr.Capture(capture.path, train_views)
    for measure, judges in (
        (photo_validation(model, capture, None, "cpu"), 2),
        (photo_validation(model, without_tests, None, "cpu"), 1),
        (self_validation(model, None, None, "cpu"), 3),
    ):
        refine = {view.camera.viewmat.tobytes() for view in measure.train_views}
        judge = {view.camera.viewmat.tobytes() for view in measure.validation_views}
        assert len(judge) == judges == measure.protocol["validation_views"]
        assert len(refine) == measure.protocol["train_views"]
        assert not refine & judge


def test_cameras_around_see_the_scene_from_all_sides():
    splats = scenes.splats(count=60, origin=(100.0, -20.0, 5.0))
    cameras = [view.camera for view in self_validation(splats, None, None, "cpu").train_views]
    directions = np.array([camera.center for camera in cameras]) - [100.0, -20.0, 5.0]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert np.linalg.norm(directions.mean(axis=0)) < 0.25
    for camera in cameras:
        alpha = igsr.render(splats, camera, backend="cpu").alpha
        assert 0.05 < alpha.mean() < 0.9


# ---- the search --------------------------------------------------------------------------------


def test_a_wall_of_one_color_is_compacted():
    whole = wall()
    compaction = igsr.compact(whole, 0.1, steps=160, backend="cpu")
    assert len(compaction.splats) < 400
    assert compaction.report["whole"]["splats"] == 2000
    assert compaction.report["result"]["splats"] == len(compaction.splats)
    # Seen from a place that no camera of the search stands at.
    camera = scenes.ring_camera(0.3, size=56, distance=3.0)
    gray = (0.5, 0.5, 0.5)
    renders = (igsr.render(one, camera, gray, "cpu") for one in (compaction.splats, whole))
    change = metrics.psnr(*(render.to_uint8() for render in renders))
    assert loss_of_change(change, 30.0) < 0.3


def test_photos_measure_the_loss(photos):
    capture, model = photos
    compaction = igsr.compact(model, 0.1, capture, steps=40, backend="cpu")
    report = compaction.report
    assert len(compaction.splats) <= 60
    both = model, compaction.splats
    before, after = (igsr.evaluate(one, capture, backend="cpu")["psnr"] for one in both)
    assert report["result"]["loss"] == pytest.approx(before - after, abs=1e-6)
    assert report["result"]["loss"] <= 0.1
    assert report["protocol"]["model_psnr"] == pytest.approx(before)
    assert report["curve"][0] == report["whole"]
    assert report["whole"]["loss"] == 0.0
    assert report["result"] in report["curve"]
    sizes = [row["splats"] for row in report["curve"] if row["sh_degree"] == 1]
    assert min(sizes) < len(compaction.splats)  # smaller ones were tried and lost too much


def test_same_seed_same_bits(photos):
    capture, model = photos
    options = {"steps": 100, "backend": "cpu"}
    fits = (igsr.compact(model, 0.1, capture, seed=seed, **options) for seed in (1, 1, 2))
    first, again, other = (one.splats for one in fits)
    assert first == again
    assert first != other


def test_invisible_splats_are_removed_without_loss():
    """Steps of fitting would only hurt a model that is validated on its own renders."""
    seen = scenes.splats(count=30, degree=1)
    inside = replace(scenes.splats(count=30, degree=1), opacities=np.full(30, -9.0, np.float32))
    report = igsr.compact(joined([seen, inside]), 1e-4, psnr=20.0, steps=4, backend="cpu").report
    assert report["result"]["splats"] < 45
    assert report["result"]["loss"] <= 1e-4


def test_the_model_is_kept_if_nothing_smaller_is_within_the_loss(photos):
    capture, model = photos
    needed = subset(model, slice(40))
    compaction = igsr.compact(needed, 1e-6, capture, steps=1, backend="cpu")
    assert compaction.report["result"] == compaction.report["whole"]
    np.testing.assert_array_equal(compaction.splats.means, needed.means)


def test_view_independent_colors_lose_their_bands():
    flat = wall(60)
    bands = np.zeros((60, 9, 3), np.float32)
    bands[:, :1] = flat.sh
    view_dependent = replace(flat, sh=bands)
    lowered = igsr.compact(view_dependent, 0.1, steps=20, backend="cpu")
    assert lowered.splats.sh_degree == 0
    kept = igsr.compact(view_dependent, 0.1, sh_degree=3, steps=20, backend="cpu")
    assert kept.splats.sh_degree == 3 or len(kept.splats) == 60


def test_splats_that_are_not_finite_do_not_count():
    broken = wall(80)
    broken.means[5] = np.nan
    compaction = igsr.compact(broken, 0.1, steps=4, backend="cpu")
    assert compaction.report["whole"]["splats"] == 79
    assert compaction.splats.finite.all()


# ---- bad input ---------------------------------------------------------------------------------

BAD = {
    "max_loss": [0.0, -1.0, float("nan"), "0.1", True, 200.0],
    "psnr": [0.0, float("inf"), "30"],
    "sh_degree": [-1, 5, 1.5],
    "steps": [0, 2.5, None],
    "seed": [-1, "a"],
    "background": [(1, 1), (0, 0, 2), "red"],
    "backend": ["reference", "tpu"],
}


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name, values in BAD.items() for value in values]
)
def test_bad_arguments_are_named(name, value):
    assert_refused(name, igsr.compact, wall(10), **{"backend": "cpu", name: value})


def test_unusable_scenes_and_captures_are_refused(photos):
    capture, model = photos
    empty = wall(3)
    empty.opacities[:] = np.nan
    assert_refused("no finite splats", igsr.compact, empty, backend="cpu")
    lone = igsr.Capture(capture.path, capture.views[:1])
    assert_refused("one held-out view", igsr.compact, model, 0.1, lone, backend="cpu")
    with pytest.raises(igsr.IgsrError, match="give psnr or capture, not both"):
        igsr.compact(model, 0.1, capture, psnr=30.0, backend="cpu")


# ---- the command -------------------------------------------------------------------------------


def test_command_writes_scene_curve_and_plot(igsr_here, tmp_path):
    wall(100).save(tmp_path / "scene.ply")
    (tmp_path / "report.json").write_text(json.dumps({"psnr": 27.5}))
    options = ("--max-loss", "0.2dB", "--steps", 8, "--backend", "cpu", "--json")
    result = igsr_here("compact", tmp_path / "scene.ply", *options)
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report == json.loads((tmp_path / "scene.compact.json").read_text())
    written = {f"scene.compact.{suffix}" for suffix in ("json", "ply", "png")}
    assert {path.name for path in tmp_path.iterdir()} == {"report.json", "scene.ply", *written}
    assert report["max_loss"] == 0.2
    assert report["protocol"]["model_psnr"] == 27.5
    smaller = tmp_path / "scene.compact.ply"
    assert report["result"]["splats"] == len(igsr.Splats.load(smaller))
    assert report["result"]["bytes"] == smaller.stat().st_size
    assert {"seed", "backend", "version"} <= set(report)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["scene.ply", "--max-loss", "lots"], ["--max-loss", "0.1dB", "lots"]),
        (["scene.ply", "--max-loss", "-1dB"], ["--max-loss", "above 0"]),
        (["scene.ply", "--max-loss", "nan"], ["--max-loss"]),
        (["scene.ply", "--out", "smaller.json"], ["--out", ".ply"]),
        (["scene.ply", "--holdout", "8"], ["--holdout", "--capture"]),
        (["scene.ply", "--steps", "0"], ["steps"]),
        (["none.ply"], ["none.ply"]),
    ],
)
def test_command_refuses_in_one_sentence(igsr_here, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    wall(10).save(tmp_path / "scene.ply")
    result = igsr_here("compact", *words)
    assert result.returncode == 1
    assert result.stdout == ""
    assert len(result.stderr.splitlines()) == 1, result.stderr
    assert all(word in result.stderr for word in message)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]


def test_an_exception_in_progress_stops_the_compaction():
    stop = Mock(side_effect=KeyboardInterrupt)
    with pytest.raises(KeyboardInterrupt):
        igsr.compact(wall(60), steps=20, backend="cpu", progress=stop)
    assert stop.call_count == 1
