"""The benchmark: workloads, oracle, errors, rows, two builds, the command."""

import json
import os
import runpy
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scenes as made_up
import torch
from PIL import Image

from igsr import _core
from igsr._internal import peak_memory
from igsr.errors import IgsrError
from igsr_lab.bench import (
    accuracy,
    fit_rows,
    growth,
    kernel_times,
    oracle,
    run,
    scenes,
    stage_rows,
    two_builds,
)
from igsr_lab.bench.comparison import MIN_FLIP, gradient_error, picture_error, size_row
from igsr_lab.bench.plots import plot_speed_vs_error
from igsr_lab.bench.table import describe_machine, not_run_lines

#: A picture and a scene on which every row takes a fraction of a second.
SMALL = {"count": 300, "side": 40}
EXAMPLES = Path(__file__).parents[2] / "examples"


def small_scene(seed=3, **changes):
    return replace(scenes.ball(seed, 200, 48, 40, sh_degree=1), **changes)


def checked_row(row):
    """Check the columns of a row that ran."""
    assert row["ms"] > 0
    assert row["ms_median"] >= row["ms"]
    assert row["repeats"] >= stage_rows.MIN_REPEATS
    assert row["peak_gflops"] > 0
    assert row["error_of"] in ("picture", "gradients")
    assert 0 <= row["mean_error"] <= row["max_error"] < 1e-4
    assert 0 <= row["left_out_pixels"] <= row["band_pixels"] <= row["compared_pixels"]
    assert row["left_out_pixels"] <= max(1, row["compared_pixels"] // 1000)


def test_w1_has_the_amount_of_work_of_its_definition():
    splats = scenes.splats2d(0)
    counts = oracle.pair_counts(splats, 400, 400)
    assert counts.tiles == pytest.approx(98_500, rel=0.02)
    assert counts.pixels == pytest.approx(7.6e6, rel=0.02)
    assert 0.9 * counts.pixels < counts.blended <= counts.pixels
    assert 0.1 <= splats["opacities"].min() < splats["opacities"].max() <= 0.9


def test_the_same_seed_gives_the_same_bits():
    def everything(seed):
        arrays = list(scenes.splats2d(seed, 50, 32, 32).values())
        arrays += list(scenes.ball(seed, 50, 32, 32).splats.values())
        arrays += list(scenes.upstream(seed, 8, 9).values())
        arrays.append(growth.shot_of(seed, 20, 16).photo)
        return [array.tobytes() for array in arrays]

    assert everything(5) == everything(5)
    assert all(a != b for a, b in zip(everything(5), everything(6), strict=True))


def garden_file(path, **changes):
    """A fixture with one point."""
    arrays = {
        "means3d": np.array([[0.0, 0.0, 2.0]], np.float32),
        "colors": np.array([[255, 0, 51]], np.uint8),
        "viewmats": np.eye(4, dtype=np.float32)[None],
        "Ks": np.array([[[30.0, 0, 16], [0, 31.0, 12], [0, 0, 1]]], np.float32),
        "height": 24,
        "width": 32,
    }
    np.savez(path, **(arrays | changes))
    return path


def test_the_garden_is_read_from_the_fixture(tmp_path):
    garden = scenes.garden(garden_file(tmp_path / "garden.npz"), 0)
    assert (garden.width, garden.height) == (32, 24)
    assert garden.intrinsics.tolist() == [30.0, 31.0, 16.0, 12.0]
    np.testing.assert_allclose(garden.splats["colors"], [[1.0, 0.0, 0.2]])
    assert (garden.splats["scales"] < 0.02).all()
    rows = stage_rows.pipeline_rows("W2", garden, "cpu", 0, 0.0)
    assert [row["pass"] for row in rows] == ["forward", "backward"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (b"", "other.npz"),
        (b"not an archive", "other.npz"),
        ({"means3d": np.zeros((4, 2))}, "other.npz"),
        ({"width": 0}, "width"),
        ({"width": 99999999999}, "cannot be 99999999999"),
        ({"height": 16385}, "16384"),
        ({"viewmats": 2.0 * np.eye(4)[None]}, "viewmat"),
        ({"Ks": np.diag([-30.0, 31.0, 1.0])[None]}, "focal"),
        ({"Ks": np.full((1, 3, 3), np.nan)}, "focal"),
        ({"means3d": np.array([["a", "b", "c"]])}, "convert"),
        ({"colors": np.array([["a", "b", "c"]])}, "convert"),
        ({"means3d": np.full((1, 3), np.nan)}, "finite"),
        ({"means3d": np.full((1, 3), 1e300)}, "finite"),
        ({"means3d": np.zeros((0, 3)), "colors": np.zeros((0, 3))}, "sees none"),
        ({"means3d": np.array([[0.0, 0.0, -2.0]])}, "sees none"),
    ],
)
def test_a_garden_that_cannot_be_rendered_is_refused(tmp_path, changes, words):
    path = tmp_path / "other.npz"
    if isinstance(changes, bytes):
        path.write_bytes(changes)
    else:
        garden_file(path, **changes)
    with pytest.raises(IgsrError, match=words) as refused:
        scenes.garden(path, 0)
    assert "other.npz" in str(refused.value)
    assert "--garden" in str(refused.value)


