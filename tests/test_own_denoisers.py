"""Custom denoisers: without confidence, by name, and from a single-step network."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes
import torch
from capture_files import assert_refused
from PIL import Image
from refinements import refine, truthful

import igsr
from igsr.denoiser import Buffers, SingleStepDenoiser, Source, denoise, named_denoiser
from igsr.denoiser.confidence import MIN_CLAIMED_ERROR, confidence_of, error_of
from igsr.refinement.selection import confidence_weights

EXAMPLE = Path(__file__).parents[1] / "examples" / "difix_denoiser.py"


def test_confidence_and_error_are_inverse():
    errors = np.array([0.0, 0.01, 0.05, 0.4], np.float32)
    assert error_of(confidence_of(errors)) == pytest.approx(errors, abs=1e-6)
    assert confidence_of(errors)[2] == pytest.approx(0.5)


def test_a_picture_without_confidence_gets_that_of_its_changes():
    color = np.full((24, 32, 3), 0.5, np.float32)
    picture = color.copy()
    picture[:, 16:] = 0.8
    cleaned, confidence = denoise(color, denoiser=lambda render, photos: picture)
    assert cleaned is picture
    assert confidence[:, :12] == pytest.approx(float(confidence_of(np.float32(MIN_CLAIMED_ERROR))))
    assert confidence[:, 20:].max() < 0.2
    with pytest.raises(igsr.IgsrError, match=r"returned a picture \[12, 32, 3\] for a render"):
        denoise(color, denoiser=lambda render, photos: picture[::2])


def test_a_refinement_uses_the_confidence_of_the_denoiser(few_photos):
    def denoiser(buffers, photos):
        return truthful(buffers, photos)[0], np.full(buffers.color.shape[:2], 0.6, np.float32)

    selected = refine(few_photos, 1, denoiser).rounds[0].selected
    assert selected
    weight = confidence_weights(np.full((1, 1), 0.6, np.float32))[0, 0]
    for candidate in selected:
        assert candidate.mean_confidence == pytest.approx(weight)


MODULE = """
import numpy as np

def make():
    return lambda render, photos: np.clip(1.0 - render.color, 0.0, 1.0)

def fails():
    raise RuntimeError("no weights here")

def nothing():
    return None

number = 3
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    (tmp_path / "my_denoiser.py").write_text(MODULE)
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


@pytest.mark.usefixtures("module")
def test_bad_names_are_errors():
    for name in ("my_denoiser", ":make", "my_denoiser:"):
        assert_refused("must be MODULE:FACTORY", named_denoiser, name)
    for name, message in (
        ("not_there:make", "not_there cannot be imported: ModuleNotFoundError"),
        ("not_there.py:make", "there is no file not_there.py"),
        ("broken:make", "broken cannot be imported: .*not_there_at_all"),
        ("broken.py:make", "broken.py cannot be imported: .*not_there_at_all"),
        ("my_denoiser:other", "my_denoiser has no function other"),
        ("my_denoiser:number", "my_denoiser has no function number"),
        ("my_denoiser:fails", "my_denoiser:fails failed: RuntimeError: no weights here"),
        ("my_denoiser:nothing", "must return a function of a render and photos, not NoneType"),
    ):
        assert_refused(message, named_denoiser, name)


@pytest.fixture
def scene(tmp_path):
    """A capture and its splats, in files."""
    splats = scenes.splats()
    scenes.write_capture(tmp_path / "ball", scenes.capture(views=5, size=40, scene=splats))
    splats.save(tmp_path / "ball.ply")
    return tmp_path


def test_the_command_denoise_takes_a_name(module, scene, igsr_here):
    options = ("--capture", "ball", "--out", "clean", "--holdout", 4, "--backend", "cpu", "--json")
    done = igsr_here("denoise", "ball.ply", *options, "--denoiser", "my_denoiser:make")
    assert done.returncode == 0, done.stderr
    picture = np.asarray(Image.open(scene / "clean/photos/00.png")).astype(int)
    photo = np.asarray(Image.open(scene / "ball/photos/00.png")).astype(int)
    assert np.abs(picture - (255 - photo[..., :3])).mean() < 12.0


def test_the_command_refine_takes_a_name(module, scene, igsr_here):
    options = ("--out", "out", "--steps", 30, "--backend", "cpu")
    done = igsr_here("refine", "ball", *options, "--denoiser", "my_denoiser:make")
    assert done.returncode == 0, done.stderr
    report = json.loads((scene / "out/report.json").read_text())
    # A negative of the scene improves nothing.
    assert report["stop_reason"] == "harmful_denoiser"


@pytest.mark.parametrize("command", ["denoise ball.ply --capture ball", "refine ball --steps 5"])
def test_the_commands_report_a_bad_denoiser(module, scene, command, igsr_here):
    bad = {"my_denoiser:fails": "no weights here", "missing.safetensors": "missing.safetensors"}
    for name, message in bad.items():
        options = ("--out", "out", "--denoiser", name, "--backend", "cpu")
        done = igsr_here(*command.split(), *options)
        assert done.returncode == 1
        assert message in done.stderr
        assert not (scene / "out").exists()


def source(offset, color):
    camera = scenes.ring_camera(offset, 30)
    picture = np.full((30, 30, 3), color, np.float32)
    return Source(camera, picture, np.ones((30, 30), bool), np.ones((30, 30), np.float32))


def test_the_model_gets_the_nearest_photo_and_padded_pictures():
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


def test_large_renders_are_denoised_small_and_keep_their_detail():
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


def test_bad_models_and_sizes_are_errors():
    half = SingleStepDenoiser(lambda render, photo: render[..., ::2, ::2])
    buffers = Buffers(np.zeros((16, 16, 3), np.float32))
    assert_refused(r"returned \[1, 3, 8, 8\] for \[1, 3, 16, 16\]", half, buffers, [])
    for bad in ({"multiple": 0}, {"longest": 4}):
        assert_refused("multiple must be at least 1", SingleStepDenoiser, half, **bad)


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
    """A made-up pipeline with its interface goes half-way to the photo."""
    assert_refused("No module named 'pipeline_difix'", named_denoiser, f"{EXAMPLE}:make")
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
