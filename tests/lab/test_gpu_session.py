"""``python -m igsr_lab gpu-session``: its report, and parts that fail."""

import json
import re
import time
from functools import partial

import pytest
import session_parts

from igsr_lab.bench import gpu_session, gsplat_rows, viewer_rows
from igsr_lab.bench.kernel_bytes import kernel_bytes
from igsr_lab.limited_parts import Part


def test_a_session_has_kernels_frames_and_steps_with_errors(lab_here, tmp_path, monkeypatch):
    for name in ("SIZES", "SMALL_SIZES"):
        monkeypatch.setattr(gpu_session, name, ((200, 32),))
    for name in ("SPLATS", "SMALL_SPLATS"):
        monkeypatch.setattr(viewer_rows, name, 300)
    monkeypatch.setattr(gpu_session, "FRAMES", ((64, 48),))
    monkeypatch.setattr(gpu_session, "SECONDS", 0.0)
    # In this process, which has imported everything.
    monkeypatch.setattr(gpu_session, "run_part", lambda part: (list(part.work()), None))
    done = lab_here("gpu-session", "--out", tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    page = (tmp_path / "report.html").read_text()
    names = ["device", "kernels", "kernels with checks", "viewer", "steps with errors", "gsplat"]
    assert [part["name"] for part in report["parts"]] == names
    assert sum(part["limit_s"] for part in report["parts"]) <= 460.0
    assert report["machine"]["seed"] == 0
    assert report["machine"]["protocol"].endswith(gpu_session.PROTOCOL)
    assert all(report["device"][key] in page for key in ("name", "driver_info", "kernels"))
    for entry in ("kernels", "checked"):
        assert [table["splats"] for table in report[entry]] == [200]
        for table in report[entry]:
            rows = {row["name"]: row for row in table["kernels"]}
            backward = rows["rasterize_backward"]
            assert backward["median"] >= backward["least"] > 0.0
            assert backward["gb_per_s"] == pytest.approx(backward["mb"] / backward["median"])
            assert backward["mb"] > 20 * 32**2 / 1e6
            assert rows["copy"]["mb"] is None
            assert f">{backward['median']:.3f}</td>" in page
    assert page.count("data:image/png;base64,") == 1
    assert not re.search(r"(src|href)=\"(?!data:)", page)
    ran = [row for row in report["rows"] if row["ms"] is not None and row["backend"] == "gpu"]
    expected = [("viewer", "frame by blend"), ("viewer", "frame by rasterize"), ("W4", "fit step")]
    assert [(row["workload"], row["pass"]) for row in ran] == expected
    assert all(row["ms_median"] >= row["ms"] > 0.0 for row in ran)
    assert 0.0 < ran[2]["max_error"] < 1e-3
    if gsplat_rows.why_not():
        assert f"W4 on gsplat not run: {gsplat_rows.why_not()}" in page


def test_a_part_that_fails_is_named_and_the_rest_runs(lab_here, tmp_path, monkeypatch):
    sign = tmp_path / "sign"
    parts = [
        Part("raises", 60.0, session_parts.fails),
        Part("hangs", 5.0, partial(session_parts.hangs, sign)),
        Part("leaves out", 60.0, session_parts.leaves_a_row_out),
        Part("gsplat", 60.0, session_parts.leaves_a_row_out),
        Part("crashes", 60.0, session_parts.crashes),
        Part("infinite", 60.0, session_parts.not_a_number),
        Part("ends well", 60.0, partial(session_parts.variable, "MADE_UP"), {"MADE_UP": "set"}),
    ]
    monkeypatch.setattr(gpu_session, "DEVICE", Part("device", 60.0, session_parts.fails))
    monkeypatch.setattr(gpu_session, "plan", lambda small, seed: parts)
    written = []
    write = gpu_session.write_device_report

    def write_and_count(path, report):
        write(path, report)
        written.append(len(json.loads((tmp_path / "report.json").read_text())["parts"]))

    monkeypatch.setattr(gpu_session, "write_device_report", write_and_count)
    done = lab_here("gpu-session", "--out", tmp_path)
    assert done.returncode == 1
    lost = "the <device> is lost"
    report = json.loads((tmp_path / "report.json").read_text())
    errors = {part["name"]: part["error"] for part in report["parts"]}
    infinite = errors.pop("infinite")
    assert infinite.startswith("ValueError: Out of range float values")
    assert errors == {
        "device": lost,
        "raises": lost,
        "hangs": "It did not end within 5 s.",
        "leaves out": "it does not fit",
        "gsplat": None,
        "crashes": "Its process ended with status 7.",
        "ends well": None,
    }
    page = (tmp_path / "report.html").read_text()
    assert all(error is None or f"{name}: {error}" in done.stdout for name, error in errors.items())
    assert page.count("the &lt;device&gt; is lost") == 2
    assert "The device did not answer." in page
    rows = [row["pass"] for row in report["rows"] if row["pass"]]
    assert rows == [*["before the error"] * 2, "before the hang", "MADE_UP is set"]
    assert written == [1, 2, 3, 4, 5, 6, 7, 8], "the report is not written after every part"
    size = sign.stat().st_size
    time.sleep(0.2)
    assert sign.stat().st_size == size, "the child of a killed part runs"


def test_traffic_is_that_of_the_documentation():
    moved = kernel_bytes(5_000_000, 1_500_000, 6_000_000, 1297 * 840, 16)
    groups = {  # GB of docs/how-it-works/gpus.md
        ("project",): 2.18,
        ("sort_count", "sort_place"): 0.39,
        ("tile_counts", "scan_apply", "emit", "ranges"): 0.35,
        ("rasterize",): 0.33,
        ("loss_slopes", "loss_gradient"): 0.14,
        ("rasterize_backward", "rasterize_backward_sum"): 0.98,
        ("fit_geometry",): 1.88,
    }
    assert {name for names in groups for name in names} == moved.keys()
    for names, gigabytes in groups.items():
        assert sum(moved[name] for name in names) / 1e9 == pytest.approx(gigabytes, rel=0.03)