def test_culling_changes_nothing():
    scene = small_scene(background=np.array([0.2, 0.5, 0.9], np.float32))
    v_image = scenes.upstream(1, scene.width, scene.height)
    comparison, _ = stage_rows.compare(scene, "reference", v_image)
    assert comparison.picture.max == 0.0
    assert comparison.gradients.max < 1e-12
    assert comparison.band.of == scene.width * scene.height


def test_crops_equal_their_parts_of_the_picture_and_of_the_band():
    scene = small_scene()
    exact = _core.project(*scene.arrays(np.float64), **scene.options(), backend="reference")
    shape = (scene.height, scene.width)
    crops = oracle.crops(exact, scene.width, scene.height)
    size = {"width": scene.width, "height": scene.height}
    band = _core.band_pixels(exact, **size, alpha_band=2e-2) != 0
    assert 0 < band.sum() < band.size
    assert (oracle.band(exact, crops, shape, 2e-2) == band).all()
    whole = oracle.picture(exact, crops, shape, scene.background)
    part = oracle.picture(exact, crops[2:4], shape, scene.background)
    known = np.isfinite(part["alpha"])
    assert known.sum() == sum(crop.width * crop.height for crop in crops[2:4])
    assert (part["color"][known] == whole["color"][known]).all()


def test_a_broken_renderer_shows(monkeypatch):
    sound = _core.rasterize

    def broken(*arguments, backend, **options):
        image = sound(*arguments, backend=backend, **options)
        if backend == "cpu":
            image["color"][7, 9, 1] += 0.01
        return image

    rows = stage_rows.rasterize_rows("cpu", 0, 0.0, **SMALL)
    assert rows[0]["max_error"] < 2e-6
    monkeypatch.setattr(_core, "rasterize", broken)
    rows = stage_rows.rasterize_rows("cpu", 0, 0.0, **SMALL)
    assert rows[0]["max_error"] == pytest.approx(0.01, rel=1e-3)
    assert rows[0]["mean_error"] > 0.01 / SMALL["side"] ** 2


def test_broken_gradients_show(monkeypatch):
    sound = _core.project_backward

    def broken(*arguments, backend, **options):
        v = sound(*arguments, backend=backend, **options)
        if backend == "cpu":
            v["v_quats"] = 1.01 * v["v_quats"]
        return v

    monkeypatch.setattr(_core, "project_backward", broken)
    _, backward = stage_rows.pipeline_rows("W2", small_scene(), "cpu", 0, 0.0)
    assert backward["worst"] == "v_quats"
    assert backward["max_error"] == pytest.approx(0.01, rel=0.01)


def test_nan_is_an_infinite_error():
    picture = {"color": np.zeros((2, 2, 3)), "alpha": np.zeros((2, 2))}
    picture["transmittance"] = np.ones((2, 2))
    wrong = picture | {"color": np.full((2, 2, 3), np.nan)}
    error, _ = picture_error(wrong, picture, np.zeros((2, 2), bool), 1e-6)
    assert error.max == np.inf
    assert gradient_error({"v": np.array([np.nan])}, {"v": np.array([1.0])}).max == np.inf


