"""igsr without torch: commands that work, and messages that name the missing extra."""

import json

import pytest
import scenes
import without_torch
from PIL import Image
from web_views import view_until_ctrl_c

#: Packages and modules that may need torch.
OF_REFINE = (
    "igsr.denoiser",
    "igsr.cameras.alignment",
    "igsr.cameras.all_evidence",
    "igsr.cameras.colmap.adjustment",
    "igsr.cameras.da3",
    "igsr.cameras.dust3r",
    "igsr.cameras.networks",
    "igsr.refinement",
    "igsr.rendering.exposure",
    "igsr.rendering.normals",
    "igsr.rendering.rasterization",
    "igsr.rendering.rasterization_arguments",
)

#: Prints the modules that cannot be imported without torch.
IMPORT_ALL = """
import importlib, pkgutil, sys, igsr
for module in pkgutil.walk_packages(igsr.__path__, "igsr.", onerror=lambda name: None):
    if module.name.endswith("__main__"):
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in ("torch", "torchmetrics"):
            print(module.name)
"""


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The folder of a short fit of the example, and the printed report."""
    folder = tmp_path_factory.mktemp("fitted")
    words = ["fit", "--example", "--out", "out", "--steps", "12", "--backend", "cpu", "--json"]
    result = without_torch.igsr(folder, *words)
    assert result.returncode == 0, result.stderr
    return folder, json.loads(result.stdout)


def test_torch_is_really_missing(tmp_path):
    result = without_torch.python(tmp_path, "-c", "import torch")
    assert result.returncode == 1
    assert "No module named 'torch'" in result.stderr


def test_a_fit_is_scored_and_reported(fitted):
    folder, printed = fitted
    out = folder / "out"
    for name in ("scene.ply", "scene.html", "report.html", "report.json", "views.png"):
        assert (out / name).stat().st_size > 1000, name
    report = json.loads((out / "report.json").read_text())
    assert report["photos"] == printed["photos"]
    assert (report["photos"]["train"], report["photos"]["test"]) == (8, 8)
    for metric in ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr"):
        assert report[metric] > 0.0
    assert "<iframe" in (out / "report.html").read_text()


@pytest.mark.parametrize(
    ("words", "made"),
    [
        (["eval", "out/scene.ply", "out/example", "--backend", "cpu", "--json"], None),
        (["render", "out/scene.ply", "--cameras", "out/example", "--out", "seen"], "seen"),
        (["convert", "out/scene.ply", "small.sog"], "small.sog"),
        (["convert", "out/scene.ply", "page.html"], "page.html"),
        (["info", "out/scene.ply"], None),
        (["clean", "out/scene.ply", "--out", "clean.ply"], "clean.ply"),
        (["view", "out", "--screenshot", "window.png", "--backend", "cpu"], "window.png"),
        (["convert", "out/example", "colmap"], "colmap"),
    ],
)
def test_commands_on_the_scene_work(fitted, words, made):
    folder, _ = fitted
    result = without_torch.igsr(folder, *words)
    assert result.returncode == 0, result.stderr
    assert "torch" not in result.stderr
    assert made is None or (folder / made).exists()


def test_the_browser_view_shows_it(fitted):
    folder, _ = fitted
    variables = {**without_torch.environment(folder / "site"), "DISPLAY": ""}
    _, state, _, errors = view_until_ctrl_c(folder, variables, "--web", "out")
    assert state["newest"] == "scene"
    assert "Traceback" not in errors


DUST3R = ["--estimator", "dust3r", "--checkpoint", "x.pth"]


@pytest.mark.parametrize(
    ("words", "user"),
    [
        (["refine", "--example", "--out", "refined"], "igsr refine"),
        (["denoise", "a.ply", "--capture", "x", "--out", "y"], "igsr denoise"),
        (["fit", "photos", "--out", "y", *DUST3R], "estimator dust3r"),
        (["pose", "photos", "--out", "y", "--estimator", "da3"], "estimator da3"),
    ],
)
def test_commands_that_need_torch_name_the_extra_and_write_nothing(tmp_path, words, user):
    (tmp_path / "photos").mkdir()
    for number, view in enumerate(scenes.capture(views=3, size=32).views):
        Image.fromarray(view.image).save(tmp_path / "photos" / f"{number}.png")
    before = {path.name for path in tmp_path.iterdir()} | {"site"}
    result = without_torch.igsr(tmp_path, *words)
    assert result.returncode == 1
    assert result.stderr.splitlines()[-1] == f"{user} needs torch: pip install 'igsr[refine]'."
    assert "Traceback" not in result.stderr
    assert {path.name for path in tmp_path.iterdir()} - before <= {"y"}


def test_public_names_that_need_torch_name_the_extra(tmp_path):
    code = """
import igsr
for name in igsr.__all__:
    try:
        getattr(igsr, name)
    except igsr.MissingExtraError as error:
        assert isinstance(error, ImportError) and isinstance(error, igsr.IgsrError)
        assert error.extra == "refine"
        print(error)
"""
    result = without_torch.python(tmp_path, "-c", code)
    assert result.returncode == 0, result.stderr
    names = ("apply_exposure", "denoise", "rasterization", "refine", "Refined")
    assert sorted(result.stdout.splitlines()) == sorted(
        f"igsr.{name} needs torch: pip install 'igsr[refine]'." for name in names
    )


def test_splats_as_tensors_name_the_extra(tmp_path):
    scenes.splats().save(tmp_path / "a.ply")
    code = "import igsr; igsr.Splats.load('a.ply').to_torch()"
    result = without_torch.python(tmp_path, "-c", code, cwd=tmp_path)
    assert result.stderr.splitlines()[-1] == (
        "igsr.errors.MissingExtraError: Splats.to_torch needs torch: pip install 'igsr[refine]'."
    )


def test_only_modules_of_the_extra_need_torch(tmp_path):
    result = without_torch.python(tmp_path, "-c", IMPORT_ALL)
    assert result.returncode == 0, result.stderr
    needing = result.stdout.split()
    assert "igsr.denoiser.network" in needing
    outside = [name for name in needing if not name.startswith(OF_REFINE)]
    assert outside == []
