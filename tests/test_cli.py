"""The ``igsr`` command as users run it: files, exit codes, error messages of one sentence."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time

import av
import numpy as np
import pytest
import rooms
import scenes
from PIL import Image

import igsr

COMMAND = [sys.executable, "-m", "igsr.cli"]
FIT = ["--steps", "60", "--max-splats", "300", "--sh-degree", "1"]


def igsr_command(*arguments, **options):
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, **options)


def assert_fails(result, *words, code=1):
    """Assert that a command ended with one sentence on stderr that contains the words."""
    lines = result.stderr.splitlines()
    assert result.returncode == code, result.stderr
    assert len(lines) == 1, result.stderr
    for word in words:
        assert str(word) in lines[0]
    assert lines[0].endswith(".")
    assert result.stdout == ""


def test_the_version_and_the_list_of_commands():
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


def succeeds(*arguments):
    result = igsr_command(*arguments, "--backend", "cpu")
    assert result.returncode == 0, result.stderr
    return result


@pytest.fixture(scope="module")
def fitted(capture_path, tmp_path_factory):
    out = tmp_path_factory.mktemp("fitted")
    return out, succeeds("fit", capture_path, "--out", out, "--holdout", 4, *FIT)


def test_fit_writes_and_prints_its_results(fitted):
    out, result = fitted
    report = json.loads((out / "report.json").read_text())
    assert report["splats"] == len(igsr.Splats.load(out / "scene.ply")) <= 300
    counts = {"given": 8, "placed": 8, "train": 6, "test": 2}
    expected = {
        "steps": 60,
        "backend": "cpu",
        "seed": 0,
        "version": igsr.__version__,
        "start": "hull",
        "start_splats": 300,
        "ms_ssim": None,  # 40 pixels are too few for it
        "photos": counts | {"not_placed": [], "placed_by": {}},
    }
    assert {name: report[name] for name in expected} == expected
    assert report["instruction_set"]
    assert report["seconds"] > 0
    protocol = {"split": "test", "holdout": 4, "background": [1.0, 1.0, 1.0]}
    assert {name: report["protocol"][name] for name in protocol} == protocol
    assert [row["name"] for row in report["views"]] == ["photos/00.png", "photos/04.png"]
    assert report["psnr"] == pytest.approx(np.mean([row["psnr"] for row in report["views"]]))
    assert report["train"]["views"] == report["train"]["of"] == 6
    assert report["train"]["psnr"] > 10.0
    assert list(report["parts"]) == ["load", "fit", "score"]
    peaks = [part["peak_memory_bytes"] for part in report["parts"].values()]
    assert min(peaks) > 2**20
    assert report["peak_memory_bytes"] == max(peaks)
    for text in (
        f"PSNR {report['psnr']:.2f} dB",
        "initialization: hull, 300 points",
        "over white",
        f"fitted photos: PSNR {report['train']['psnr']:.2f} dB",
        report["limit"]["sentence"],
    ):
        assert text in result.stdout.replace("\n", " ")
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
    result = succeeds("eval", out / "scene.ply", capture_path, "--holdout", 4, "--json")
    scores = json.loads(result.stdout)
    for name in ("psnr", "ssim", "ms_ssim", "flip", "views", "protocol"):
        assert scores[name] == report[name]


def test_json_output_is_one_object_and_no_bar(capture_path, tmp_path):
    result = succeeds("fit", capture_path, "--out", tmp_path, "--steps", 5, "--json")
    report = json.loads(result.stdout)
    assert report == json.loads((tmp_path / "report.json").read_text())
    assert "steps/s" not in result.stderr
    assert report["protocol"]["split"] == "train"  # nothing was held out


def test_render_writes_pictures_and_exr_with_floats_and_depth(fitted, capture_path, tmp_path):
    scene = fitted[0] / "scene.ply"
    capture, splats = igsr.load_capture(capture_path), igsr.Splats.load(scene)
    render = ["render", scene, "--cameras", capture_path, "--out", tmp_path]
    result = succeeds(*render, "--background", "0.2,0.4,0.6", "--json")
    assert len(json.loads(result.stdout)["files"]) == len(capture.views)
    expected = igsr.render(splats, capture.views[3].camera, (0.2, 0.4, 0.6), "cpu").to_uint8()
    assert np.array_equal(np.asarray(Image.open(tmp_path / "photos" / "03.png")), expected)

    succeeds(*render, "--exr")
    path = tmp_path / "photos" / "03.exr"
    expected = igsr.render(splats, capture.views[3].camera, (1.0, 1.0, 1.0), "cpu")
    with av.open(str(path)) as container:
        rgba = next(container.decode(video=0)).to_ndarray()
    assert np.array_equal(rgba[..., :3], expected.color)
    assert np.array_equal(rgba[..., 3], expected.alpha)
    depth = igsr._core.read_exr_depth(str(path), expected.alpha.size)
    assert np.array_equal(depth, expected.expected_depth)


def test_render_takes_the_cameras_of_a_fit(fitted, capture_path, tmp_path):
    out = fitted[0]
    succeeds("render", out / "scene.ply", "--cameras", out, "--out", tmp_path / "views")
    splats = igsr.Splats.load(out / "scene.ply")
    written = sorted(path for path in (tmp_path / "views").rglob("*.png"))
    frames = json.loads((out / "cameras.json").read_text())["frames"]
    assert len(written) == len(frames)
    views = igsr.load_capture(capture_path).views
    camera = next(view.camera for view in views if view.name.endswith(written[0].name))
    expected = igsr.render(splats, camera, (1.0, 1.0, 1.0), "cpu").to_uint8()
    assert np.array_equal(np.asarray(Image.open(written[0])), expected)


@pytest.mark.parametrize("with_cameras", [False, True])
def test_orbit_writes_a_video(fitted, capture_path, tmp_path, with_cameras):
    out, _ = fitted
    video = tmp_path / "orbit.mp4"
    cameras = ["--cameras", capture_path] if with_cameras else []
    succeeds("render", out / "scene.ply", "--orbit", 6, *cameras, "--out", video)
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


def test_info_counts_non_finite_splats(tmp_path, igsr_here):
    splats = scenes.splats()
    splats.means[3] = np.nan
    splats.scales[4] = np.inf
    splats.save(tmp_path / "scene.ply")
    report = json.loads(igsr_here("info", tmp_path / "scene.ply", "--json").stdout)
    assert report["not_finite"] == 2
    kept = splats.means[splats.finite]
    assert report["lowest_corner"] == kept.min(axis=0).astype(float).tolist()
    assert 0.5 < report["median_opacity"] < 1.0


LONG_FIT = ["--steps", 3000, "--max-splats", 300, "--backend", "cpu", "--json"]
signals = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)


def signal_when(ready, number, *arguments):
    """Start a command, send it a signal once ``ready(its process)`` is true, and return its end.

    The signal is sent repeatedly, as by ``timeout`` and ``uv run``.
    """
    process = subprocess.Popen(
        [*COMMAND, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # Children of a shell's background jobs ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while not ready(process):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for _ in range(6):
        process.send_signal(number)
        time.sleep(0.005)
    stdout, stderr = process.communicate(timeout=60)
    code = process.returncode
    # Exit codes as in shells: a further signal can end the interpreter while it shuts down.
    return subprocess.CompletedProcess([], code if code >= 0 else 128 - code, stdout, stderr)


@pytest.fixture(scope="module")
def whole_scene(capture_path, tmp_path_factory):
    """The scene of a fit that was not interrupted."""
    out = tmp_path_factory.mktemp("whole")
    assert igsr_command("fit", capture_path, "--out", out, *LONG_FIT).returncode == 0
    return (out / "scene.ply").read_bytes()


@signals
def test_a_signal_ends_a_fit_which_resumes_to_the_same_bits(
    capture_path, tmp_path, number, whole_scene
):
    fit = ["fit", capture_path, "--out", tmp_path, *LONG_FIT]
    ended = signal_when(lambda _: (tmp_path / "checkpoint.npz").exists(), number, *fit)
    assert_fails(ended, "Interrupted at step", "--resume", code=128 + number)
    assert not (tmp_path / "scene.ply").exists()
    assert_fails(igsr_command(*fit, "--resume", "--seed", 1), "checkpoint.npz", "seed")
    assert igsr_command(*fit, "--resume").returncode == 0
    assert (tmp_path / "scene.ply").read_bytes() == whole_scene


@signals
def test_a_signal_while_cameras_are_sought_is_one_sentence(tmp_path, number, monkeypatch):
    """COLMAP's own handler would print a native stack trace."""
    photos, temporary = tmp_path / "photos", tmp_path / "temporary"
    photos.mkdir()
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    for photo in rooms.photos([rooms.camera(angle) for angle in np.linspace(-0.6, 0.6, 8)]):
        Image.fromarray(photo.image).save(photos / photo.name)

    def has_begun(process):
        return any(temporary.glob("*/database.db"))

    ended = signal_when(has_begun, number, "fit", photos, "--out", tmp_path / "out", "--json")
    assert_fails(ended, "Interrupted before the first step", code=128 + number)
    assert not (tmp_path / "out/cameras.npz").exists()


