"""Fits learn, repeat and resume with the same bits, and refuse bad arguments and checkpoints."""

from __future__ import annotations

import dataclasses
import io
import json
import multiprocessing
import os
import signal
import struct
import zipfile
from dataclasses import replace
from unittest.mock import DEFAULT, Mock

import numpy as np
import pytest
import scenes
from capture_files import assert_refused
from made_up_tracks import tracked

import igsr
from igsr.evaluation import metrics
from igsr.fitting import checkpoint as checkpoints
from igsr.fitting import fit_capture, train
from igsr.fitting.checkpoint import load_checkpoint, save_checkpoint
from igsr.fitting.fingerprint import fingerprint
from igsr.fitting.settings import FitSettings
from igsr.rendering.renders import render

STEPS = 420  # density control runs every 25 steps from 75 on
OPTIONS = {"steps": STEPS, "backend": "cpu", "max_splats": 400, "sh_degree": 1, "backdrop": False}
SHORT = OPTIONS | {"steps": 20}
LEFT = np.tile(np.arange(40) < 30, (40, 1))  # a mask


@pytest.fixture(scope="module")
def capture():
    return scenes.capture(views=8, size=40)


@pytest.fixture(scope="module")
def whole(capture):
    """The splats of a fit that is not interrupted."""
    return fit(capture)


@pytest.fixture
def single_steps(monkeypatch):
    """Fits report each step, so listeners can end them at any step."""
    monkeypatch.setattr(train, "CHUNK_SECONDS", 0.0)


def fit(capture, **options):
    return scenes.fit(capture, **{**OPTIONS, **options})


def with_views(capture, **changes):
    return igsr.Capture(capture.path, [replace(view, **changes) for view in capture.views])


def psnr(splats, capture, split="test"):
    return igsr.evaluate(splats, capture, split, backend="cpu").psnr


@pytest.mark.parametrize("density", ["mcmc", "original", "fixed"])
def test_fit_learns_the_scene(capture, density):
    losses = []
    splats = fit(capture, density=density, report=lambda now: losses.append(now.values["loss"]))
    assert len(splats) <= 400
    assert np.mean(losses[-3:]) < 0.5 * np.mean(losses[:3])
    black = [metrics.psnr(np.zeros_like(v.image), v.image) for v in capture.test_views]
    assert psnr(splats, capture) > np.mean(black) + 5


def test_fit_repeats_bit_for_bit(capture, whole):
    assert fit(capture) == whole
    assert fit(capture, seed=1) != whole


# Rounding decides nothing before density control runs, or while the number of splats is fixed.
@pytest.mark.parametrize("options", [{"steps": 75}, {"steps": 200, "density": "fixed"}])
def test_cpu_and_gpu_fit_alike(capture, options):
    cpu, gpu = (psnr(fit(capture, backend=name, **options), capture) for name in ("cpu", "gpu"))
    assert cpu == pytest.approx(gpu, abs=0.1)


def test_cpu_and_gpu_fit_alike_from_coarse_to_fine():
    photos = scenes.capture(views=6, size=200)
    options = {"steps": 60, "max_splats": 300, "start": "random", "density": "fixed", "dropout": 0}
    cpu, gpu, fine = (
        scenes.fit(photos, backend=backend, coarse_to_fine=coarse, **options)
        for backend, coarse in (("cpu", True), ("gpu", True), ("cpu", False))
    )
    assert psnr(gpu, photos, "train") == pytest.approx(psnr(cpu, photos, "train"), abs=0.05)
    assert fine != cpu


