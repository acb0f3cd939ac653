"""Fits in blocks: one scene, with the same bits if parts of the run are lost and repeated."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scenes
from ray_stand_in import stand_in_ray

import igsr
from igsr._internal.worker_processes import WorkerLostError
from igsr.blocks import BlockOptions, fit_in_blocks, plan, run, runner, seams, tasks, worker
from igsr.blocks.tasks import load_splats, save_splats
from igsr.fitting import fit_capture
from igsr.geometry.frame import Frame
from igsr.splats import joined, subset
from igsr_lab.large_scenes import towns

SETTINGS = {"steps": 160, "max_splats": 1200}
#: Also reduces photos of 48 pixels for the coarse fit, and finds a seam between two houses.
SMALL = "from igsr.blocks import plan, tasks; "
SMALL += "tasks.MIN_COARSE_SIDE_PX = 12; plan.MIN_SEAM_VISIBILITY = 0.01"


@pytest.fixture(autouse=True, scope="module")
def small_scenes():
    usual = tasks.MIN_COARSE_SIDE_PX, plan.MIN_SEAM_VISIBILITY
    exec(SMALL)
    yield
    tasks.MIN_COARSE_SIDE_PX, plan.MIN_SEAM_VISIBILITY = usual


def options(**changed):
    return replace(BlockOptions(blocks=2, holdout=6, settings=SETTINGS), **changed)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    capture = towns.town(2, 1, 8, 48, 36, points=150, sharp=1)
    return towns.written(capture, tmp_path_factory.mktemp("town") / "capture")


@pytest.fixture(scope="module")
def whole(folder, tmp_path_factory):
    """A run that is not interrupted."""
    out, seen = tmp_path_factory.mktemp("whole"), []
    return *fit_in_blocks(folder, out, options(), seen.append), out, seen


def test_a_scene_in_blocks_is_one_scene(whole, folder):
    splats, report, out, seen = whole
    assert igsr.Splats.load(out / "scene.ply") == splats
    assert json.loads((out / "report.json").read_text()) == report
    of_blocks = sum(block["splats"] for block in report["blocks"])
    assert len(splats) == report["splats"] == of_blocks + report["background_splats"]
    assert [block["name"] for block in report["blocks"]] == ["block-000", "block-001"]
    # Each block has its own process and photos, and keeps only splats in its cell.
    assert len({block["process"] for block in report["blocks"]} | {os.getpid()}) == 3
    for block in report["blocks"]:
        assert 0 < block["photos"] < 16
        assert 0 < block["splats"] <= block["fitted_splats"]
        assert block["frozen_splats"] > 0
        assert block["attempts"] == 1
    assert report["protocol"]["views"] == 3
    capture = igsr.load_capture(folder).with_holdout(6)
    coarse = igsr.evaluate(load_splats(out / "blocks/coarse/splats.npz"), capture, "train")
    assert igsr.evaluate(splats, capture, "train").psnr > coarse.psnr + 1.5
    assert report["seams"]["photos"] > 0
    assert [event.stage for event in (seen[0], seen[-1])] == ["coarse fit", "fit blocks"]
    assert seen[-1].values == {"block-000": 1.0, "block-001": 1.0}
    assert seen[-1].done == seen[-1].total == 2
    assert not list((out / "blocks").rglob("checkpoint.npz"))
    page = (out / "report.html").read_text()
    across = [view["name"] for view in report["views"] if view["across"]]
    shown = across or [view["name"] for view in report["views"]]
    assert page.count("<figure>") == 3 * len(shown)
    assert all(block["name"] in page for block in report["blocks"])
    assert all(name in page for name in shown)


def test_finished_tasks_are_not_repeated(whole, folder, monkeypatch):
    splats, _, out, _ = whole
    monkeypatch.setattr(runner, "in_a_process", lambda *_: pytest.fail("a task was repeated"))
    again, _ = fit_in_blocks(folder, out, options())
    assert again == splats


def test_a_lost_block_is_repeated_with_the_same_bits(whole, folder, tmp_path):
    splats, report, out, _ = whole
    copy = tmp_path / "copy"
    shutil.copytree(out, copy)
    (copy / "blocks/block-001/splats.npz").unlink()
    # Checkpoints of other fits are not used.
    checkpoint = copy / "blocks/block-001/checkpoint.npz"
    fit_capture(igsr.load_capture(folder), steps=2, backend="cpu", checkpoint=checkpoint)
    again, other = fit_in_blocks(folder, copy, options())
    assert again == splats
    assert other["blocks"][0]["process"] == report["blocks"][0]["process"]
    assert other["blocks"][1]["process"] != report["blocks"][1]["process"]


def test_blocks_over_ray_have_the_same_bits(whole, folder, tmp_path, monkeypatch):
    ray = stand_in_ray(monkeypatch)
    splats, _ = fit_in_blocks(folder, tmp_path, options(ray="auto"))
    assert splats == whole[0]
    assert not ray.running
    assert ray.addresses == ["auto", "auto"]
    # A machine with other instructions may give other bits.
    for path in (tmp_path / "blocks").glob("block-*.json"):
        row = json.loads(path.read_text())
        path.write_text(json.dumps({**row, "host": "far", "instruction_set": "other"}))
    with pytest.warns(UserWarning, match=r"^far: the instruction set is not .* other bits"):
        fit_in_blocks(folder, tmp_path, options())


def test_an_exception_of_the_listener_ends_the_run(folder, tmp_path):
    def stop(event):
        if event.stage == "coarse fit" and event.done == 1:
            raise scenes.Stop

    with pytest.raises(scenes.Stop):
        fit_in_blocks(folder, tmp_path, options(), stop)
    assert (tmp_path / "blocks/coarse.json").is_file()
    assert not (tmp_path / "blocks/block-000").exists()


def command(folder, out):
    words = f"fit {folder} --out {out} --blocks 2 --holdout 6 --backend cpu --quality normal"
    words += " --steps {steps} --max-splats {max_splats} --json".format(**SETTINGS)
    return [sys.executable, "-c", f"{SMALL}; from igsr.cli import main; main()", *words.split()]


def test_a_killed_run_is_continued_with_the_same_bits(whole, folder, tmp_path):
    out = tmp_path / "out"
    process = subprocess.Popen(command(folder, out), stdout=subprocess.DEVNULL)
    deadline = time.monotonic() + 120.0
    while not (out / "blocks/block-001/progress.json").is_file():
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.02)
    worker_id = json.loads((out / "blocks/block-001/progress.json").read_text())["process"]
    process.send_signal(signal.SIGKILL)
    process.wait()
    while Path(f"/proc/{worker_id}/stat").exists() and not _is_zombie(worker_id):
        assert time.monotonic() < deadline, "the worker outlived its driver"
        time.sleep(0.02)
    assert (out / "blocks/block-000.json").is_file()
    assert not (out / "scene.ply").exists()
    first = json.loads((out / "blocks/block-000.json").read_text())["process"]
    done = subprocess.run(command(folder, out), capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    assert report["blocks"][0]["process"] == first
    assert report["blocks"][1]["attempts"] == 2
    assert igsr.Splats.load(out / "scene.ply") == whole[0]


def _is_zombie(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
    except OSError:
        return True


def lose_tasks(monkeypatch, times, error):
    """Let the first tries of the second block end with an error."""
    left = [times]

    def work(run_task, task):
        if task.name == "block-001" and left[0]:
            left[0] -= 1
            raise error
        return run_task(task)

    monkeypatch.setattr(runner, "in_a_process", work)


def test_a_lost_worker_is_started_again(whole, folder, tmp_path, monkeypatch):
    lose_tasks(monkeypatch, 1, WorkerLostError("A process ended without a result."))
    with pytest.warns(UserWarning, match="block-001 was lost and is started again"):
        splats, report = fit_in_blocks(folder, tmp_path, options())
    assert splats == whole[0]
    assert report["blocks"][1]["splats_part"] == 1.0


def test_a_worker_out_of_memory_gets_fewer_splats(folder, tmp_path, monkeypatch):
    lose_tasks(monkeypatch, 2, MemoryError())
    with pytest.warns(UserWarning, match=r"again with 0\.25 of the splats"):
        _, report = fit_in_blocks(folder, tmp_path, options())
    more, fewer = report["blocks"]
    assert (more["splats_part"], fewer["splats_part"]) == (1.0, 0.25)
    assert fewer["fitted_splats"] <= fewer["max_splats"] < more["max_splats"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_block_that_never_fits_is_named(folder, tmp_path, monkeypatch):
    lose_tasks(monkeypatch, 99, MemoryError())
    with pytest.raises(igsr.IgsrError, match=r"block-001 \(\d+ photos\) ran out of memory.*--max"):
        fit_in_blocks(folder, tmp_path, options())
    assert (tmp_path / "blocks/block-000.json").is_file(), "the other block is kept"


def test_changed_photos_and_full_disks_are_named(folder, tmp_path, monkeypatch):
    def changed(run_task, task):
        return run_task(replace(task, marks=["0" * 64] * len(task.marks)))

    def full(path, splats):
        save_splats(Path("/dev/full/splats.npz"), splats)

    monkeypatch.setattr(worker, "save_splats", full)
    for work, message in (
        (changed, r"0001\.png was changed since the run began"),
        (lambda run_task, task: run_task(task), r"^coarse on .*: Cannot write /dev/full"),
    ):
        monkeypatch.setattr(runner, "in_a_process", work)
        with pytest.raises(igsr.IgsrError, match=message):
            fit_in_blocks(folder, tmp_path, options())


def test_a_cell_without_photos_stays_coarse(folder, tmp_path, monkeypatch):
    plan_blocks = run.plan_blocks

    def without(*arguments):
        plan = plan_blocks(*arguments)
        plan.photos[:, 0] = False
        return plan

    monkeypatch.setattr(run, "plan_blocks", without)
    with pytest.warns(UserWarning, match="block-000 has no photos; it keeps the splats of"):
        splats, report = fit_in_blocks(folder, tmp_path, options())
    first, second = report["blocks"]
    assert (first["fitted"], second["fitted"]) == (False, True)
    assert len(splats) > second["splats"]


def test_a_capture_without_points_is_fitted(folder, tmp_path):
    capture = igsr.load_capture(folder)
    capture.points = None
    bare = towns.written(capture, tmp_path / "bare")
    _, report = fit_in_blocks(bare, tmp_path / "out", options())
    assert report["coarse"]["start"] != "points"
    assert all(block["fitted"] for block in report["blocks"])


def test_bad_options_and_photos_without_cameras_are_refused(folder, tmp_path, igsr_here):
    for changed, message in (
        ({"blocks": 0}, "blocks must be auto or a number of at least 1, not 0"),
        ({"blocks": 99}, "99 blocks need at least as many photos to fit, not 13"),
        ({"settings": {"poses": "joint"}}, "leave poses out"),
        ({"holdout": 1}, "holdout is 1"),
    ):
        with pytest.raises(igsr.IgsrError, match=message):
            fit_in_blocks(folder, tmp_path / "out", options(**changed))
    shutil.copytree(folder / "images", tmp_path / "photos")
    with pytest.raises(igsr.IgsrError, match="no cameras"):
        fit_in_blocks(tmp_path / "photos", tmp_path / "out", options())
    assert not (tmp_path / "out/blocks").exists()
    refused = igsr_here("fit", folder, "--out", tmp_path / "out", "--blocks", "two")
    assert refused.returncode == 1
    assert "--blocks must be auto or a whole number" in refused.stderr


@pytest.fixture(scope="module")
def halves(folder):
    """A capture, and the splats of a short fit in two parts."""
    capture = igsr.load_capture(folder)
    splats = scenes.fit(capture, steps=40, max_splats=500, backend="cpu")
    middle = len(splats) // 2
    return capture, subset(splats, slice(middle)), subset(splats, slice(middle, None))


def test_frozen_splats_do_not_change(halves, tmp_path):
    capture, start, frozen = halves
    path = tmp_path / "checkpoint.npz"
    options = {"steps": 40, "max_splats": 900, "backend": "cpu", "whole_schedule": True}
    fitted = scenes.fit(capture, start=start, frozen=frozen, checkpoint=path, **options)
    means = np.load(path)["means"]
    frame = Frame.of_capture(capture)
    assert np.array_equal(means[-len(frozen) :], frame.splats(frozen).means)
    assert not np.array_equal(means[:5], frame.splats(start).means[:5])
    assert len(fitted) <= len(means) - len(frozen)
    before, after = (igsr.evaluate(s, capture, "train") for s in (start, joined([fitted, frozen])))
    assert after.psnr > before.psnr


def test_bad_frozen_splats_are_named(halves):
    capture, start, frozen = halves
    given = {"steps": 5, "backend": "cpu", "frozen": frozen}
    with pytest.raises(igsr.IgsrError, match="frozen needs start"):
        scenes.fit(capture, **given)
    for change, message in (
        ({"sh": np.zeros((len(frozen), 1, 3), np.float32)}, "frozen has SH degree 0 and"),
        ({"origin": np.ones(3)}, "frozen and start have different origins"),
        ({"antialiased": True}, "frozen has antialiased splats"),
    ):
        given["frozen"] = replace(frozen, **change)
        with pytest.raises(igsr.IgsrError, match=message):
            scenes.fit(capture, start=start, **given)


def test_visible_seams_are_fitted_again(tmp_path, monkeypatch):
    # The border cuts through one house.
    capture = towns.town(1, 1, 16, 48, 36, points=200, sharp=1)
    folder, out = towns.written(capture, tmp_path / "house"), tmp_path / "out"
    monkeypatch.setattr(seams, "VISIBLE_LOSS_DB", 100.0)
    splats, report = fit_in_blocks(folder, out, options(holdout=None))
    assert report["seams"]["photos"] > 4
    assert "before_seam_fit" not in report["seams"]
    monkeypatch.setattr(seams, "VISIBLE_LOSS_DB", -100.0)
    again, refitted = fit_in_blocks(folder, out, options(holdout=None))
    before = refitted["seams"]["before_seam_fit"]
    assert before["psnr_joined"] == report["seams"]["psnr_joined"]
    assert refitted["seams"]["psnr_joined"] > before["psnr_joined"]
    assert len(again) == len(splats)
    same = (again.means[:, None] == splats.means[None]).all(axis=2).any(axis=0)
    assert 0 < same.sum() < len(splats), "only splats near seams move"