@pytest.mark.parametrize(
    ("command", "begun", "said"),
    [
        (["convert", "{scene}", "{out}/levels", "--lod", 3], "out/.*/new/*", "nothing is written"),
        (["convert", "{scene}", "{out}/a.html"], "temporary/*", "nothing is written"),
    ],
    ids=lambda given: given[0] if isinstance(given, list) else "",
)
def test_a_signal_leaves_no_temporary_files(tmp_path, command, begun, said, monkeypatch):
    """Folders of poses and fits are in the tests above."""
    places = {name: tmp_path / name for name in ("out", "temporary")}
    for folder in places.values():
        folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(places["temporary"]))
    scene = tmp_path / "scene.ply"
    scenes.splats(count=200_000).save(scene)
    words = [str(word).format(scene=scene, **places) for word in command]
    ended = signal_when(lambda _: any(tmp_path.glob(begun)), signal.SIGTERM, *words)
    assert ended.returncode == 128 + signal.SIGTERM
    assert said in ended.stderr.splitlines()[-1]
    assert not any(any(folder.iterdir()) for folder in places.values())


def test_sigterm_ends_the_window(tmp_path):
    scenes.splats().save(tmp_path / "scene.ply")
    code = f"""
import sys
from igsr.cli import main, view
killer = "import os, signal, time; os.kill(os.getppid(), signal.SIGTERM); time.sleep(60)"
view.PROGRAM = (sys.executable, "-c", killer)
sys.argv = ["igsr", "view", "--screenshot", {str(tmp_path / "scene.ply")!r}]
main()
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGTERM, "Interrupted.\n")


def test_a_signal_in_the_first_use_of_numpy_by_the_renderer_is_no_panic(tmp_path):
    scenes.splats().save(tmp_path / "scene.ply")
    code = f"""
