"""Training a pose network: what is true, what is wrong, what is learned, kept and loaded again."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pose_trainings
import pytest
import rooms
import torch
from da3_networks import hashed_network, hashed_pixels
from pose_trainings import SMALL, write_captures
from typer.testing import CliRunner

from igsr.capture.photo_folder import Photo
from igsr.cli import app
from igsr.errors import IgsrError
from igsr.geometry.pose_errors import pose_accuracy
from igsr.pose.da3.cameras import cameras_of_rays, encode_pose
from igsr.pose.da3.checkpoint import load_network
from igsr.pose.da3.config import SIZES
from igsr.pose.da3.estimator import Da3
from igsr.pose.da3.network import Prediction
from igsr.pose.da3.training import train_network
from igsr.pose.da3.training.capture_source import CaptureSource
from igsr.pose.da3.training.initial_weights import initial_network
from igsr.pose.da3.training.learner import Learner
from igsr.pose.da3.training.losses import losses, true_rays
from igsr.pose.da3.training.train_network import train
from igsr.pose.da3.training.training_settings import PoseTraining
from igsr.pose.da3.training.true_pass import true_pass
from igsr.pose.da3.training.validation import constant_scores, validated
from igsr.training.training_run import CHECKPOINT, LOG

CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    return write_captures(tmp_path_factory.mktemp("captures"))


@pytest.fixture(scope="module")
def trained(captures, tmp_path_factory):
    """The folder of a training of a few steps, and the network that came out."""
    out = tmp_path_factory.mktemp("trained")
    torch.set_num_threads(1)
    return out, train(out, SMALL, captures=captures, log_every=2, checkpoint_every=2)


def room(count=3, width=56, height=42):
    return true_pass(pose_trainings.views(count, 0, width, height), 56)


def truth(true):
    """The prediction in which everything is right."""
    height, width = true.depth.shape[1:]
    size = [(height, width)] * len(true.depth)
    rays = true_rays(true, 8 * height // 14, 8 * width // 14)
    return Prediction(
        depth=torch.where(true.depth > 0.0, true.depth, 7.0),
        confidence=torch.ones_like(true.depth),
        rays=rays,
        ray_confidence=torch.ones_like(rays[..., 0]),
        pose_encoding=encode_pose(true.viewmats, true.intrinsics, size).float(),
    )


def logged(out):
    return [json.loads(line) for line in (out / LOG).read_text().splitlines()]


# ---- what is true ------------------------------------------------------------------------------


def test_the_truth_is_in_the_first_cameras_frame_and_in_its_own_unit():
    views = pose_trainings.views(3, 0, 56, 42)
    true = true_pass(views, 56)
    torch.testing.assert_close(true.viewmats[0], torch.eye(4))
    found = pose_accuracy(true.cameras(), [view.camera for view in views])
    assert found["rotation"] < 1e-3
    assert found["translation"] < 1e-3
    known = true.depth > 0.0
    assert not known[:, :, -1].any()
    assert known[:, :, :-1].all()
    directions, origins = true_rays(true, 42, 56).split(3, dim=-1)
    points = (true.depth[..., None] * directions + origins)[known]
    assert points.norm(dim=-1).mean() == pytest.approx(1.0, abs=1e-5)
    # What the second photo sees is where the first has it, too.
    seen = (true.depth[1, ..., None] * directions[1] + origins[1])[10:30, 10:40].reshape(-1, 3)
    x, y, z = (seen @ true.intrinsics[0].T).unbind(-1)
    column, row = (x / z).long(), (y / z).long()
    inside = (column >= 0) & (column < 55) & (row >= 0) & (row < 42)
    error = (true.depth[0, row[inside], column[inside]] / z[inside] - 1.0).abs()
    assert inside.sum() > 300
    assert error.median() < 0.02


def test_a_photo_is_resampled_with_its_depth_and_its_focal_length():
    views = pose_trainings.views(2, 0, 120, 85)
    true = true_pass(views, 56)
    assert true.pixels.shape == (2, 3, 42, 56)
    K = views[0].camera.K
    wanted = [K[0, 0] * 56 / 120, K[1, 1] * 42 / 85, 28.0, 21.0]
    found = true.intrinsics[0]
    assert [*found.diagonal()[:2], *found[:2, 2]] == pytest.approx(wanted, rel=1e-6)
    # Both are of the same room: the unit is nearly that of the photos at another size.
    other = true_pass(pose_trainings.views(2, 0, 56, 42), 56)
    ratio = (true.depth / other.depth)[:, :, :50]
    assert ratio.median() == pytest.approx(1.0, abs=0.02)


def test_the_truth_has_no_loss_and_its_rays_have_its_cameras():
    true = room()
    predicted = truth(true)
    for name, part in losses(predicted, true).items():
        assert float(part) == pytest.approx(0.0, abs=1e-5 if name != "points" else 2e-3), name
    w2c, K = cameras_of_rays(predicted.rays, predicted.ray_confidence, 42, 56)
    np.testing.assert_allclose(w2c, true.viewmats[:, :3].numpy(), atol=1e-4)
    np.testing.assert_allclose(K, true.intrinsics.numpy(), rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda p: {"depth": 1.5 * p.depth}, {"depth", "points", "slopes"}),
        (lambda p: {"depth": p.depth + 0.1}, {"depth", "points"}),
        (lambda p: {"rays": p.rays + 0.1}, {"rays", "points"}),
        (lambda p: {"pose_encoding": p.pose_encoding + 0.1}, {"camera"}),
        (lambda p: {"depth": p.depth + 0.1, "confidence": 5.0 * p.confidence}, {"depth", "points"}),
    ],
)
def test_what_is_wrong_costs_in_its_part(change, parts):
    true = room()
    right, wrong = truth(true), Prediction(**{**vars(truth(true)), **change(truth(true))})
    before, after = losses(right, true), losses(wrong, true)
    assert {name for name in before if after[name] > before[name] + 5e-3} == parts


def test_to_be_sure_pays_where_one_is_right_alone():
    true = room()
    right = truth(true)
    sure = replace(right, confidence=5.0 * right.confidence)
    assert losses(sure, true)["depth"] < losses(right, true)["depth"] - 0.1
    off = {"depth": right.depth + 1.0}
    assert (
        losses(replace(sure, **off), true)["depth"] > losses(replace(right, **off), true)["depth"]
    )


def test_a_quaternion_and_its_opposite_are_one_rotation():
    true = room()
    predicted = truth(true)
    predicted.pose_encoding[:, 3:7] *= -1.0
    assert float(losses(predicted, true)["camera"]) == pytest.approx(0.0, abs=1e-6)


def test_a_pass_in_which_nothing_is_hit_has_gradients_all_the_same():
    views = pose_trainings.views(2, 0, 28, 28)
    for view in views:
        view.depth[:] = 0.0
    true = true_pass(views, 28)
    learner = Learner(initial_network(SIZES["igsr-tiny"], 0), SMALL, CPU)
    parts = learner.learn([true], shown=False)
    assert parts["depth"] == 0.0
    assert all(np.isfinite(list(parts.values())))


# ---- what is learned ---------------------------------------------------------------------------


def test_a_gradient_reaches_every_weight():
    network = hashed_network().requires_grad_(True)
    true = replace(room(), pixels=hashed_pixels("pass", 3, 42, 56))
    shown = {"viewmats": true.viewmats, "intrinsics": true.intrinsics}
    reached = {}
    for cameras in ({}, shown):
        network.zero_grad()
        sum(losses(network(true.pixels, "first", **cameras), true).values()).backward()
        reached |= {
            name: reached.get(name, False)
            or (weight.grad is not None and bool((weight.grad != 0.0).any()))
            for name, weight in network.named_parameters()
        }
    assert [name for name, one in reached.items() if not one] == []


def test_cameras_are_shown_where_they_are_to_be():
    learner = Learner(initial_network(SIZES["igsr-tiny"], 0), SMALL, CPU)
    encoder = learner.network.cam_enc.trunk_norm.weight
    for shown in (False, True):
        learner.learn([true_pass(pose_trainings.views(2), 28)], shown)
        assert (encoder.grad is not None) == shown


def test_a_network_learns_what_it_is_shown():
    training = replace(SMALL, steps=16, rate=2e-3)
    learner = Learner(initial_network(SIZES["igsr-tiny"], 0), training, CPU)
    batch = [true_pass(pose_trainings.views(2), 28)]
    lost = [learner.learn(batch, shown=False) for _ in range(training.steps)]
    for name in ("loss", "depth", "rays", "points", "camera"):
        assert lost[-1][name] < 0.7 * lost[0][name], name
    found = validated(learner.network.eval(), batch, CPU)
    assert found["validation_depth_error"] < found["validation_depth_error_constant"]


def test_a_new_network_looks_ahead_through_a_usual_lens():
    network = initial_network(SIZES["igsr-tiny"], 3)
    predicted = network(hashed_pixels("pass", 2, 28, 28))
    assert ((predicted.pose_encoding[:, 7:] > 0.3) & (predicted.pose_encoding[:, 7:] < 2.0)).all()
    assert (predicted.rays[..., 2] > 0.3).all()
    assert sum(weight.numel() for weight in network.parameters()) == 4_425_250
    same, other = (initial_network(SIZES["igsr-tiny"], seed).state_dict() for seed in (3, 4))
    key = "backbone.pretrained.pos_embed"
    assert torch.equal(network.state_dict()[key], same[key])
    assert not torch.equal(network.state_dict()[key], other[key])


def test_scores_of_the_truth_and_of_an_answer_that_never_looks():
    passes = [room(), room(2)]

    def tells_the_truth(pixels):
        return truth(next(one for one in passes if len(one.pixels) == len(pixels)))

    found = validated(tells_the_truth, passes, CPU)
    for name in ("rotation", "translation", "depth_error"):
        assert found[f"validation_{name}"] < 1e-3
        assert found[f"validation_{name}_constant"] > 0.02
    assert found["validation_RRA@15"] == found["validation_RTA@15"] == 1.0
    # On an arc the turn between photos is their angle, and 60 degrees have the other 60 off ahead.
    cameras = [rooms.camera(angle) for angle in (0.0, np.pi / 3)]
    constant = constant_scores(cameras)
    assert constant["rotation"] == pytest.approx(60.0, abs=0.5)
    assert constant["translation"] == pytest.approx(60.0, abs=5.0)
    assert constant["RRA@15"] == constant["RTA@15"] == 0.0


# ---- what is drawn -----------------------------------------------------------------------------


def test_draws_depend_on_seed_and_step_and_leave_validation_alone(captures):
    training = replace(SMALL, captures=1000, validation=7, batch=5)
    source = CaptureSource(training, captures, 1)
    drawn = np.array([source.drawn(step) for step in range(300)])
    assert drawn.min() >= 7
    assert drawn.max() < 1007
    assert len(np.unique(drawn)) > 600
    assert CaptureSource(training, captures, 1).drawn(42) == source.drawn(42)
    assert CaptureSource(replace(training, seed=1), captures, 1).drawn(42) != source.drawn(42)
    assert 0.1 < np.mean([source.shown(step) for step in range(300)]) < 0.3


def test_passes_of_a_step_are_the_same_whatever_was_read_before(captures):
    with CaptureSource(SMALL, captures, 1).open() as source:
        in_order = [source.batch(step) for step in range(3)][2]
    with CaptureSource(SMALL, captures, 1).open() as source:
        alone = source.batch(2)
    for one, other in zip(in_order, alone, strict=True):
        assert torch.equal(one.pixels, other.pixels)
        assert torch.equal(one.viewmats, other.viewmats)
        assert 2 <= len(one.pixels) <= 3


def test_captures_are_made_when_they_are_drawn(tmp_path):
    training = PoseTraining(
        steps=1, batch=1, photos=2, resolution=28, captures=1, validation=1, views=2, seed=3
    )
    told = []
    train(tmp_path, training, captured=lambda *counts: told.append(counts))
    assert told == [(1, 1)]
    assert {path.name for path in (tmp_path / "captures").iterdir()} == {
        "scene_00000",
        "scene_00001",
    }
    with pytest.raises(IgsrError, match="was made with views 2, not 3"):
        train(tmp_path / "other", replace(training, views=3), captures=tmp_path / "captures")


# ---- what is kept ------------------------------------------------------------------------------


def test_a_training_logs_and_validates(trained):
    out, _ = trained
    rows = logged(out)
    assert [row["step"] for row in rows] == [0, 2, 4]
    assert "loss" not in rows[0]
    for row in rows:
        assert row["validation_rotation_constant"] == rows[0]["validation_rotation_constant"]
    assert rows[-1]["loss"] < rows[1]["loss"]
    parts = sum(rows[1][name] for name in ("depth", "rays", "points", "camera", "slopes"))
    assert rows[1]["loss"] == pytest.approx(parts, rel=1e-5)


def test_what_was_trained_places_photos_at_its_own_resolution(trained):
    out, network = trained
    loaded = load_network(out, "cpu")
    assert loaded.config.resolution == 28
    for key, value in network.state_dict().items():
        assert torch.equal(loaded.state_dict()[key], value), key
    views = pose_trainings.views(3, 0, 112, 84)
    found = Da3(checkpoint=out, bundle_adjustment=False)(
        [Photo(view.name, view.image) for view in views]
    )
    assert all(camera is not None for camera in found.cameras)
    assert [depth.shape for depth in found.depths] == [(28, 28)] * 3  # 21 rows become 28
    assert found.weights["name"] == "igsr-tiny"
    assert found.weights["licence"].startswith("trained by igsr")
    assert any("says how far off it is on captures that it never saw" in w for w in found.warnings)
    # A lone file is still known, at the resolution of the published ones.
    lone = out.parent / "lone.safetensors"
    lone.write_bytes((out / "model.safetensors").read_bytes())
    assert load_network(lone, "cpu").config == SIZES["igsr-tiny"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"resolution": 30}, r"config\.json: its resolution is 30; give a multiple of 14 from"),
        ({"resolution": "28"}, r"its resolution is '28'; give a multiple"),
        ({"resolution": 14_000}, r"its resolution is 14000; give a multiple"),
        ({"model_name": "da3-small"}, r"its net\.name is 'igsr-tiny' where that of da3-small"),
        ({"model_name": "igsr-huge"}, r"its model_name is 'igsr-huge' where"),
    ],
)
def test_a_wrong_config_is_refused_by_name(trained, tmp_path, change, message):
    out, _ = trained
    content = json.loads((out / "config.json").read_text()) | change
    (tmp_path / "config.json").write_text(json.dumps(content))
    (tmp_path / "model.safetensors").write_bytes((out / "model.safetensors").read_bytes())
    with pytest.raises(IgsrError, match=message):
        load_network(tmp_path, "cpu")


def test_a_training_that_was_stopped_ends_with_the_same_bits(trained, captures, tmp_path):
    _, network = trained

    class Stop(Exception):
        pass

    def stop(now):
        if now.step == 3:
            raise Stop

    options = {"captures": captures, "checkpoint_every": 2}
    with pytest.raises(Stop):
        train(tmp_path, SMALL, progress=stop, log_every=1, **options)
    assert not (tmp_path / "model.safetensors").exists()
    with pytest.raises(IgsrError, match="is of an earlier training; go on with it by --resume"):
        train(tmp_path, SMALL, **options)
    resumed = train(tmp_path, SMALL, resume=True, log_every=2, **options)
    for key, value in network.state_dict().items():
        assert torch.equal(resumed.state_dict()[key], value), key
    assert [row["step"] for row in logged(tmp_path)] == [0, 1, 2, 4]

    with pytest.raises(IgsrError, match="is of a training with other data or settings"):
        train(tmp_path, replace(SMALL, rate=1e-4), resume=True, **options)
    data = (tmp_path / CHECKPOINT).read_bytes()
    (tmp_path / CHECKPOINT).write_bytes(data[:999])
    with pytest.raises(IgsrError, match="is no whole checkpoint; delete it"):
        train(tmp_path, SMALL, resume=True, **options)


# ---- the command -------------------------------------------------------------------------------


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_command_trains_and_repeats_what_a_config_says(trained, captures, tmp_path):
    out, network = trained
    folder = ("--captures-in", captures, "--jobs", 1)
    again = run("weights", "train", "--out", tmp_path, "--config", out / "config.json", *folder)
    assert again.exit_code == 0, again.output
    assert "turns between photos off by" in again.stdout
    assert (tmp_path / "loss.png").read_bytes().startswith(b"\x89PNG")
    loaded = load_network(tmp_path, "cpu").state_dict()
    assert all(torch.equal(loaded[key], value) for key, value in network.state_dict().items())
    resumed = run(
        "weights", "train", "--out", tmp_path, "--config", out / "config.json", *folder, "--resume",
        "--json",
    )  # fmt: skip
    assert resumed.exit_code == 0, resumed.output
    assert json.loads(resumed.stdout)["step"] == SMALL.steps


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--resolution", 50), "resolution is 50; give a multiple of 14"),
        (("--resolution", 14), "resolution is 14; give at least 28"),
        (("--photos", 1), "photos must be from 2 to 64, not 1"),
        (("--spp", 5), "spp must be a square"),
        (("--jobs", 0), "jobs is 0; give a whole number of at least 1"),
        (("--device", "cuda:93"), "device 'cuda:93' cannot be used"),
        (("--device", "gpu"), "device 'gpu' cannot be used"),
        (("--log-every", 0), "must be at least 1"),
        (("--rate", "nan"), "rate must be a number from"),
    ],
)
def test_options_that_cannot_be_used_are_told_in_a_sentence(tmp_path, options, message):
    told = run("weights", "train", "--out", tmp_path / "out", *options)
    assert told.exit_code == 1
    assert message in " ".join(told.stderr.split())
    assert len(told.stderr.split(". ")) == 1
    assert not (tmp_path / "out" / "captures").exists()


def test_a_settings_file_that_is_none_is_told_in_a_sentence(tmp_path):
    for content, message in (
        ("{", "is no JSON file of options"),
        ('{"rates": 1}', "there is no option 'rates' here"),
        ('{"steps": "many"}', "steps must be"),
        ('{"settings": {"resolution": 13}}', "resolution is 13; give a multiple of 14"),
    ):
        (tmp_path / "own.json").write_text(content)
        told = run("weights", "train", "--out", tmp_path / "out", "--config", tmp_path / "own.json")
        assert told.exit_code != 0
        assert message in " ".join(told.stderr.split())
    assert not (tmp_path / "out").exists()


def test_a_loss_that_is_not_finite_ends_the_training(captures, tmp_path, monkeypatch):
    monkeypatch.setattr(
        train_network.Learner,
        "learn",
        lambda self, *_: setattr(self, "step", 1) or {"loss": np.nan},
    )
    with pytest.raises(
        IgsrError, match="the loss is not finite at step 1; train with a lower rate"
    ):
        train(tmp_path, SMALL, captures=captures)


def test_mistakes_of_the_command_are_told_before_anything_is_made(tmp_path, igsr_here):
    out = tmp_path / "none"
    refused = igsr_here("weights", "train", "--out", out, "--resume")
    assert refused.returncode == 1
    assert f"{out} has no checkpoint to go on from; leave out --resume." in said(refused)
    refused = igsr_here("weights", "train", "--out", out, "--photos", "20", "--views", "16")
    assert refused.returncode == 1
    assert "photos is 20, but a capture has 16 (views)" in said(refused)
    assert not out.exists()


def said(done):
    return " ".join(done.stderr.split())