# On the GPU this is also the test that fits repeat: software Vulkan takes 50 ms per step.
@pytest.mark.parametrize(
    ("backend", "stop", "steps"),
    [("cpu", 1, STEPS), ("cpu", 137, STEPS), ("cpu", STEPS, STEPS), ("gpu", 290, 310)],
)
@pytest.mark.usefixtures("single_steps")
def test_a_stopped_fit_resumes_with_the_same_bits(capture, tmp_path, backend, stop, steps):
    path, part = tmp_path / "whole.npz", tmp_path / "part.npz"
    options = OPTIONS | {"steps": steps, "backend": backend}
    whole = fit_capture(capture, checkpoint=path, **options)
    with pytest.raises(scenes.Stop):
        fit_capture(capture, checkpoint=part, report=scenes.stop_at(stop), **options)
    assert load_checkpoint(part)[0]["step"] == [stop]
    resumed = fit_capture(capture, checkpoint=part, resume=True, **options)
    assert resumed.splats == whole.splats
    assert (resumed.steps, resumed.started) == (steps, whole.started)
    ours, theirs = load_checkpoint(part)[0], load_checkpoint(path)[0]
    assert ours.keys() == theirs.keys()
    for name in ours:
        assert np.array_equal(ours[name], theirs[name]), name


@pytest.fixture(scope="module")
def measured(capture):
    """The capture with depths, and points with tracks."""
    scene = scenes.splats()
    depths = [render(scene, view.camera, backend="cpu").expected_depth for view in capture.views]
    views = [replace(v, depth=depth) for v, depth in zip(capture.views, depths, strict=True)]
    return igsr.Capture(capture.path, views, tracked(views, scene.means.astype(np.float64)))


@pytest.mark.parametrize(
    "options",
    [
        {"dropout": 0.2},
        {"exposure": "on"},
        {"depth_weight": 2.0, "start": "rays"},
        {"poses": "joint", "focal": "per-camera"},
        {"poses": "joint", "focal": "shared", "start": "random"},
    ],
)
def test_all_state_is_in_the_checkpoint(measured, tmp_path, options):
    options = OPTIONS | {"steps": 120} | options
    whole = fit_capture(measured, **options)
    resumed = scenes.resumed_fit(measured, tmp_path / "checkpoint.npz", 50, **options)
    assert resumed.splats == whole.splats
    assert resumed.capture == whole.capture
    assert fit(measured, steps=120) != whole.splats


@pytest.mark.parametrize("place", ["listener", "loop"])
@pytest.mark.usefixtures("single_steps")
def test_a_fit_that_ctrl_c_ends_resumes_with_the_same_bits(
    capture, whole, tmp_path, monkeypatch, place
):
    path, fit_event = tmp_path / "checkpoint.npz", train.fit_event

    def interrupt(event):
        if event.done == 50 and place == "listener":
            raise KeyboardInterrupt

    def interrupted(step, *arguments, **named):
        if step == 50:
            raise KeyboardInterrupt
        return fit_event(step, *arguments, **named)

    if place == "loop":
        monkeypatch.setattr(train, "fit_event", interrupted)
    with pytest.raises(KeyboardInterrupt):
        fit(capture, checkpoint=path, report=interrupt)
    assert load_checkpoint(path)[0]["step"] == [50]
    monkeypatch.undo()
    assert fit(capture, checkpoint=path, resume=True) == whole


def fit_until_killed(checkpoint, moment):
    """Run a fit that ends itself as kill -9 does, after its first checkpoint."""
    train.CHECKPOINT_STEPS, train.CHUNK_SECONDS, savez = 20, 0.0, np.savez

    def save_half(file, **arrays):
        if checkpoint.exists():
            file.write(b"half of a checkpoint")
            os.kill(os.getpid(), signal.SIGKILL)
        savez(file, **arrays)

    def kill(now):
        if now.done == 50:
            os.kill(os.getpid(), signal.SIGKILL)

    if moment == "while it saves":
        np.savez = save_half
    fit(scenes.capture(views=8, size=40), checkpoint=checkpoint, report=kill)


@pytest.mark.parametrize(("moment", "saved"), [("between saves", 40), ("while it saves", 20)])
def test_a_killed_fit_resumes_with_the_same_bits(capture, whole, tmp_path, moment, saved):
    path = tmp_path / "checkpoint.npz"
    spawn = multiprocessing.get_context("spawn")
    process = spawn.Process(target=fit_until_killed, args=(path, moment))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    assert load_checkpoint(path)[0]["step"] == [saved]
    assert fit(capture, checkpoint=path, resume=True) == whole


