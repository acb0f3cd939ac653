"""The ``igsr`` command as a user runs it: files, exit codes, one sentence where it fails."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
import zlib

import av
import numpy as np
import pytest
import scenes
from PIL import Image

import igsr

COMMAND = [sys.executable, "-m", "igsr.cli"]
FIT = ["--steps", "60", "--max-splats", "300", "--sh-degree", "1", "--backend", "cpu"]


def igsr_command(*arguments, **options):
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)


def refused(result, *words, code=1):
    """Assert that a command ended with one sentence on stderr that holds the words."""
    lines = result.stderr.splitlines()
    assert result.returncode == code, result.stderr
    assert len(lines) == 1, result.stderr
    for word in words:
        assert str(word) in lines[0]
    assert lines[0].endswith(".")
    assert result.stdout == ""


def test_it_says_which_igsr_it_is():
    result = igsr_command("--version")
    assert (result.returncode, result.stdout) == (0, f"igsr {igsr.__version__}\n")
    without = igsr_command()
    assert without.returncode == 2
    assert "refine" in without.stdout


@pytest.fixture(scope="module")
def capture_path(tmp_path_factory):
    return scenes.write_capture(
        tmp_path_factory.mktemp("capture"), scenes.capture(views=8, size=40, alpha=True)
    )


@pytest.fixture(scope="module")
def fitted(capture_path, tmp_path_factory):
    out = tmp_path_factory.mktemp("fitted")
    result = igsr_command("fit", capture_path, "--out", out, "--holdout", 4, *FIT)
    assert result.returncode == 0, result.stderr
    return out, result


def test_fit_writes_scene_report_views_and_checkpoint(fitted):
    out, result = fitted
    assert sorted(path.name for path in out.iterdir()) == [
        "cameras.json",
        "checkpoint.npz",
        "report.html",
        "report.json",
        "scene.html",
        "scene.ply",
        "view",
        "views.png",
    ]
    report = json.loads((out / "report.json").read_text())
    assert report["splats"] == len(igsr.Splats.load(out / "scene.ply")) <= 300
    assert report["steps"] == 60
    assert report["backend"] == "cpu"
    assert report["instruction_set"]
    assert report["seed"] == 0
    assert report["seconds"] > 0
    assert report["version"] == igsr.__version__
    assert report["protocol"]["split"] == "test"
    assert report["protocol"]["holdout"] == 4
    assert report["protocol"]["background"] == [1.0, 1.0, 1.0]
    assert [row["name"] for row in report["views"]] == ["photos/00.png", "photos/04.png"]
    assert report["psnr"] == pytest.approx(np.mean([row["psnr"] for row in report["views"]]))
    assert report["ms_ssim"] is None  # 40 pixels are too small for it
    assert f"PSNR {report['psnr']:.2f} dB" in result.stdout
    assert (report["start"], report["start_splats"]) == ("hull", 300)
    assert "initialization: hull, 300 points" in result.stdout
    assert "over white" in result.stdout
    assert report["train"]["views"] == report["train"]["of"] == 6
    assert report["train"]["psnr"] > 10.0
    assert f"fitted photos: PSNR {report['train']['psnr']:.2f} dB" in result.stdout
    assert report["limit"]["sentence"] in result.stdout.replace("\n", " ")
    assert list(report["parts"]) == ["load", "fit", "score"]
    assert all(part["peak_memory_bytes"] > 2**20 for part in report["parts"].values())
    assert report["peak_memory_bytes"] == max(
        part["peak_memory_bytes"] for part in report["parts"].values()
    )
    assert report["photos"] == {
        "given": 8, "placed": 8, "train": 6, "test": 2, "not_placed": [],
    }  # fmt: skip
    page = (out / "report.html").read_text()
    assert page.count("data:image/jpeg;base64,") == 3 * 2
    assert report["limit"]["sentence"] in page
    assert "://" not in page
    sheet = Image.open(out / "views.png")
    assert sheet.width > 3 * 40
    assert sheet.height > 2 * 40


def test_eval_gives_the_scores_of_the_report(fitted, capture_path):
    out, _ = fitted
    report = json.loads((out / "report.json").read_text())
    result = igsr_command(
        "eval", out / "scene.ply", capture_path, "--holdout", 4, "--backend", "cpu", "--json"
    )
    assert result.returncode == 0, result.stderr
    scores = json.loads(result.stdout)
    for name in ("psnr", "ssim", "ms_ssim", "flip", "views", "protocol"):
        assert scores[name] == report[name]


def test_json_output_is_one_object_and_no_bar(capture_path, tmp_path):
    result = igsr_command(
        "fit", capture_path, "--out", tmp_path, "--steps", 5, "--backend", "cpu", "--json"
    )
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout) == json.loads((tmp_path / "report.json").read_text())
    assert "steps/s" not in result.stderr
    report = json.loads(result.stdout)
    assert report["protocol"]["split"] == "train"  # nothing was held out


def test_render_writes_the_pictures_that_render_makes(fitted, capture_path, tmp_path):
    out, _ = fitted
    result = igsr_command(
        "render", out / "scene.ply", "--cameras", capture_path, "--out", tmp_path,
        "--background", "0.2,0.4,0.6", "--backend", "cpu", "--json",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    files = json.loads(result.stdout)["files"]
    capture = igsr.load_capture(capture_path)
    assert len(files) == len(capture.views)
    splats = igsr.Splats.load(out / "scene.ply")
    expected = igsr.render(splats, capture.views[3].camera, (0.2, 0.4, 0.6), "cpu").to_uint8()
    assert np.array_equal(np.asarray(Image.open(tmp_path / "photos" / "03.png")), expected)


def test_render_exr_holds_floats_and_depth(fitted, capture_path, tmp_path):
    out, _ = fitted
    result = igsr_command(
        "render", out / "scene.ply", "--cameras", capture_path, "--out", tmp_path, "--exr",
        "--backend", "cpu",
    )  # fmt: skip
    assert result.returncode == 0, result.stderr
    path = tmp_path / "photos" / "03.exr"
    capture = igsr.load_capture(capture_path)
    splats = igsr.Splats.load(out / "scene.ply")
    expected = igsr.render(splats, capture.views[3].camera, (1.0, 1.0, 1.0), "cpu")
    channels = read_exr(path.read_bytes())
    assert sorted(channels) == ["A", "B", "G", "R", "Z"]
    color = np.stack([channels[name] for name in "RGB"], axis=-1)
    assert np.array_equal(color, expected.color)
    assert np.array_equal(channels["A"], expected.alpha)
    assert np.array_equal(channels["Z"], expected.expected_depth)
    with av.open(str(path)) as container:  # and another program's reader agrees
        frame = next(container.decode(video=0))
    assert np.array_equal(frame.to_ndarray()[..., :3], expected.color)


def read_exr(content):
    """Channels of a zipped float scan-line OpenEXR file, by the format's description."""
    assert content[:4] == bytes([0x76, 0x2F, 0x31, 0x01])
    at, attributes = 8, {}
    while content[at] != 0:
        name, _, rest = content[at:].partition(b"\0")
        kind = rest.partition(b"\0")[0]
        at += len(name) + len(kind) + 2
        size = int.from_bytes(content[at : at + 4], "little")
        attributes[name] = content[at + 4 : at + 4 + size]
        at += 4 + size
    names, listing = [], attributes[b"channels"]
    while listing[0] != 0:
        name, _, rest = listing.partition(b"\0")
        assert int.from_bytes(rest[:4], "little") == 2  # float
        names.append(name.decode())
        listing = rest[16:]
    x0, y0, x1, y1 = np.frombuffer(attributes[b"dataWindow"], "<i4")
    width, height = x1 - x0 + 1, y1 - y0 + 1
    assert attributes[b"compression"] == b"\3"  # blocks of 16 lines
    picture = np.zeros((height, len(names), width), "<f4")
    offsets = np.frombuffer(content, "<u8", count=-(-height // 16), offset=at + 1)
    for offset in map(int, offsets):
        y, size = np.frombuffer(content, "<i4", count=2, offset=offset)
        data = content[offset + 8 : offset + 8 + size]
        block = picture[y - y0 : y - y0 + 16]
        if size < block.nbytes:
            coded = np.frombuffer(zlib.decompress(data), np.uint8).astype(np.int64)
            coded[1:] -= 128
            split = np.cumsum(coded).astype(np.uint8)
            whole = np.empty_like(split)
            whole[0::2], whole[1::2] = np.split(split, [(len(split) + 1) // 2])
            data = whole.tobytes()
        block[:] = np.frombuffer(data, "<f4").reshape(block.shape)
    return {name: picture[:, i] for i, name in enumerate(names)}


@pytest.mark.parametrize("with_cameras", [False, True])
def test_orbit_writes_a_video(fitted, capture_path, tmp_path, with_cameras):
    out, _ = fitted
    video = tmp_path / "orbit.mp4"
    cameras = ["--cameras", capture_path] if with_cameras else []
    result = igsr_command(
        "render", out / "scene.ply", "--orbit", 6, *cameras, "--out", video, "--backend", "cpu"
    )
    assert result.returncode == 0, result.stderr
    with av.open(str(video)) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == 6
    assert frames[0].shape == ((40, 40, 3) if with_cameras else (600, 800, 3))
    # The scene is in every frame, and turns.
    background = 255 if with_cameras else 0
    for frame in frames:
        assert (np.abs(frame.astype(int) - background) > 40).any()
    assert not np.array_equal(frames[0], frames[3])


def test_info_describes_scenes_captures_and_backends(fitted, capture_path):
    out, _ = fitted
    scene = json.loads(igsr_command("info", out / "scene.ply", "--json").stdout)
    assert scene["kind"] == "scene"
    assert scene["sh_degree"] == 1
    assert scene["splats"] == len(igsr.Splats.load(out / "scene.ply"))
    capture = json.loads(igsr_command("info", capture_path, "--json").stdout)
    assert capture["kind"] == "capture"
    assert capture["views"] == capture["views_with_alpha"] == 8
    assert capture["sizes"] == ["40x40"]
    for report in (scene, capture):
        assert set(report["backends"]) == {"cpu", "gpu", "reference", "auto"}
    assert "splats:" in igsr_command("info", out / "scene.ply").stdout


def test_info_counts_splats_that_are_not_finite(tmp_path, igsr_here):
    splats = scenes.splats()
    splats.means[3] = np.nan
    splats.opacities[4] = np.inf
    splats.save(tmp_path / "scene.ply")
    report = json.loads(igsr_here("info", tmp_path / "scene.ply", "--json").stdout)
    assert report["not_finite"] == 2
    kept = splats.means[splats.finite]
    assert report["lowest_corner"] == kept.min(axis=0).astype(float).tolist()
    assert 0.5 < report["median_opacity"] < 1.0


def started_fit(capture_path, out, *options):
    """A long fit in a process of its own, once it has written a checkpoint."""
    arguments = ["fit", capture_path, "--out", out, "--steps", 200_000, "--max-splats", 300]
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments), "--backend", "cpu", *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in the background of a shell, children would ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not (out / "checkpoint.npz").exists():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return process


def test_interrupt_saves_says_so_and_resumes(capture_path, tmp_path):
    process = started_fit(capture_path, tmp_path, "--json")
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    result = subprocess.CompletedProcess([], process.returncode, stdout, stderr)
    refused(result, "Interrupted at step", "--resume", code=130)
    assert not (tmp_path / "scene.ply").exists()
    resumed = igsr_command(
        "fit", capture_path, "--out", tmp_path, "--steps", 7, "--resume", "--max-splats", 300,
        "--backend", "cpu", "--json",
    )  # fmt: skip
    refused(resumed, "checkpoint.npz", "steps")


def test_resume_of_a_finished_fit_scores_it_again(fitted, capture_path):
    out, _ = fitted
    before = (out / "scene.ply").read_bytes()
    report = json.loads((out / "report.json").read_text())
    result = igsr_command("fit", capture_path, "--out", out, "--holdout", 4, *FIT, "--resume")
    assert result.returncode == 0, result.stderr
    assert (out / "scene.ply").read_bytes() == before
    again = json.loads((out / "report.json").read_text())
    assert again["seconds"] == pytest.approx(report["seconds"], abs=0.01)
    measured = ("seconds", "parts", "peak_memory_bytes")
    assert again == {**report, **{name: again[name] for name in measured}}


def test_full_disk_is_a_sentence_and_keeps_the_old_files(fitted, capture_path, tmp_path):
    out, _ = fitted
    shutil.copytree(out, tmp_path, dirs_exist_ok=True)

    def contents():
        # view/ is of the run that is under way, or was the last.
        files = (path for path in tmp_path.iterdir() if path.is_file())
        return {path: path.read_bytes() for path in files}

    before = contents()

    def small_files_only():
        # The kernel refuses larger files as it would on a full disk, with EFBIG.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    result = igsr_command(
        "fit", capture_path, "--out", tmp_path, *FIT, "--seed", 5, "--json",
        preexec_fn=small_files_only,
    )  # fmt: skip
    assert "scene.ply" in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
    assert result.returncode == 1
    assert contents() == before
    result = igsr_command(
        "render", out / "scene.ply", "--orbit", 4, "--out", tmp_path / "orbit.mp4",
        "--backend", "cpu", preexec_fn=small_files_only,
    )  # fmt: skip
    refused(result, "orbit.mp4")
    result = igsr_command(
        "render", out / "scene.ply", "--cameras", capture_path, "--exr", "--out", tmp_path / "exr",
        "--backend", "cpu", preexec_fn=small_files_only,
    )  # fmt: skip
    refused(result, "00.exr: File too large")
    assert "unfinished" not in result.stderr, "a temporary name is nobody's business"
    assert not (tmp_path / "orbit.mp4").exists()
    assert not any(path.is_file() for path in (tmp_path / "exr").rglob("*"))


def test_out_that_cannot_be_a_folder(capture_path, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    refused(igsr_command("fit", capture_path, "--out", blocked, *FIT, "--json"), blocked)
    assert blocked.read_text() == "not a folder"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "nowhere", "--out", "out"], ["nowhere"]),
        (["fit", "{capture}", "--out", "out", "--steps", "0"], ["steps"]),
        (["fit", "{capture}", "--out", "out", "--seed", "-1"], ["seed"]),
        (["fit", "{capture}", "--out", "out", "--sh-degree", "7"], ["sh_degree"]),
        (["fit", "{capture}", "--out", "out", "--holdout", "1"], ["holdout"]),
        (["fit", "{capture}", "--out", "out", "--background", "mauve"], ["--background", "mauve"]),
        (["fit", "{capture}", "--out", "out", "--resume"], ["checkpoint", "--resume"]),
        (["eval", "nowhere.ply", "{capture}"], ["nowhere.ply"]),
        (["eval", "{garbage}", "{capture}"], ["garbage.ply"]),
        (["eval", "{scene}", "{capture}", "--split", "test"], ["no test views", "--holdout"]),
        (["render", "{scene}", "--out", "out"], ["--cameras", "--orbit"]),
        (["render", "{scene}", "--orbit", "4", "--out", "out.png"], ["out.png", "mp4"]),
        (["render", "{scene}", "--orbit", "0", "--out", "out.mp4"], ["orbit", "0"]),
        (["render", "{scene}", "--orbit", "4", "--exr", "--out", "out.mp4"], ["--exr", "--orbit"]),
        (["info", "nowhere"], ["nowhere"]),
        (["info", "nowhere.ply"], ["nowhere.ply"]),
    ],
)
def test_mistakes_get_one_sentence(
    arguments, words, fitted, capture_path, tmp_path, igsr_here, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    garbage = tmp_path / "garbage.ply"
    garbage.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n")
    places = {"capture": capture_path, "scene": fitted[0] / "scene.ply", "garbage": garbage}
    arguments = [argument.format(**places) for argument in arguments]
    if arguments[0] == "fit":
        arguments.append("--json")
    refused(igsr_here(*arguments), *words)
    assert [path.name for path in tmp_path.iterdir()] == ["garbage.ply"]


def test_failing_device_is_a_sentence(fitted, capture_path, igsr_here, monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("The GPU was lost")

    monkeypatch.setattr(igsr._core, "rasterize", fail)
    scene = fitted[0] / "scene.ply"
    refused(igsr_here("eval", scene, capture_path, "--backend", "cpu", "--json"), "GPU was lost")


@pytest.mark.parametrize(
    "arguments",
    [["fit"], ["fit", "x"], ["nonsense"], ["info", "x", "--backend", "abacus"], ["eval", "x"]],
)
def test_usage_errors_exit_with_2(arguments, igsr_here):
    result = igsr_here(*arguments)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_missing_adapter_is_a_sentence(capture_path, tmp_path):
    # No driver files: the Vulkan loader finds no device. Where a GPU answers by other means
    # (Metal, DX12) this variable changes nothing, and the fit then simply succeeds.
    environment = {**os.environ, "VK_DRIVER_FILES": "/dev/null", "VK_ICD_FILENAMES": "/dev/null"}
    if sys.platform != "linux":
        environment["WGPU_BACKEND"] = "vulkan"
    result = igsr_command(
        "fit", capture_path, "--out", tmp_path / "out", "--backend", "gpu", "--json",
        env=environment,
    )  # fmt: skip
    refused(result, "adapter")
    assert not (tmp_path / "out").exists()