def test_only_pixels_of_the_band_are_left_out():
    expected = {"color": np.zeros((1, 4, 3)), "alpha": np.zeros((1, 4))}
    expected["transmittance"] = np.full((1, 4), 1e-2)
    # The third blends another pair behind something opaque: only its transmittance differs.
    got = expected | {
        "alpha": np.array([[1e-3, 1e-9, 1e-9, 1e-5]]),
        "transmittance": np.array([[1e-2, 1e-2, 1e-2 * (1.0 - 2.0 * MIN_FLIP), 0.9e-2]]),
    }
    error, band = picture_error(got, expected, np.array([[True, True, True, False]]), 1e-6)
    assert error.max == 1e-5
    assert band.left_out.tolist() == [[True, False, True, False]]
    assert (band.pixels, band.of) == (3, 4)


def test_the_loss_equals_the_fits():
    shot = growth.shot_of(2, 60, 48)
    scene = shot.scene
    running = fit_rows.fitter(shot, "cpu")
    loss = running.step(1)["loss"]
    picture = _core.rasterize(
        _core.project(*scene.arrays(np.float32), **scene.options(), backend="cpu"),
        width=scene.width,
        height=scene.height,
        background=scene.background,
        backend="cpu",
    )["color"]
    everywhere = torch.ones(scene.height, scene.width, dtype=torch.bool)
    expected = fit_rows.fit_loss(
        torch.from_numpy(picture).double(), torch.from_numpy(shot.target()), everywhere
    )
    assert loss == pytest.approx(expected.item(), rel=1e-5)


def test_a_photo_with_alpha_is_composited_over_the_background():
    scene = small_scene(background=np.array([1.0, 0.5, 0.0], np.float32))
    photo = np.zeros((40, 48, 4), np.uint8)
    photo[..., 3] = 51
    np.testing.assert_allclose(fit_rows.Shot(scene, photo).target()[0, 0], [0.8, 0.4, 0.0])


@pytest.mark.parametrize("backend", ["cpu", "gpu"])
def test_rows_of_stages(backend):
    rows = stage_rows.rasterize_rows(backend, 0, 0.0, **SMALL)
    rows += stage_rows.pipeline_rows("W2", small_scene(), backend, 0, 0.0)
    passes = ["rasterize", "rasterize_backward", "forward", "backward"]
    assert [row["pass"] for row in rows] == passes
    for row in rows:
        checked_row(row)
    if backend == "cpu":
        assert 0 < rows[0]["fraction_of_peak"] < 1
    assert rows[2]["ms"] >= 0.999 * sum(rows[2]["stages_ms"].values())


def test_rows_of_steps():
    own, loop = fit_rows.step_rows("W3", [growth.shot_of(0, 200, 48)], "cpu", 0.0)
    for row in (own, loop):
        checked_row(row)
        assert 0 <= row["picture_mean_error"] <= row["picture_max_error"] < 1e-4
    assert (own["pass"], loop["pass"]) == ("fit step", "fit step, own loop")


@pytest.mark.skipif(
    not os.access(peak_memory.CLEAR_REFS, os.W_OK),
    reason="only Linux can reset a process's peak memory",
)
def test_a_fit_keeps_its_memory_contract():
    (row,) = growth.growth_rows("cpu", 0, [(100_000, 512)], 0.0)
    checked_row(row)
    # At least parameters and moments.
    assert 3 * growth.parameter_bytes(100_000) < 100_000 * row["bytes_per_splat"]
    assert row["bytes_per_splat"] <= 1.0 * row["contract_bytes_per_splat"]


@pytest.mark.parametrize("is_on_device", [True, False])
def test_unknown_memory_is_left_out(monkeypatch, tmp_path, is_on_device):
    if is_on_device:
        monkeypatch.setattr(growth, "runs_on_cores", lambda backend: False)
    else:
        monkeypatch.setattr(peak_memory, "CLEAR_REFS", tmp_path / "nowhere" / "clear_refs")
    monkeypatch.setattr(growth, "in_a_process", lambda work, *arguments: work(*arguments))
    (row,) = growth.growth_rows("cpu", 0, [(200, 32)], 0.0)
    checked_row(row)
    assert not [name for name in row if "bytes" in name]


