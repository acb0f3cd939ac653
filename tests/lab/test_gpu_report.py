"""``python -m igsr_lab bench --report`` and ``gpu-check``: the page about a GPU and its figures."""

import json
import sys
import time
import types

import pytest
import torch

import igsr
from igsr import _core
from igsr.errors import IgsrError
from igsr_lab import bench as benchmark
from igsr_lab.bench import gpu_report, gsplat_rows, kernel_times, run, viewer_rows
from igsr_lab.bench.growth import shot_of
from igsr_lab.bench.scenes import upstream
from igsr_lab.commands import gpu_check


@pytest.fixture
def small(monkeypatch):
    """Small scenes."""
    monkeypatch.setattr(gpu_report, "GROWN_COUNT", 200)
    monkeypatch.setattr(gpu_report, "GROWN_SIDE", 32)
    monkeypatch.setattr(gpu_report, "SMALL_BALL", (200, 32))
    monkeypatch.setattr(kernel_times, "SIZES", ((200, 32),))
    monkeypatch.setattr(kernel_times, "SMALL_SIZES", ((200, 32),))
    monkeypatch.setattr(gpu_report, "SIZES_OF_STEPS", ((200, 32),))
    monkeypatch.setattr(gpu_report, "SIZES", ((64, 48),))
    monkeypatch.setattr(viewer_rows, "SPLATS", 300)
    monkeypatch.setattr(viewer_rows, "SMALL_SPLATS", 300)


def report_of(tmp_path, workload, tests=None):
    settings = benchmark.Settings(backends=("gpu",), workloads=(workload,), seconds=0.0)
    report = benchmark.device_report(settings)
    path = tmp_path / "report.html"
    benchmark.write_device_report(path, {**report, "tests": tests})
    return path.read_text(), json.loads(path.with_suffix(".json").read_text())


def test_the_page_has_the_device_times_errors_and_failed_tests(small, tmp_path):
    tests = {"command": "cargo", "passed": 3, "failed": ["a_test"], "seconds": 1.0, "error": "<b>"}
    page, figures = report_of(tmp_path, "W2", tests)
    assert all(words in page for words in ("1 failed", "a_test", "&lt;b&gt;"))
    assert figures["tests"] == tests
    device = figures["device"]
    assert device["name"] in page
    assert device["driver_info"] in page
    assert device["limits"]["maxStorageBuffersPerShaderStage"] == 8
    for name, value in device["limits"].items():
        assert f"<dt>{name}</dt><dd>{value}</dd>" in page
    assert device["start"]["compile_ms"] > 0.0
    passes = {row["pass"] for row in figures["rows"] if row["workload"] == "ball" and row["ms"]}
    assert passes == {"forward", "backward"}
    for row in figures["rows"]:
        if row["ms"] is not None and row["workload"] != "viewer":
            assert row["max_error"] < 1e-3
            assert f"{row['max_error']:.1e}" in page
    (table,) = figures["kernels"]
    assert table["ms"] > 0.0
    assert "<td>rasterize_backward</td>" in page
    (frame,) = (row for row in figures["rows"] if row["workload"] == "viewer")
    assert frame["ms_median"] >= frame["ms"] > 0.0
    assert (frame["splats"], frame["width"], frame["height"]) == (300, 64, 48)
    assert {"project", "sort"} <= frame["stages_ms"].keys()
    assert frame["off_of_255"] <= 4
    assert "W2 on gpu not run: it needs gsplat" in page
    if gsplat_rows.why_not():
        assert f"ball on gsplat not run: {gsplat_rows.why_not()}" in page


def test_a_software_driver_has_a_small_w4(small, monkeypatch, tmp_path):
    ran = []

    def rows(backend, seed, grid=None, seconds=0.0, name="W4"):
        ran.append((grid, name))
        return [run.not_run(name, backend, "only asked")]

    monkeypatch.setattr(run, "growth_rows", rows)
    monkeypatch.setattr(run, "pair_rows", lambda backend, seed, seconds: [])
    page, _ = report_of(tmp_path, "W4")
    if _core.gpu_report()["kind"] == gpu_report.SOFTWARE:
        assert ran == [(run.SMALL_POINTS, "W4 small")]
        assert "W4 small on gpu not run: only asked" in page
    monkeypatch.setattr(gpu_report, "SOFTWARE", "none")
    ran.clear()
    report_of(tmp_path, "W4")
    assert ran == [(None, "W4")]


