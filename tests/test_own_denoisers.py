"""Custom denoisers: by name, without confidence, and of single-step networks."""

from __future__ import annotations

import json
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from PIL import Image
from refinements import refine, truthful
from typer.testing import CliRunner

import igsr
from igsr.cli import app
from igsr.denoiser import Buffers, SingleStepDenoiser, Source, denoise, named_denoiser
from igsr.denoiser.confidence import MIN_CLAIMED_ERROR, confidence_of, error_of
from igsr.refinement.selection import confidence_weights

EXAMPLE = Path(__file__).parents[1] / "examples" / "difix_denoiser.py"


def test_confidence_and_error_are_inverse():
    errors = np.array([0.0, 0.01, 0.05, 0.4], np.float32)
    assert error_of(confidence_of(errors)) == pytest.approx(errors, abs=1e-6)
    assert confidence_of(errors)[2] == pytest.approx(0.5)


def test_pictures_without_confidence_get_one_from_changes():
    color = np.full((24, 32, 3), 0.5, np.float32)
    picture = color.copy()
    picture[:, 16:] = 0.8
    cleaned, confidence = denoise(color, denoiser=lambda render, photos: picture)
    assert cleaned is picture
    assert confidence[:, :12] == pytest.approx(float(confidence_of(np.float32(MIN_CLAIMED_ERROR))))
    assert confidence[:, 20:].max() < 0.2
    with pytest.raises(igsr.IgsrError, match=r"returned a picture \[12, 32, 3\] for a render"):
        denoise(color, denoiser=lambda render, photos: picture[::2])


@pytest.mark.usefixtures("small_fits")
def test_a_given_confidence_is_kept(ball_photos):
    def sure(buffers, photos):
        return truthful(buffers, photos)[0], np.full(buffers.color.shape[:2], 0.6, np.float32)

    selected = refine(ball_photos, 1, sure).rounds[0].selected
    weight = confidence_weights(np.full((1, 1), 0.6, np.float32))[0, 0]
    assert [one.mean_confidence for one in selected] == pytest.approx([weight] * len(selected))


# ---- by name -------------------------------------------------------------------------------------


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_denoiser.py").write_text(
        textwrap.dedent(
            """
            import numpy as np

            def make():
                return lambda render, photos: np.clip(1.0 - render.color, 0.0, 1.0)

            def fails():
                raise RuntimeError("no weights here")

            def nothing():
                return None

            number = 3
            """
        )
    )
    (tmp_path / "broken.py").write_text("import not_there_at_all\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    yield tmp_path
    for name in ("my_denoiser", "broken"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("module_name", ["my_denoiser", "my_denoiser.py", "./my_denoiser.py"])
def test_a_factory_is_found_by_module_or_file(module, module_name):
    color = np.full((4, 5, 3), 0.25, np.float32)
    picture, _ = denoise(color, denoiser=named_denoiser(f"{module_name}:make"))
    assert picture == pytest.approx(0.75)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my_denoiser", "must be MODULE:FACTORY"),
        (":make", "must be MODULE:FACTORY"),
        ("my_denoiser:", "must be MODULE:FACTORY"),
        ("not_there:make", "not_there cannot be imported: ModuleNotFoundError"),
        ("not_there.py:make", "there is no file not_there.py"),
        ("broken:make", "broken cannot be imported: .*not_there_at_all"),
        ("broken.py:make", "broken.py cannot be imported: .*not_there_at_all"),
        ("my_denoiser:other", "my_denoiser has no function other"),
        ("my_denoiser:number", "my_denoiser has no function number"),
        ("my_denoiser:fails", "my_denoiser:fails failed: RuntimeError: no weights here"),
        ("my_denoiser:nothing", "must return a function of a render and photos, not NoneType"),
    ],
)
def test_bad_names_are_refused(module, name, said):
    with pytest.raises(igsr.IgsrError, match=said):
        named_denoiser(name)


@pytest.fixture
def scene(tmp_path):
    """A capture and its splats, in files."""
    splats = scenes.splats()
    scenes.write_capture(tmp_path / "ball", scenes.capture(views=5, size=40, scene=splats))
    splats.save(tmp_path / "ball.ply")
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_denoise_command_takes_a_name(module, scene):
    options = ("--capture", "ball", "--out", "clean", "--holdout", 4, "--backend", "cpu", "--json")
    done = run("denoise", "ball.ply", *options, "--denoiser", "my_denoiser:make")
    assert done.exit_code == 0, done.output
    picture = np.asarray(Image.open(scene / "clean/photos/00.png")).astype(int)
    photo = np.asarray(Image.open(scene / "ball/photos/00.png")).astype(int)
    assert np.abs(picture - (255 - photo[..., :3])).mean() < 12.0


