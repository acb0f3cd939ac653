"""``python -m igsr_lab pairs`` and ``train``, and ``igsr denoise`` with the trained weights."""

import json
import subprocess
import sys
from functools import partial

import numpy as np
import pytest
import scenes
from PIL import Image
from typer.testing import CliRunner

from igsr._internal.settings import settings_of
from igsr.cli import app
from igsr_lab.__main__ import app as lab_app
from igsr_lab.denoiser.training_settings import Training


def run(*arguments, app=app):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


lab = partial(run, app=lab_app)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A capture, its splats, and a folder with a denoiser trained for a few steps."""
    folder = tmp_path_factory.mktemp("denoise")
    scene = scenes.splats()
    for name in ("ball", "other"):
        scenes.write_capture(folder / name, scenes.capture(views=5, size=40, scene=scene))
    scene.save(folder / "ball.ply")
    options = ("--steps", 3, "--views", 1, "--backend", "cpu", "--json")
    captures = (folder / "ball", folder / "other")
    made = lab("pairs", *captures, "--out", folder / "pairs", "--all-views", *options)
    assert made.exit_code == 0, made.output
    assert len(json.loads(made.stdout)["fits"]) == 6
    options = ("--steps", 4, "--batch", 2, "--crop", 16, "--width", 4, "--json")
    done = lab("train", "--pairs", folder / "pairs", "--out", folder / "out", *options)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["step"] == 4
    assert (folder / "out" / "loss.png").stat().st_size > 1000
    return folder


def test_views_are_denoised_with_trained_weights(trained):
    out = trained / "clean"
    done = run(
        "denoise", trained / "ball.ply", "--capture", trained / "ball", "--out", out,
        "--denoiser", trained / "out" / "denoiser.safetensors", "--backend", "cpu", "--holdout", 4,
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    files = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.png"))
    names = ["photos/00", "photos/04"]
    assert files == [f"{name}{end}" for name in names for end in (".confidence.png", ".png")]
    picture = np.asarray(Image.open(out / "photos/00.png"))
    photo = np.asarray(Image.open(trained / "ball" / "photos/00.png"))
    # After a few steps, the result is the render and a little of the other photos.
    assert np.abs(picture.astype(int) - photo).mean() < 12.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "--pairs", "ball"], "holds no .npz of pairs"),
        (["train", "--pairs", "pairs", "--features", "a", "--lpips", "alex"], "give one"),
        (["train", "--pairs", "pairs", "--loss", "lpips"], "needs a perceptual distance"),
        (["train", "--pairs", "pairs", "--width", "5"], "width must be even, from 2 to 256, not 5"),
        (["pairs", "ball", "--fits", "0"], "fits must be at least 1"),
        (["pairs", "ball", "--recipe", "burnt"], "recipe must be one of sparse, underfit, noise"),
    ],
)
def test_mistakes_are_one_sentence(trained, monkeypatch, arguments, message):
    monkeypatch.chdir(trained)
    done = lab(*arguments, "--out", "wrong")
    assert done.exit_code == 1
    assert message in done.stderr
    assert done.stderr.count("\n") == 1


def test_help_loads_no_torch_and_has_all_settings():
    code = "import sys, igsr_lab.commands.denoiser; print({'torch', 'matplotlib'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
    help = lab("train", "--help").stdout
    assert all(f"--{name.replace('_', '-')}" in help for name in settings_of(Training))
