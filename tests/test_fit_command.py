"""``igsr fit --config``: what a report records runs again; bad files are named."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import scenes
from typer.testing import CliRunner

import igsr
from igsr.cli import app


@pytest.fixture(scope="module")
def capture_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("photos") / "capture"
    scenes.write_capture(path, scenes.capture(views=8, size=40, alpha=True))
    return path


@pytest.fixture(scope="module")
def fitted(capture_path, tmp_path_factory):
    """The folder of a fit whose options are not the default ones."""
    out = tmp_path_factory.mktemp("fitted") / "out"
    options = ["--steps", "30", "--max-splats", "200", "--seed", "3", "--backend", "cpu"]
    words = ["--preset", "instantsplat", "--init", "random", "--background", "0,0.5,1"]
    result = fit(capture_path, "--out", out, "--test-every", "4", *options, *words)
    assert result.exit_code == 0, result.output
    return out


def fit(*words):
    return CliRunner().invoke(app, ["fit", *map(str, words)])


def test_a_report_runs_again(fitted, capture_path, tmp_path):
    result = fit("--config", fitted / "report.json", "--out", tmp_path / "again")
    assert result.exit_code == 0, result.output
    assert (tmp_path / "again/scene.ply").read_bytes() == (fitted / "scene.ply").read_bytes()
    first, again = (
        json.loads((out / "report.json").read_text()) for out in (fitted, tmp_path / "again")
    )
    measured = ("seconds", "parts", "peak_memory_bytes")
    assert again == {**first, **{name: again[name] for name in measured}}
    asked = first["settings"]
    assert asked["capture"] == str(capture_path)
    assert (asked["holdout"], asked["steps"], asked["start"]) == (4, 30, "random")
    assert (asked["poses"], asked["focal"], asked["background"]) == ("joint", "shared", "0,0.5,1")


def test_given_options_override_a_file(fitted, tmp_path):
    words = ["--steps", "10", "--density", "mcmc", "--poses", "fixed"]
    result = fit("--config", fitted / "report.json", "--out", tmp_path, *words)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["steps"], report["density"], report["poses"]) == (10, "mcmc", "fixed")
    assert (report["max_splats"], report["seed"]) == (200, 3)
    refused = fit("--config", fitted / "report.json", "--out", tmp_path, "--preset", "3dgs")
    assert refused.exit_code == 1
    assert "--preset changes nothing" in refused.stderr


def test_a_file_of_some_options_leaves_the_rest_to_the_preset(capture_path, tmp_path):
    (tmp_path / "some.json").write_text(
        json.dumps({"max-splats": 100, "strategy": "fixed", "test_every": 4, "graph": None})
    )
    words = ["--config", tmp_path / "some.json", "--out", tmp_path, "--steps", "5"]
    result = fit(capture_path, *words, "--preset", "3dgs")
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["max_splats"], report["density"], report["sh_degree"]) == (100, "fixed", 3)
    assert report["protocol"]["holdout"] == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"steps": 2.9}', "bad.json: steps must be a whole number, not 2.9."),
        ('{"steps": true}', "bad.json: steps must be a whole number, not true."),
        ('{"backdrop": 1}', "bad.json: backdrop must be true or false, not 1."),
        ('{"capture": 3}', "bad.json: capture must be a text, not 3."),
        ('{"dropout": "0.5"}', 'bad.json: dropout must be a number, not "0.5".'),
        ('{"stepz": 2}', "bad.json: there is no option 'stepz' here; leave it out."),
        ('{"config": "a.json"}', "bad.json: there is no option 'config' here"),
        ("[1]", "bad.json is no JSON file of options: it holds no object."),
        ("{", "bad.json is no JSON file of options ("),
        ("[" * 100_000, "bad.json is no JSON file of options ("),
        (b"\xff\xfe\x00", "bad.json is no JSON file of options ("),
        (None, "bad.json: No such file or directory."),
    ],
)
def test_a_bad_file_is_named(capture_path, tmp_path, text, message):
    path = tmp_path / "bad.json"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    result = fit(capture_path, "--config", path, "--out", tmp_path / "out")
    assert result.exit_code == 1
    assert message in result.stderr
    assert not (tmp_path / "out").exists()


def test_options_are_checked_before_the_capture_is_read(tmp_path):
    for words, message in (
        (["--steps", "0"], "steps must be from 1 to 10000000, not 0."),
        (["--dropout", "0.95"], "dropout must be a number from 0 to 0.9, not 0.95."),
    ):
        result = fit(tmp_path / "nothing", "--out", tmp_path / "out", *words)
        assert (result.exit_code, result.stderr.strip()) == (1, message)
    refused = fit(tmp_path, "--out", tmp_path / "out", "--backend", "reference")
    assert refused.exit_code == 2


def test_a_preset_decides_what_is_not_given(capture_path, tmp_path):
    words = ["--steps", "5", "--max-splats", "100", "--preset", "instantsplat", "--backend", "cpu"]
    result = fit(capture_path, "--out", tmp_path, *words)
    assert result.exit_code == 0, result.output
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["poses"], report["focal"], report["density"]) == ("joint", "shared", "fixed")
    splats, _ = igsr.fit_with_cameras(
        igsr.load_capture(capture_path),
        preset="instantsplat",
        steps=5,
        max_splats=100,
        backend="cpu",
    )
    assert np.array_equal(igsr.Splats.load(tmp_path / "scene.ply").means, splats.means)


def test_settings_and_presets_are_read_without_what_computes():
    """The help of the command is made from them, and is there at once."""
    script = (
        "import sys, igsr.fitting.presets, igsr.fitting.settings\n"
        "print([name for name in ('torch', 'numpy', 'igsr._core') if name in sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert loaded.stdout.strip() == "[]"