@pytest.mark.parametrize("command", ["apply", "refine"])
def test_commands_refuse_bad_names(module, scene, command):
    given = {
        "apply": ("denoise", "ball.ply", "--capture", "ball", "--out", "out"),
        "refine": ("refine", "ball", "--out", "out", "--steps", 5),
    }[command]
    done = run(*given, "--denoiser", "my_denoiser:fails", "--backend", "cpu")
    assert done.exit_code == 1
    assert "no weights here" in done.output
    done = run(*given, "--denoiser", "my_denoiser:make", "--weights", "w.safetensors")
    assert done.exit_code == 1
    assert "not both" in done.output
    assert not (scene / "out").exists()


def test_the_refine_command_takes_a_name(module, scene):
    done = run(
        "refine", "ball", "--out", "out", "--steps", 30, "--rounds", 1, "--backend", "cpu",
        "--denoiser", "my_denoiser:make", "--no-html", "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    report = json.loads((scene / "out/report.json").read_text())
    # A negative of the scene improves nothing: there is the fit alone.
    assert not any(one.get("accepted", False) for one in report["rounds"])


# ---- single-step networks ------------------------------------------------------------------------


def source(offset, color):
    camera = scenes.ring_camera(offset, 30)
    picture = np.full((30, 30, 3), color, np.float32)
    return Source(camera, picture, np.ones((30, 30), bool), np.ones((30, 30), np.float32))


def test_models_get_the_nearest_photo_and_padded_pictures():
    seen = []

    def model(render, photo):
        seen.append((render, photo))
        return render + 0.1

    buffers = Buffers(np.full((30, 30, 3), 0.5, np.float32), camera=scenes.ring_camera(0.1, 30))
    photos = [source(1.0, 0.9), source(0.2, 0.3), source(-1.2, 0.6)]
    picture = SingleStepDenoiser(model)(buffers, photos)
    render, photo = seen[0]
    assert render.shape == photo.shape == (1, 3, 32, 32)
    assert photo.mean().item() == pytest.approx(0.3)
    assert picture.shape == (30, 30, 3)
    assert picture.dtype == np.float32
    assert picture == pytest.approx(0.6)
    SingleStepDenoiser(model)(buffers, [])
    assert seen[-1][1] is None


def test_large_renders_are_reduced_but_keep_detail():
    sizes = []

    def model(render, photo):
        sizes.append(tuple(render.shape[-2:]))
        return (render + 0.2).to(torch.float16)

    color = np.random.default_rng(0).uniform(0.2, 0.6, (64, 96, 3)).astype(np.float32)
    picture = SingleStepDenoiser(model, longest=48)(Buffers(color), [])
    assert sizes == [(32, 48)]
    assert picture == pytest.approx(color + 0.2, abs=2e-3)
    broken = color.copy()
    broken[3, 4] = np.nan
    assert np.isfinite(SingleStepDenoiser(model)(Buffers(broken), [])).all()


def test_bad_models_and_sizes_are_refused():
    with pytest.raises(igsr.IgsrError, match=r"returned \[1, 3, 8, 8\] for \[1, 3, 16, 16\]"):
        SingleStepDenoiser(lambda render, photo: render[..., ::2, ::2])(
            Buffers(np.zeros((16, 16, 3), np.float32)), []
        )
    for bad in ({"multiple": 0}, {"longest": 4}):
        with pytest.raises(igsr.IgsrError, match="multiple must be at least 1"):
            SingleStepDenoiser(lambda render, photo: render, **bad)


PIPELINE = """
import torch

class DifixPipeline:
    loaded = []

    @classmethod
    def from_pretrained(cls, path):
        made = cls()
        made.gain = torch.load(path + "/gain.pt", weights_only=True)
        cls.loaded.append(path)
        return made

    def to(self, device):
        return self

    def set_progress_bar_config(self, disable):
        pass

    def __call__(self, prompt, *, image, ref_image, num_inference_steps, timesteps,
                 guidance_scale, output_type):
        assert (prompt, num_inference_steps, timesteps) == ("remove degradation", 1, [199])
        assert (guidance_scale, output_type) == (0.0, "pt")

        class Output:
            images = image + self.gain * (ref_image - image)

        return Output()
"""


def test_the_example_adapts_difix(tmp_path, monkeypatch):
    """With a made-up pipeline of its interface: half-way to the photo."""
    (tmp_path / "pipeline_difix.py").write_text(PIPELINE)
    torch.save(torch.tensor(0.5), tmp_path / "gain.pt")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("DIFIX", str(tmp_path))
    try:
        denoiser = named_denoiser(f"{EXAMPLE}:make")
        buffers = Buffers(np.full((30, 30, 3), 0.5, np.float32), camera=scenes.ring_camera(0.1, 30))
        picture, confidence = denoise(buffers, [source(0.2, 0.9)], denoiser=denoiser)
    finally:
        sys.modules.pop("pipeline_difix", None)
        sys.modules.pop("difix_denoiser", None)
    assert picture == pytest.approx(0.7, abs=1e-6)
    assert confidence.max() < 0.25


def test_the_example_without_difix_is_an_error():
    with pytest.raises(igsr.IgsrError, match="No module named 'pipeline_difix'"):
        named_denoiser(f"{EXAMPLE}:make")