def test_masked_pixels_do_not_reach_the_fit(capture):
    def spoiled(value, used=LEFT):
        images = [np.where(LEFT[..., None], v.image, np.uint8(value)) for v in capture.views]
        pairs = zip(capture.views, images, strict=True)
        return igsr.Capture(capture.path, [replace(v, image=i, mask=used) for v, i in pairs])

    # A photo's surroundings reach the fit through SSIM's window only.
    options = {"steps": 30, "density": "fixed", "remove_floaters": False}
    black, white = (fit(spoiled(value), **options) for value in (0, 255))
    unmasked = fit(spoiled(255, None), **options)
    changes = [np.abs(black.means - other.means).max() for other in (white, unmasked)]
    assert changes[0] < 0.2 * changes[1]


def test_masks_of_any_true_byte_are_equal(capture):
    bytes_255 = (LEFT.view(np.uint8) * np.uint8(255)).view(bool)
    ones, others = (fit(with_views(capture, mask=m), steps=20) for m in (LEFT, bytes_255))
    assert ones == others


def test_pseudo_views_are_compared_over_their_own_background(capture):
    green = (0.2, 0.9, 0.1)

    def pseudo(color):
        views = [scenes.pseudo_view(view, background=color) for view in capture.views]
        return igsr.Capture(capture.path, views)

    expected = fit(pseudo(None), steps=20, background=green)
    assert fit(pseudo(green), steps=20) == expected
    assert fit(pseudo(green), steps=20, background=(0.0, 0.0, 1.0)) == expected
    assert fit(pseudo(None), steps=20) != expected
    assert fingerprint(pseudo(None).train_views) != fingerprint(pseudo(green).train_views)


def test_splats_start_at_points_however_far_away(capture):
    random = np.random.default_rng(0)
    far = np.array([1e6, 0.0, 0.0])
    xyz = random.normal(scale=0.3, size=(500, 3))
    rgb = random.integers(0, 256, size=(500, 3), dtype=np.uint8)
    scores = []
    for shift in (np.zeros(3), far):
        views = []
        for view in capture.views:
            viewmat = view.camera.viewmat.copy()
            viewmat[:3, 3] -= viewmat[:3, :3] @ shift
            views.append(replace(view, camera=replace(view.camera, viewmat=viewmat)))
        moved = igsr.Capture(capture.path, views, igsr.Points(xyz + shift, rgb))
        splats = fit(moved, density="fixed", remove_floaters=False)
        assert len(splats) == 400  # the maximum
        assert np.linalg.norm(splats.origin - shift) < 1
        scores.append(psnr(splats, moved))
    # float32 alone could not place a splat to 1/16 unit at a million units.
    assert scores[0] == pytest.approx(scores[1], abs=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resume": True}, "resume needs out"),
        ({"steps": 0}, "steps must be from 1"),
        ({"steps": 2.5}, "steps must be a whole number"),
        ({"seed": -1}, "seed must be from 0"),
        ({"sh_degree": 5}, "sh_degree must be from 0 to 4"),
        ({"max_splats": 0}, "max_splats must be from 1"),
        ({"density": "magic"}, "density must be one of"),
        ({"poses": "free"}, "poses must be one of"),
        ({"focal": 3}, "focal must be one of"),
        ({"start": "sphere"}, "start must be one of auto"),
        ({"start": "points"}, "made-up has fewer than 100 points to start from; use another"),
        ({"dropout": 0.95}, "dropout must be a number from 0 to 0.9"),
        ({"depth_weight": float("nan")}, "depth_weight must be a number from 0 to 100"),
        ({"backdrop": "yes"}, "backdrop must be True or False"),
        ({"backend": "reference"}, "reference renders but does not fit"),
        ({"backend": "abacus"}, "backend must be auto, cpu or gpu, not 'abacus'"),
        *(({"background": bad}, "background must be") for bad in ((2.0, 0.0, 0.0), 5, "red")),
    ],
)
def test_bad_settings_are_named(capture, options, message):
    assert_refused(message, igsr.fit, capture, **OPTIONS | options)