import igsr._core, numpy.lib
numpy.lib.NumpyVersion = None  # as an exception raised in it
igsr.Splats.load({str(tmp_path / "scene.ply")!r})
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


@pytest.mark.parametrize("moment", ["during", "after"])
def test_the_import_of_pycolmap_leaves_the_handler_of_sigterm(moment):
    code = f"""
import os, signal, sys
from igsr._internal.load_pycolmap import load_pycolmap

class Finder:
    def find_spec(self, name, *rest):
        if name == "pycolmap._core" and "{moment}" == "during":
            os.kill(os.getpid(), signal.SIGTERM)

sys.meta_path.insert(0, Finder())
load_pycolmap()
os.kill(os.getpid(), signal.SIGTERM)
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (-signal.SIGTERM, "")


def test_a_finished_fit_that_is_resumed_is_scored_again(fitted, capture_path):
    out, _ = fitted
    before = (out / "scene.ply").read_bytes()
    report = json.loads((out / "report.json").read_text())
    succeeds("fit", capture_path, "--out", out, "--holdout", 4, *FIT, "--resume")
    assert (out / "scene.ply").read_bytes() == before
    again = json.loads((out / "report.json").read_text())
    assert 0.0 < again["seconds"] <= report["seconds"], "the fit is not repeated"
    measured = ("seconds", "parts", "peak_memory_bytes")
    assert again == {**report, **{name: again[name] for name in measured}}


def test_a_full_disk_is_an_error_and_the_old_files_stay(fitted, capture_path, tmp_path):
    out, _ = fitted
    shutil.copytree(out, tmp_path, dirs_exist_ok=True)

    def contents():
        # view/ is of the last run.
        files = (path for path in tmp_path.iterdir() if path.is_file())
        return {path: path.read_bytes() for path in files}

    before = contents()

    def small_files_only():
        # The kernel refuses larger files as it would on a full disk, with EFBIG.
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))

    def refused(*arguments):
        return igsr_command(*arguments, "--backend", "cpu", preexec_fn=small_files_only)

    result = refused("fit", capture_path, "--out", tmp_path, *FIT, "--seed", 5, "--json")
    assert "scene.ply" in result.stderr.splitlines()[-1]
    assert "Traceback" not in result.stderr
    assert result.returncode == 1
    assert contents() == before
    render = ["render", out / "scene.ply", "--out"]
    assert_fails(refused(*render, tmp_path / "orbit.mp4", "--orbit", 4), "orbit.mp4")
    result = refused(*render, tmp_path / "exr", "--cameras", capture_path, "--exr")
    assert_fails(result, "00.exr: File too large")
    assert "unfinished" not in result.stderr, "messages name no temporary file"
    assert not (tmp_path / "orbit.mp4").exists()
    assert not any(path.is_file() for path in (tmp_path / "exr").rglob("*"))


@pytest.mark.parametrize("command", ["clean", "compact", "eval", "render"])
@pytest.mark.parametrize("folder", [".", "/"])
def test_a_folder_is_no_scene(command, folder, igsr_here):
    assert_fails(igsr_here(command, folder), f"{folder} is a folder; name a splat file")


def test_out_must_be_a_folder(capture_path, tmp_path, igsr_here):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    assert_fails(igsr_here("fit", capture_path, "--out", blocked, *FIT, "--json"), blocked)
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
def test_wrong_arguments_are_errors_of_one_sentence(
    arguments, words, fitted, capture_path, tmp_path, igsr_here, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    garbage = tmp_path / "garbage.ply"
    garbage.write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\nend_header\n")
    places = {"capture": capture_path, "scene": fitted[0] / "scene.ply", "garbage": garbage}
    arguments = [argument.format(**places) for argument in arguments]
    if arguments[0] == "fit":
        arguments.append("--json")
    assert_fails(igsr_here(*arguments), *words)
    assert [path.name for path in tmp_path.iterdir()] == ["garbage.ply"]


def test_a_failing_device_is_an_error_of_one_sentence(fitted, capture_path, igsr_here, monkeypatch):
    def fail(*arguments, **options):
        raise RuntimeError("The GPU was lost")

    monkeypatch.setattr(igsr._core, "rasterize", fail)
    result = igsr_here("eval", fitted[0] / "scene.ply", capture_path, "--backend", "cpu", "--json")
    assert_fails(result, "GPU was lost")


@pytest.mark.parametrize(
    "arguments",
    [["fit"], ["fit", "x"], ["nonsense"], ["info", "x", "--backend", "abacus"], ["eval", "x"]],
)
def test_usage_errors_exit_with_2(arguments, igsr_here):
    result = igsr_here(*arguments)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr


def test_a_missing_adapter_is_an_error_of_one_sentence(capture_path, tmp_path):
    # Without driver files, the Vulkan loader finds no device.
    environment = {**os.environ, "VK_DRIVER_FILES": "/dev/null", "VK_ICD_FILENAMES": "/dev/null"}
    if sys.platform != "linux":
        environment["WGPU_BACKEND"] = "vulkan"
    fit = ["fit", capture_path, "--out", tmp_path / "out", "--backend", "gpu", "--json"]
    assert_fails(igsr_command(*fit, env=environment), "adapter")
    assert not (tmp_path / "out").exists()