@pytest.mark.parametrize("error", [IgsrError("It ended early."), RuntimeError("The GPU is lost.")])
def test_a_failure_has_a_row_with_the_reason_and_other_rows_survive(monkeypatch, tmp_path, error):
    def failing(*arguments):
        raise error

    monkeypatch.setattr(growth, "in_a_process", failing)
    (row,) = growth.growth_rows("cpu", 0, [(10, 16)], 0.0)
    assert "ms" not in row
    assert str(error) in row["not_run"]
    monkeypatch.setattr(run, "growth_rows", lambda backend, seed, seconds: [{"ms": 1.0}])
    monkeypatch.setattr(run, "pair_rows", failing)
    monkeypatch.setattr(run, "rasterize_rows", lambda backend, seed, seconds: [{"ms": 2.0}])
    monkeypatch.setattr(run, "capture_rows", failing)
    monkeypatch.setattr(run, "MODEL_COUNTS", (100,))
    capture = made_up.write_capture(tmp_path / "photos", made_up.capture(views=4, size=32))
    settings = run.Settings(
        ("cpu", "reference"), ("W1", "W3", "W4"), capture=capture, models=tmp_path
    )
    rows = run.run_benchmark(settings)["rows"]
    reason, never = str(error), run.DOES_NOT_FIT
    assert [(row["ms"], row["splats"], row.get("not_run")) for row in rows] == [
        (2.0, None, None),
        (None, 100, reason),
        (1.0, None, None),
        (None, growth.PAIR[0], reason),
        (2.0, None, None),
        (None, 100, never),
        (None, None, never),
    ]
    assert all(row.keys() >= run.COLUMNS.keys() for row in rows)


def test_models_for_w3_are_fitted_once_by_seed_and_steps(tmp_path, monkeypatch):
    capture = made_up.capture(views=4, size=32)
    monkeypatch.setattr(fit_rows, "FIT_STEPS", 5)
    first = fit_rows.fitted_model(capture, 200, tmp_path, 0)
    monkeypatch.setattr(fit_rows, "fit_capture", None)
    again = fit_rows.fitted_model(capture, 200, tmp_path, 0)
    assert first.means.tobytes() == again.means.tobytes()
    paths = {fit_rows.model_path(capture, 200, tmp_path, seed) for seed in (0, 1)}
    monkeypatch.setattr(fit_rows, "FIT_STEPS", 6)
    assert fit_rows.model_path(capture, 200, tmp_path, 0) not in paths
    assert len(paths) == 2


def test_the_models_folder_is_checked_before_the_work(monkeypatch, tmp_path):
    capture = made_up.write_capture(tmp_path / "photos", made_up.capture(views=4, size=32))
    monkeypatch.setattr(run, "rasterize_rows", None)
    settings = run.Settings(
        ("cpu",), ("W1", "W3"), capture=capture, models=Path("/dev/null/models")
    )
    with pytest.raises(IgsrError, match="/dev/null/models"):
        run.run_benchmark(settings)


def test_the_page_names_every_setting(tmp_path):
    report = accuracy.measure_accuracy(("cpu",), 0, 0.0, scene=scenes.ball(0, 200, 24, 16, 4, 0.4))
    assert report.keys() == {"machine", "rows"}
    accuracy.write_accuracy(tmp_path / "accuracy.md", report)
    page = (tmp_path / "accuracy.md").read_text(encoding="utf-8")
    assert "384 of its 384 pixels are compared" in " ".join(page.split())
    assert all(len(line) <= 100 for line in page.splitlines() if not line.startswith("|"))
    for degree in range(5):
        assert f"| SH degree {degree} | cpu |" in page
    assert "| SH degree 4, antialiased | cpu |" in page
    errors = [row["setting_mean_error"] for row in report["rows"][::2]]
    assert errors[0] > errors[3] > 0
    assert errors[5] < errors[4]
    assert Image.open(tmp_path / accuracy.PLOT_NAME).width > 500


