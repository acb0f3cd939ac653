"""``igsr refine``."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import refinements
import scenes
from PIL import Image

import igsr
from igsr.pose import registry

pytestmark = pytest.mark.usefixtures("small_fits")


def test_the_command(ball_photos, tmp_path, igsr_here, monkeypatch):
    from igsr.denoiser import save_network
    from igsr.denoiser.network import Architecture, DenoiserNetwork

    scenes.write_capture(tmp_path / "ball", ball_photos)
    save_network(DenoiserNetwork(Architecture(4, (0, 0, 0))), tmp_path / "a.safetensors", {})
    command = ["refine", tmp_path / "ball", "--out", tmp_path / "out", "--steps", "60"]
    command += ["--weights", tmp_path / "a.safetensors", "--backend", "cpu", "--rounds", "1"]
    command += ["--photos", "5"]
    stale, own = tmp_path / "out/rounds/7/scene.ply", tmp_path / "out/rounds/8/notes.txt"
    for path in (stale, own):
        path.parent.mkdir(parents=True)
        path.write_text("of before")
    done = igsr_here(*command)
    assert done.returncode == 0, done.stderr
    assert not stale.parent.exists()
    assert own.exists()
    assert "rounds accepted; stopped: " in done.stdout
    assert (tmp_path / "out/report.html").is_file()
    assert (tmp_path / "out/scene.html").is_file()
    again = igsr_here(*command, "--resume", "--json")
    summary = json.loads(again.stdout)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert len(report["photos"]) == 5
    assert summary["tried"] == len(report["rounds"]) - 1
    assert summary["stopped"] == report["stopped"] != ""
    assert summary["splats"] == len(igsr.Splats.load(tmp_path / "out/scene.ply"))
    bad = igsr_here(*command[:4], "--photos", "99")
    assert bad.returncode == 1
    assert "the train photos of" in bad.stderr
    assert bad.stderr.startswith("--photos must be from 1 to ")
    next((tmp_path / "ball").rglob("*.png")).unlink()
    lacking = igsr_here(*command[:2], "--out", tmp_path / "other", *command[4:])
    assert lacking.returncode == 1
    assert len(lacking.stderr.splitlines()) == 1
    assert ".png" in lacking.stderr


def test_what_cannot_be_used_is_told_before_anything_slow(tmp_path, igsr_here, monkeypatch):
    def searched(photos, *, seed=0, progress=None):
        raise AssertionError("cameras are looked for")

    entry = registry.Entry(lambda: searched, lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, entry)
    for view in scenes.capture(views=8, size=40).views:
        path = tmp_path / view.name
        path.parent.mkdir(exist_ok=True)
        Image.fromarray(view.image).save(path)
    old = tmp_path / "report.json"
    old.write_text('{"rounds": [], "stopped": "2 rounds are done", "version": "0.1.0"}')
    wrong = tmp_path / "wrong.json"
    wrong.write_text('{"settings": {"rounds": 2, "steps": 0}}')
    missing = tmp_path / "none.json"
    command = ["refine", tmp_path / "photos", "--out", tmp_path / "out"]
    for options, message in (
        (["--photos", "99"], f"--photos must be from 1 to 8, the train photos of {command[1]}, "),
        (["--photos", "8", "--test-every", "4"], "--photos must be from 1 to 6, the train photos"),
        (["--rounds", "some"], "rounds must be a whole number or \"auto\", not 'some'."),
        (["--rounds", "-1"], "rounds must not be negative, not -1."),
        (["--steps", "0"], "steps must be from 1 to 10000000, not 0."),
        (["--config", missing], f"Cannot read {missing}: No such file or directory."),
        (["--config", old], f"{old} has no settings: it is a report of an older version of igsr."),
        (["--config", wrong], f"{wrong}: steps must be from 1 to 10000000, not 0."),
    ):
        bad = igsr_here(*command, *options)
        assert bad.returncode == 1
        assert bad.stderr.startswith(message), bad.stderr
        assert len(bad.stderr.splitlines()) == 1
    assert igsr_here(*command, "--backend", "reference").returncode == 2
    assert not (tmp_path / "out").exists()


def test_the_settings_of_a_report_run_again(ball_photos, tmp_path, igsr_here):
    scenes.write_capture(tmp_path / "ball", ball_photos)
    command = ["refine", tmp_path / "ball", "--photos", "3"]
    settings = ["--steps", "30", "--rounds", "0", "--seed", "7", "--backend", "cpu"]
    settings += ["--no-cross-validate"]
    assert igsr_here(*command, "--out", tmp_path / "first", *settings).returncode == 0
    config = ["--config", tmp_path / "first/report.json"]
    assert igsr_here(*command, "--out", tmp_path / "again", *config).returncode == 0
    given = [*config, "--seed", "0"]
    assert igsr_here(*command, "--out", tmp_path / "other", *given).returncode == 0
    first, again, other = (
        json.loads((tmp_path / out / "report.json").read_text())["settings"]
        for out in ("first", "again", "other")
    )
    wanted = {"rounds": 0, "steps": 30, "backend": "cpu", "seed": 7, "cross_validate": False}
    wanted |= {"quality": "normal", "exposure": "off", "transients": "auto"}
    assert first == again == wanted
    assert other == wanted | {"seed": 0}, "what is given wins over the report, be it the default"
    models = [igsr.Splats.load(tmp_path / out / "scene.ply") for out in ("first", "again", "other")]
    assert refinements.same(models[0], models[1])
    assert not refinements.same(models[0], models[2])


def test_help_loads_no_torch():
    run = "import sys; from igsr.cli.refine import refine_command; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", run], check=False).returncode == 0