def test_a_failing_viewer_is_one_message(monkeypatch):
    monkeypatch.setattr(viewer_rows, "SMALL_SPLATS", 10)
    with pytest.raises(IgsrError, match=r"size: .*0x48"):
        viewer_rows.viewer_rows((0, 48), 0, True)
    monkeypatch.setattr(viewer_rows, "TIMEOUT_SECONDS", 0.0)
    with pytest.raises(IgsrError, match="took longer than 0 s"):
        viewer_rows.viewer_rows((64, 48), 0, True)


def test_the_page_has_the_reason_for_no_device_and_ends_in_html(monkeypatch, tmp_path):
    why = "backend gpu: no adapter answers"

    def fails():
        raise RuntimeError(why)

    monkeypatch.setattr(_core, "gpu_report", fails)
    device = gpu_report.describe_device()
    assert device == {"name": None, "error": why}
    machine = benchmark.run_benchmark(benchmark.Settings(("cpu",), ()))["machine"]
    path = tmp_path / "report.html"
    benchmark.write_device_report(path, {"device": device, "machine": machine, "rows": []})
    assert why in path.read_text()
    with pytest.raises(IgsrError, match=r"ends in \.html"):
        benchmark.json_beside(tmp_path / "report.json")


PRINTS = """
print("test first ... ok")
print("test second ... noise")
print("FAILED")
print("test third ... ", end="", flush=True)
"""


def test_hanging_tests_are_killed_and_named(tmp_path):
    # cargo's child hangs and keeps cargo's output open.
    sign = tmp_path / "sign"
    child = f"import time\nwhile True: open({str(sign)!r}, 'a').write('.'); time.sleep(0.02)"
    waits = f"{PRINTS}\nimport subprocess, sys; subprocess.run([sys.executable, '-c', {child!r}])"
    found = gpu_check.run_tests([sys.executable, "-c", waits], timeout=4.0)
    assert found["passed"] == 1
    assert found["failed"] == ["second", "third did not end within 4 s; nothing ran after"]
    assert found["seconds"] >= 4.0
    written = sign.stat().st_size
    time.sleep(0.5)
    assert sign.stat().st_size == written > 0, "the child was not killed"


def test_failed_tests_are_named():
    ends = PRINTS + "print('ok'); raise SystemExit(101)"
    found = gpu_check.run_tests([sys.executable, "-c", ends])
    assert (found["passed"], found["failed"], found["error"]) == (2, ["second"], "")
    assert found["command"].endswith(" -- --test-threads=1")
    crashed = "import sys; print('test first ... ok'); sys.exit('no device')"
    found = gpu_check.run_tests([sys.executable, "-c", crashed])
    assert found["failed"] == ["the tests did not run"]
    assert "no device" in found["error"]


def test_gsplat_gets_the_scene_and_its_rows_have_errors(monkeypatch):
    gsplat = types.SimpleNamespace(__version__="0", rasterization=igsr.rasterization)
    monkeypatch.setitem(sys.modules, "gsplat", gsplat)
    shot = shot_of(0, 30, 16)
    monkeypatch.setattr(gsplat_rows.importlib.util, "find_spec", lambda name: None)
    arguments = ("ball", shot.scene, upstream(0, 16, 16), 0.0, "cpu")
    picture, gradients, step = gsplat_rows.gsplat_rows(*arguments, photo=shot.photo)
    kinds = ("forward", "backward", "fit step")
    for row, kind in zip((picture, gradients, step), kinds, strict=True):
        assert (row["pass"], row["backend"]) == (kind, "gsplat")
        assert row["ms"] > 0.0
    assert step["loss"] == "conv2d"
    assert step["max_error"] == gradients["max_error"]
    assert len(gsplat_rows.gsplat_rows(*arguments)) == 2, "without a photo, no step"
    assert picture["error_of"] == "picture"
    assert 0.0 < picture["max_error"] < 1e-5
    assert gradients["error_of"] == "gradients"
    assert 0.0 < gradients["max_error"] < 1e-4
    assert gradients["worst"].startswith("v_")

    def fused_ssim(one, other):
        assert one.shape == other.shape == (1, 3, 16, 16)
        return torch.ones(())

    monkeypatch.setitem(sys.modules, "fused_ssim", types.SimpleNamespace(fused_ssim=fused_ssim))
    monkeypatch.setattr(gsplat_rows.importlib.util, "find_spec", lambda name: name)
    name, loss = gsplat_rows.step_loss()
    picture, photo = torch.full((16, 16, 3), 0.5), torch.zeros(16, 16, 3)
    assert (name, float(loss(picture, photo))) == ("fused_ssim", pytest.approx(0.8 * 0.5))

    def fails(**given):
        raise TypeError("unexpected keyword")

    gsplat.rasterization = fails
    with pytest.raises(IgsrError, match="gsplat 0 failed: unexpected keyword"):
        gsplat_rows.gsplat_rows(*arguments)