def test_two_builds_take_turns(tmp_path):
    copy = shutil.copy(_core.__file__, tmp_path / "_core.abi3.so")
    report = two_builds.compare_builds(Path(copy), ("cpu",), ("W1",), 0, 0.0, rounds=2)
    assert report["machine"]["protocol"] == two_builds.PAIR_PROTOCOL
    assert [row["pass"] for row in report["rows"]] == ["rasterize", "rasterize_backward"]
    for row in report["rows"]:
        assert 0.2 < row["ratio_least"] <= row["ratio"] <= row["ratio_most"] < 5.0
        assert 0.0 < row["mean_error_old"] == row["mean_error_new"] < 1e-5
        assert row["max_error_old"] == row["max_error_new"] < 1e-4


def test_another_build_replaces_the_packages(tmp_path):
    copy = str(shutil.copy(_core.__file__, tmp_path / "_core.abi3.so"))
    code = (
        "import sys; from igsr_lab.other_build import use_build; use_build(sys.argv[1]);"
        "from igsr_lab.bench import fit_rows, stage_rows, two_builds;"
        "print({module._core.__file__ for module in (fit_rows, stage_rows, two_builds)});"
        "use_build(sys.argv[1])"
    )
    done = subprocess.run([sys.executable, "-c", code, copy], capture_output=True, text=True)
    assert done.stdout.strip() == str({copy})
    assert "in use already" in done.stderr


def test_failing_and_slower_builds_are_named():
    def build(answer):
        return SimpleNamespace(ask=lambda *question: answer)

    sound, failing = build({"fit step": [1.0, 2.0]}), build({"failed": "ValueError: no"})
    size = {"workload": "W4", "splats": 5, "backend": "cpu"}
    for name, old, new in (("old", failing, sound), ("new", sound, failing)):
        rows = two_builds.pair_rows(size, old, new, "W4 5 8", 0.0, 2)
        assert [row["not_run"] for row in rows] == [f"the {name} build failed: ValueError: no"]
        slower = [] if name == "old" else [f"W4 with 5 splats on cpu: {rows[0]['not_run']}."]
        assert two_builds.slower_rows(rows, 10.0) == slower

    size = {"splats": 5, "width": 8, "height": 8, "backend": "cpu", "workload": "W1"}
    rows = [{**size, "pass": name, "ratio": ratio} for name, ratio in (("a", 0.92), ("b", 0.8))]
    assert two_builds.slower_rows(rows, 10.0) == [
        "W1 b with 5 splats at 8 x 8 on cpu takes 25 % longer."
    ]


def test_bench_writes_machine_and_rows(lab_here, tmp_path):
    arguments = ["--backend", "cpu", "--workload", "W1", "--workload", "W2", "--workload", "W3"]
    files = ["--json", tmp_path / "rows.json", "--plot", tmp_path / "plot.png"]
    done = lab_here("bench", *arguments, "--seconds", "0", *files)
    assert done.returncode == 0, done.stderr
    report = json.loads((tmp_path / "rows.json").read_text())
    assert report.keys() == {"machine", "rows"}
    assert report["machine"].keys() >= {"igsr", "seed", "protocol", "threads", "peak_gflops"}
    assert "instruction_set" in report["machine"]["backends"]["cpu"]
    for row in report["rows"]:
        assert row.keys() >= run.COLUMNS.keys()
        assert (row["ms"] is None) == ("not_run" in row)
        assert (row["max_error"] is None) == (row["mean_error"] is None) == (row["ms"] is None)
    ran = [row for row in report["rows"] if row["ms"] is not None]
    assert [row["pass"] for row in ran] == ["rasterize", "rasterize_backward"]
    for row in ran:
        checked_row(row)
    lines = not_run_lines(report["rows"])
    assert len(lines) == 3
    assert "--garden" in lines[0]
    assert "--capture" in lines[1]
    assert all(line in done.stdout for line in lines)
    assert Image.open(tmp_path / "plot.png").width > 500


