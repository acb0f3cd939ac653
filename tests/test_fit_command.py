"""``igsr.fit`` with a folder, and ``igsr fit``, which writes the same files."""

import json

import pytest
import scenes

import igsr

SETTINGS = {"steps": 30, "max_splats": 200, "seed": 3, "holdout": 4, "backend": "cpu"}
FILES = ["cameras.json", "report.html", "report.json", "scene.html", "scene.ply", "views.png"]
#: Parts of reports that differ from run to run.
MEASURED = ("seconds", "parts", "peak_memory_bytes")


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    path = tmp_path_factory.mktemp("photos") / "capture"
    return scenes.write_capture(path, scenes.capture(views=8, size=40, alpha=True))


@pytest.fixture(scope="module")
def fitted(photos, tmp_path_factory):
    """The result, the folder and the events of a fit."""
    out, events = tmp_path_factory.mktemp("fitted"), []
    return igsr.fit(photos, out=out, progress=events.append, **SETTINGS), out, events


def report_in(out):
    report = json.loads((out / "report.json").read_text())
    return {name: value for name, value in report.items() if name not in MEASURED}


def test_fit_returns_what_it_writes(fitted):
    result, out, events = fitted
    assert {path.name for path in out.iterdir()} == {*FILES, "checkpoint.npz", "view"}
    assert igsr.Splats.load(out / "scene.ply") == result.splats
    assert json.loads((out / "report.json").read_text()) == result.report
    assert result.scores.psnr == result.report["psnr"]
    assert [row["name"] for row in result.scores.views] == ["photos/00.png", "photos/04.png"]
    assert result.steps == result.settings.steps == 30
    splats, psnr = len(result.splats), result.scores.psnr
    assert repr(result) == f"FitResult({splats} splats, 30 steps, {psnr:.2f} dB)"
    stages = [event.stage for event in events]
    assert list(dict.fromkeys(stages)) == ["note", "fit", "scene written", "score"]
    assert [event.path for event in events if event.path] == [out / "scene.ply"]
    last = [event for event in events if event.stage == "fit"][-1]
    assert (last.done, last.total, last.part) == (30, 30, 1.0)
    assert last.values.keys() == {"loss", "splats", "steps_per_second"}


def test_the_command_writes_the_same(fitted, photos, tmp_path, igsr_here):
    _, out, _ = fitted
    options = [(f"--{name.replace('_', '-')}", value) for name, value in SETTINGS.items()]
    ran = igsr_here("fit", photos, "--out", tmp_path, *sum(options, ()))
    assert ran.returncode == 0, ran.stderr
    assert {path.name for path in tmp_path.iterdir()} == {path.name for path in out.iterdir()}
    assert (tmp_path / "scene.ply").read_bytes() == (out / "scene.ply").read_bytes()
    assert report_in(tmp_path) == report_in(out)


def test_without_a_folder_nothing_is_written_or_scored(fitted, photos):
    result = igsr.fit(photos, **SETTINGS)
    assert result.splats == fitted[0].splats
    assert result.scores is result.report is None


@pytest.mark.parametrize("error", [scenes.Stop, KeyboardInterrupt])
def test_a_run_that_its_listener_ends_is_resumed(fitted, photos, tmp_path, error):
    def end(event):
        if event.stage == "fit" and event.done >= 3:
            raise error

    with pytest.raises(error):
        igsr.fit(photos, out=tmp_path, progress=end, **SETTINGS)
    assert {path.name for path in tmp_path.iterdir()} == {"checkpoint.npz", "view"}
    result = igsr.fit(photos, out=tmp_path, resume=True, **SETTINGS)
    assert result.splats == fitted[0].splats
    assert report_in(tmp_path) == report_in(fitted[1])


def test_settings_are_checked_before_photos_are_read(tmp_path, igsr_here):
    ran = igsr_here("fit", tmp_path / "nothing", "--out", tmp_path / "out", "--steps", 0)
    assert ran.returncode == 1
    assert ran.stderr == "steps must be from 1 to 10000000, not 0.\n"
    with pytest.raises(igsr.IgsrError, match=r"dropout must be a number from 0 to 0.9"):
        igsr.fit(tmp_path / "nothing", out=tmp_path / "out", dropout=0.95)
    refused = igsr_here("fit", tmp_path, "--out", tmp_path / "out", "--backend", "reference")
    assert refused.returncode == 2
    assert not (tmp_path / "out").exists()