def test_unknown_settings_and_captures_that_cannot_be_fitted_are_named(capture):
    assert_refused("unknown setting preset", fit, capture, preset="3dgs")
    assert_refused(r"capture must be a Capture, not str; igsr\.load", fit, "photos")
    assert_refused("no train views", fit, with_views(capture, split="test"))


def test_fit_applies_every_setting(capture):
    settings = {"steps": 5, "seed": 3, "max_splats": 40, "sh_degree": 0, "learning_rate": 1.5}
    settings |= {"density": "fixed", "start": "random", "dropout": 0.25, "depth_weight": 0.5}
    settings |= {"poses": "joint", "focal": "shared", "exposure": "on", "transients": "off"}
    settings |= dict.fromkeys(("coarse_to_fine", "remove_floaters", "backdrop"), False)
    settings["background"] = (0.2, 0.3, 0.4)
    names = {field.name for field in dataclasses.fields(FitSettings)}
    assert settings.keys() == names - {"first_step"}
    result = igsr.fit(capture, backend="cpu", **settings)
    assert result.settings == FitSettings(**settings)


def test_a_checkpoint_that_cannot_be_written_is_found_before_the_fit(capture, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    events = []
    for path in (blocked / "checkpoint.npz", tmp_path):
        assert_refused("Cannot write", fit, capture, checkpoint=path, report=events.append)
    assert not events


def test_a_failure_of_the_last_checkpoint_keeps_the_splats(capture, tmp_path, monkeypatch):
    full = igsr.IgsrError("Cannot write checkpoint.npz: No space left on device.")
    monkeypatch.setattr(checkpoints, "save_checkpoint", Mock(side_effect=full))
    with pytest.warns(UserWarning, match="No space left"):
        splats = fit(capture, steps=20, checkpoint=tmp_path / "checkpoint.npz")
    assert splats == fit(capture, steps=20)


def test_ctrl_c_during_the_last_save_saves_again(capture, tmp_path, monkeypatch):
    # A mock calls the wrapped function if its side effect is DEFAULT.
    once = Mock(wraps=save_checkpoint, side_effect=[KeyboardInterrupt, *[DEFAULT] * 9])
    monkeypatch.setattr(checkpoints, "save_checkpoint", once)
    path = tmp_path / "checkpoint.npz"
    with pytest.raises(KeyboardInterrupt):
        fit(capture, steps=20, checkpoint=path)
    assert load_checkpoint(path)[0]["step"] == [20]


@pytest.fixture(scope="module")
def finished(capture, tmp_path_factory):
    """The checkpoint of a finished fit of 20 steps."""
    path = tmp_path_factory.mktemp("finished") / "checkpoint.npz"
    fit_capture(capture, checkpoint=path, **SHORT)
    return path


def test_resume_refuses_other_settings(capture, finished):
    others = {"seed": 3, "steps": 21, "density": "fixed", "learning_rate": 1.5}
    others |= {"exposure": "on", "transients": "off"}
    for name, value in others.items():
        options = SHORT | {"checkpoint": finished, "resume": True, name: value}
        assert_refused(f"was made with {name}", fit_capture, capture, **options)


@pytest.mark.parametrize("part", ["pixel", "depth", "tracks"])
def test_resume_refuses_other_photos(measured, tmp_path, part):
    options = SHORT | {"poses": "joint", "checkpoint": tmp_path / "checkpoint.npz"}
    fit_capture(measured, **options)
    view = measured.train_views[1]
    image, depth = view.image.copy(), view.depth * np.float32(1.01)
    image[0, 0] ^= 1
    changes = {"pixel": {"image": image}, "depth": {"depth": depth}, "tracks": {}}[part]
    views = [replace(v, **changes) if v is view else v for v in measured.views]
    changed = igsr.Capture(measured.path, views, None if part == "tracks" else measured.points)
    with pytest.raises(igsr.IgsrError, match="made from other photos, masks, cameras, tracks"):
        fit_capture(changed, resume=True, **options)


def test_resume_refuses_other_versions(capture, finished, tmp_path):
    state, settings = load_checkpoint(finished)
    path = tmp_path / "other.npz"
    for other, message in (
        ({"igsr": "0.0.9"}, r"was made with igsr '0\.0\.9', not"),
        ({"format": 1}, "it is not of format 2"),
    ):
        save_checkpoint(path, state, settings | other)
        assert_refused(message, fit_capture, capture, checkpoint=path, resume=True, **SHORT)
    with pytest.raises(igsr.IgsrError, match="no checkpoint"):
        fit_capture(capture, checkpoint=tmp_path / "none.npz", resume=True, **SHORT)


def bad_files(content):
    """Contents of damaged checkpoints."""
    directory = content.index(b"PK\x01\x02")
    # Version needed to extract; flags: encrypted; compression method.
    flips = ((directory + 6, 0xFF), (directory + 8, 0x01), (directory + 10, 0x63))
    flipped = [content[:at] + bytes([value]) + content[at + 1 :] for at, value in flips]
    pickled, compressed = io.BytesIO(), io.BytesIO()
    np.savez(pickled, means=np.array([{"a": "pickle"}], dtype=object))
    np.savez_compressed(compressed, means=np.zeros(1_000_000))
    truncated = [b"", b"not a zip", content[: len(content) // 2], content[:-30]]
    return [*truncated, *flipped, pickled.getvalue(), compressed.getvalue()]


def bad_states(state):
    """Arrays of damaged checkpoints."""
    return [
        {**state, "means": state["means"][:-1]},
        {**state, "first_sh": state["first_sh"].astype(np.float64)},
        {**state, "step": np.array([0], dtype=np.int64)},
        {**state, "origin": np.array([np.nan, 0, 0])},
        {name: array for name, array in state.items() if name != "second_quats"},
    ]


def test_damaged_checkpoints_are_refused(capture, finished, tmp_path):
    content, (state, settings) = finished.read_bytes(), load_checkpoint(finished)
    path = tmp_path / "bad.npz"

    def check_refused(message):
        assert_refused(message, fit_capture, capture, checkpoint=path, resume=True, **SHORT)

    for damaged in bad_files(content):
        path.write_bytes(damaged)
        check_refused("cannot be read")
    for arrays in bad_states(state):
        save_checkpoint(path, arrays, settings)
        check_refused("cannot be used")
    for seconds in ("abc", [1.0], None, float("inf"), 1):
        text = json.dumps({"format": 2, **settings, "seconds": seconds}).encode()
        np.savez(path, **state, settings=np.frombuffer(text, dtype=np.uint8))
        check_refused("seconds")
    for started in (None, "rays", ["rays"], ["rays", 1.5], [1, "rays"]):
        save_checkpoint(path, state, {**settings, "started": started})
        check_refused("started")
    assert finished.read_bytes() == content


def test_arrays_with_bad_headers_are_refused(tmp_path):
    path, unreadable = tmp_path / "bad.npz", "cannot be read"
    texts = ["{'descr': (", "{'shape': (0, 10**9)}", "\n  x\n y"]
    huge = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({2**40}, {2**20})}}\n"
    other_size = "another size than its header says"
    for header, message in ((huge, other_size), *((text, unreadable) for text in texts)):
        member = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("means.npy", member + b"\0" * 16)
        assert_refused(message, load_checkpoint, path)


@pytest.mark.parametrize("alpha", [False, True])
@pytest.mark.parametrize(("distance", "focal"), [(1e200, 60.0), (1e60, 60.0), (4.0, 1e-300)])
def test_extreme_cameras_are_refused(alpha, distance, focal):
    views = []
    for view in scenes.capture(views=4, size=16, alpha=alpha).train_views:
        viewmat = view.camera.viewmat.copy()
        viewmat[:3, 3] *= distance / 4.0
        K = np.array([[focal, 0.0, 8.0], [0.0, focal, 8.0], [0.0, 0.0, 1.0]])
        views.append(replace(view, camera=igsr.Camera(viewmat, K, 16, 16)))
    assert_refused("check its poses", fit, igsr.Capture("far", views), steps=3)