def test_a_profile_has_the_kernels_of_a_fit_step(lab_here, tmp_path, monkeypatch):
    for name in ("SIZES", "SMALL_SIZES"):
        monkeypatch.setattr(kernel_times, name, ((200, 32),))
    done = lab_here("bench", "--profile", "--json", tmp_path / "kernels.json")
    assert done.returncode == 0, done.stderr
    assert "200 splats, 32x32: " in done.stdout
    (table,) = json.loads((tmp_path / "kernels.json").read_text())["kernels"]
    calls = {row["name"]: row["calls"] for row in table["kernels"]}
    assert calls["rasterize_backward"] == calls["fit_geometry"] == 1
    # Five inputs of the step, and the photo.
    assert calls["copy"] == 6
    assert sum(count for name, count in calls.items() if name.startswith("sort_")) >= 12
    assert all(row["median"] >= row["least"] >= 0.0 for row in table["kernels"])
    assert all(name in done.stdout for name in calls)
    medians = [row["median"] for row in table["kernels"]]
    assert medians == sorted(medians, reverse=True)
    assert table["device_ms"] == pytest.approx(sum(medians), rel=0.5)


W3 = ["--workload", "W3"]
PAGE = ["--accuracy", "page.md"]
BUILD = ["--compare", "a.so"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*W3, "--garden", "nowhere.npz"], "nowhere.npz"),
        ([*W3, "--capture", "nowhere"], "nowhere"),
        ([*W3, "--seconds", "-1"], "--seconds"),
        ([*W3, "--seconds", "nan"], "--seconds"),
        ([*W3, "--seed", "-1"], "--seed"),
        ([*W3, "--json", "/dev/null/rows.json"], "rows.json"),
        ([*PAGE, *W3], "--accuracy runs no workloads; leave --workload out"),
        ([*PAGE, "--garden", "a.npz"], "leave --garden out"),
        ([*PAGE, "--capture", "a"], "leave --capture out"),
        ([*PAGE, "--models", "a"], "leave --models out"),
        (["--profile", "--garden", "a.npz"], "--profile runs no workloads; leave --garden out"),
        (["--fail-above", "10"], "--compare FILE"),
        ([*BUILD, "--fail-above", "-1"], "--fail-above"),
        ([*BUILD, *W3], "leave W2 and W3 out"),
        ([*BUILD, "--plot", "p.png"], "leave --plot out"),
        ([*BUILD, "--workload", "W1"], "could not be run"),
        (["--compare", "none.so"], "no file none.so; give --compare"),
    ],
)
def test_a_bad_argument_is_one_sentence(lab_here, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("a.so").write_bytes(b"not a module")
    done = lab_here("bench", "--backend", "cpu", *arguments)
    assert (done.returncode, done.stdout) == (1, "")
    assert words in done.stderr
    assert done.stderr.endswith(".\n")
    assert done.stderr.count("\n") == 1


def test_an_unknown_workload_is_refused(lab_here):
    done = lab_here("bench", "--workload", "W9")
    assert done.returncode == 2
    assert "W9" in done.stderr


@pytest.mark.parametrize(
    "memory", [{"bytes_per_splat": 900.0, "contract_bytes_per_splat": 760.0}, {}]
)
def test_growth_is_plotted(tmp_path, memory):
    rows = [
        {**size_row("W4", "cpu", count, side, side), "ms": 1.0 * count * side, **memory}
        for count, side in growth.points()
    ]
    report = {"machine": describe_machine(["cpu"], 0), "rows": rows}
    plot_speed_vs_error(tmp_path / "growth.png", report)
    assert Image.open(tmp_path / "growth.png").width > 500


def test_the_peak_needs_a_valid_time():
    assert _core.peak_multiply_add(0.001) > 0.1
    for seconds in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match="seconds"):
            _core.peak_multiply_add(seconds)


def test_the_example_with_a_custom_loss_learns(tmp_path, monkeypatch, capsys):
    capture = made_up.write_capture(tmp_path, made_up.capture(views=4, size=32))

    def psnr_after(steps):
        arguments = [capture, "--backend", "cpu", "--splats", 300, "--steps", steps]
        monkeypatch.setattr(sys, "argv", ["own_loss.py", *map(str, arguments)])
        runpy.run_path(str(EXAMPLES / "own_loss.py"), run_name="__main__")
        return float(capsys.readouterr().out.split("PSNR ")[1].split(" dB")[0])

    assert psnr_after(60) > psnr_after(1) + 1.0
