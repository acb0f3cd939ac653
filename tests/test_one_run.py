"""``igsr.fit`` and ``igsr.refine`` do all that the commands do: files, events, photos read once."""

from __future__ import annotations

import tempfile
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
import refinements
import rooms
import scenes
from PIL import Image, ImageFile

import igsr
from igsr._internal.part_usage import Meter, Usage
from igsr.cameras import registry
from igsr.cameras.cameras_file import read_cameras_file
from igsr.cameras.estimate import Estimate
from igsr.capture.image_files import SUFFIXES
from igsr.denoiser import save_network
from igsr.denoiser.network import Architecture, DenoiserNetwork
from igsr.fitting import train
from igsr.fitting.photo_statistics import MAX_DETAIL_FILES
from igsr.refinement import round_denoiser

MADE = scenes.capture(views=6, size=40)
#: Options of commands and their arguments in Python.
SHORT = {"steps": 20, "holdout": 3, "backend": "cpu"}


@pytest.fixture(params=["capture", "photos"])
def photos(request, tmp_path, monkeypatch):
    """Photos with cameras; and without, for which an estimator knows all but one."""
    folder = scenes.write_capture(tmp_path / "capture", MADE)

    def known(photos, *, seed, progress):
        cameras = [view.camera for view in MADE.views]
        nothing = [None] * len(photos)
        return Estimate([*cameras[:-1], None], None, nothing, nothing, ["Not placed: 05.png."])

    entry = registry.Entry(lambda: known, lambda options: True)
    for name in registry.ESTIMATORS:
        monkeypatch.setitem(registry.ESTIMATORS, name, entry)
    return folder if request.param == "capture" else folder / "photos"


@pytest.fixture
def denoiser(tmp_path):
    """A file of weights of a small network."""
    weights = tmp_path / "small.safetensors"
    save_network(DenoiserNetwork(Architecture(4, (0, 0, 0))), weights, {})
    return weights


def run(command, photos, out, weights, **options):
    """``igsr.fit`` or ``igsr.refine``."""
    if command == "fit":
        return igsr.fit(photos, out=out, **SHORT, **options)
    denoiser = round_denoiser(weights)
    return igsr.refine(photos, 1, out=out, denoiser=denoiser, **SHORT, **options)


@pytest.mark.parametrize("command", [igsr.fit, igsr.refine])
def test_arguments_that_do_not_fit_the_photos_are_refused(command):
    with pytest.raises(igsr.IgsrError, match="photos is a capture, which has cameras; leave out"):
        command(MADE, estimator="colmap")
    with pytest.raises(igsr.IgsrError, match="photos must be a capture, a folder or a video, not"):
        command(["a.jpg", "b.jpg"])


def files_in(folder):
    """Content of each file below a folder, by path."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


@pytest.mark.filterwarnings("ignore:Not placed")
@pytest.mark.parametrize("command", ["fit", "refine"])
def test_python_and_the_command_leave_the_same_files(
    photos, command, denoiser, tmp_path, igsr_here, monkeypatch
):
    # Without clocks and memory, all files have the same bytes.
    monkeypatch.setattr(Meter, "lap", lambda meter: Usage(0.0, 0.0, 1))
    monkeypatch.setattr(train, "time", SimpleNamespace(perf_counter=lambda: 0.0))
    by_python, by_command = tmp_path / "python/out", tmp_path / "command/out"
    run(command, photos, by_python, denoiser)
    words = [command, photos, "--out", by_command]
    words += [word for name, value in SHORT.items() for word in (f"--{name}", value)]
    words += ["--rounds", 1, "--denoiser", denoiser] if command == "refine" else []
    done = igsr_here(*words)
    assert done.returncode == 0, done.stderr
    expected, files = files_in(by_python), files_in(by_command)
    assert files.keys() == expected.keys()
    assert [name for name in files if files[name] != expected[name]] == []
    names = {"scene.ply", "scene.html", "cameras.json", "report.json", "report.html", "views.png"}
    names |= {"view/run.json", "view/cameras.json"}
    names |= {"checkpoint.npz"} if command == "fit" else {"rounds/0/scene.ply"}
    names |= {"cameras.npz"} if photos.name == "photos" else set()
    assert names <= files.keys()
    assert ("cameras.npz" in files) == ("cameras.npz" in names)


@pytest.mark.filterwarnings("ignore:Not placed")
@pytest.mark.parametrize("command", ["fit", "refine"])
def test_events_name_files_that_exist(photos, command, denoiser, tmp_path):
    out, found, scenes_written = tmp_path / "out", [], []

    def listener(event):
        if event.stage == "cameras found":
            assert event.path == out / "cameras.npz"
            found.append(read_cameras_file(event.path).found.placed)
        elif event.stage == "scene written":
            assert event.path == out / "scene.ply"
            assert (out / "scene.html").is_file()
            scenes_written.append(igsr.Splats.load(event.path))
        else:
            assert event.path is None

    result = run(command, photos, out, denoiser, progress=listener)
    assert found == ([[f"{i:02d}.png" for i in range(5)]] if photos.name == "photos" else [])
    assert refinements.same(scenes_written[-1], result.splats)
    assert result.not_placed == (("05.png",) if photos.name == "photos" else ())


@pytest.mark.parametrize(("max_size", "times"), [(None, 1), (120, 2)])
def test_photos_are_decoded_at_most_twice_and_never_encoded(max_size, times, tmp_path, monkeypatch):
    """Once for the cameras, and once more for the fit if it needs another size."""
    photos, temporary = tmp_path / "photos", tmp_path / "temporary"
    photos.mkdir()
    temporary.mkdir()
    for photo in rooms.photos([rooms.camera(angle) for angle in np.linspace(-0.5, 0.5, 6)]):
        Image.fromarray(photo.image).save(photos / photo.name)
    decoded, stages = Counter(), Counter()
    load = ImageFile.ImageFile.load

    def counted(image):
        if image.tile:  # its pixels are not decoded yet
            decoded[image.filename] += 1
        return load(image)

    def listener(event):
        stages.update([event.stage])
        assert [path for path in temporary.rglob("*") if path.suffix.lower() in SUFFIXES] == []

    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr(ImageFile.ImageFile, "load", counted)
    monkeypatch.setattr(Image.Image, "save", lambda *_, **__: pytest.fail("a photo was encoded"))
    result = igsr.fit(photos, 5, max_size=max_size, backend="cpu")
    assert len(result.capture.views) == 6
    assert decoded == {str(path): times for path in photos.iterdir()}
    # The sentence about time and splats looks at a few photos before the cameras are sought.
    igsr.fit(photos, 5, max_size=max_size, backend="cpu", progress=listener)
    assert decoded.total() <= 2 * 6 * times + MAX_DETAIL_FILES
    assert stages["find cameras"] > 10
