"""``igsr refine``."""

import json
import re

import pytest
import scenes

import igsr
from igsr.cameras import registry
from igsr.denoiser import save_network
from igsr.denoiser.network import Architecture, DenoiserNetwork


def test_refine_writes_its_folder_and_resumes(few_photos, tmp_path, igsr_here):
    photos, out, weights = tmp_path / "ball", tmp_path / "out", tmp_path / "a.safetensors"
    scenes.write_capture(photos, few_photos)
    save_network(DenoiserNetwork(Architecture(4, (0, 0, 0))), weights, {})
    options = ["--steps", 60, "--rounds", 1, "--denoiser", weights, "--backend", "cpu"]
    stale, own = out / "rounds/7/scene.ply", out / "rounds/8/notes.txt"
    for path in (stale, own):
        path.parent.mkdir(parents=True)
        path.write_text("of an earlier run")
    done = igsr_here("refine", photos, "--out", out, *options)
    assert done.returncode == 0, done.stderr
    assert not stale.parent.exists()
    assert own.exists()
    assert re.search(r"^Rounds: [01]; stopped: \w", done.stdout, re.MULTILINE)
    for name in ("report.html", "scene.html"):
        assert (out / name).is_file()
        assert name in done.stdout
    report = json.loads((out / "report.json").read_text())
    resumed = igsr_here("refine", photos, "--out", out, *options, "--resume", "--json")
    summary = json.loads(resumed.stdout)
    assert summary["rounds"] == len(report["rounds"]) - 1
    assert summary["stopped"] == report["stopped"] != ""
    assert summary["splats"] == len(igsr.Splats.load(out / "scene.ply"))
    next(photos.rglob("*.png")).unlink()
    missing = igsr_here("refine", photos, "--out", tmp_path / "other", *options)
    assert missing.returncode == 1
    assert len(missing.stderr.splitlines()) == 1
    assert ".png" in missing.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rounds", "some"], "rounds must be a whole number or \"auto\", not 'some'."),
        (["--rounds", "-1"], "rounds must not be negative, not -1."),
        (["--steps", "0"], "steps must be from 1 to 10000000, not 0."),
    ],
)
def test_settings_are_checked_before_cameras_are_sought(
    few_photos, tmp_path, igsr_here, monkeypatch, options, message
):
    photos = scenes.write_capture(tmp_path / "ball", few_photos) / "photos"
    sought = registry.Entry(lambda: pytest.fail("cameras were sought"), lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, sought)
    bad = igsr_here("refine", photos, "--out", tmp_path / "out", *options)
    assert (bad.returncode, bad.stderr) == (1, message + "\n")
    assert igsr_here("refine", photos, "--out", "out", "--backend", "reference").returncode == 2
    assert not (tmp_path / "out").exists()
