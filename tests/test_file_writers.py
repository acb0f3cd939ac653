"""Files and folders that igsr writes: whole, under their own mode, never through a link."""

import os
import signal
import stat
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import scenes
from PIL import Image

import igsr
from igsr import Splats
from igsr._internal.json_file import write_json
from igsr.capture.write_colmap import write_colmap
from igsr.capture.write_files import png_names, unique_stems
from igsr.capture.write_transforms import write_cameras, write_transforms
from igsr.cli.error_messages import nothing_written
from igsr.errors import IgsrError
from igsr.evaluation.contact_sheet import save_sheet
from igsr.fitting.checkpoint import save_checkpoint
from igsr.rendering.levels import write_levels
from igsr.rendering.scene_page import write_scene_page
from igsr.rendering.video import write_video

CAPTURE = scenes.capture(views=2, size=16)
SPLATS = scenes.splats(degree=0)
PICTURE = np.zeros((16, 16, 3), np.uint8)
FILES = {
    **{
        f"a{ending}": SPLATS.save
        for ending in (".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".gltf")
    },
    "a.json": lambda path: write_json(path, {"psnr": 30.0}),
    "a.png": lambda path: save_sheet(path, Image.fromarray(PICTURE)),
    "a.html": lambda path: write_scene_page(path, SPLATS),
    "a.npz": lambda path: save_checkpoint(path, {"means": np.zeros(3)}, {}),
    "a.mp4": lambda path: write_video(path, [PICTURE]),
    "cameras.json": lambda path: write_cameras(path, CAPTURE.views),
}
FOLDERS = {
    "colmap": partial(write_colmap, CAPTURE),
    "transforms": partial(write_transforms, CAPTURE),
    "levels": lambda path: write_levels(path.parent / "scene.ply", path, 2),
}
ALL = {**FILES, **FOLDERS}
every_writer = pytest.mark.parametrize("name", ALL)
kept_modes = pytest.mark.skipif(sys.platform == "win32", reason="no locks of folders, no modes")


def left_in(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def place(tmp_path):
    """A folder with a scene, from which levels are made."""
    SPLATS.save(tmp_path / "scene.ply")
    return tmp_path


@kept_modes
@every_writer
def test_an_existing_mode_is_kept(place, name):
    path = place / name
    path.touch() if name in FILES else path.mkdir()
    path.chmod(0o750)
    ALL[name](path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o750
    assert path.is_dir() or path.stat().st_size
    mask = os.umask(0o027)
    try:
        ALL[name](place / f"new-{name}")
    finally:
        os.umask(mask)
    mode = stat.S_IMODE((place / f"new-{name}").stat().st_mode)
    assert mode == (0o640 if name in FILES else 0o750)


@every_writer
def test_nothing_is_written_through_a_link(place, name):
    """Links are replaced: at the path, and at names of temporary files and folders."""
    precious = place / "precious"
    precious.mkdir()
    (precious / "old").write_text("kept")
    names = [f".{name}-0000.unfinished", f"{name}.{os.getpid()}.tmp"]
    for link in names:
        (place / link).symlink_to(precious if link.startswith(".") else precious / "old")
    if name in FILES:
        (place / name).symlink_to(precious / "old")
    ALL[name](place / name)
    assert not (place / name).is_symlink()
    assert left_in(precious) == {"old"}
    assert (precious / "old").read_text() == "kept"
    assert left_in(place) == {"precious", "scene.ply", name, *names}


@kept_modes
@every_writer
def test_leftovers_of_killed_writers_are_removed_and_others_stay(place, name):
    longer = f".{name}-b-0000.unfinished"
    for left in (f".{name}-0000.unfinished", f".x{name}-0000.unfinished", longer):
        (place / left / "new").mkdir(parents=True)
        os.utime(place / left, (0, 0))
    hold = """
import fcntl, os, sys
os.mkdir(sys.argv[1])
os.utime(sys.argv[1], (0, 0))
fcntl.flock(os.open(sys.argv[1], os.O_RDONLY), fcntl.LOCK_EX)
print("locked", flush=True)
sys.stdin.read()
"""
    live = f".{name}-1111.unfinished"
    # By another computer, whose lock is not seen here.
    young = f".{name}-2222.unfinished"
    (place / young).mkdir()
    command = [sys.executable, "-c", hold, place / live]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:
        process.stdout.readline()
        ALL[name](place / name)
        expected = {"scene.ply", name, longer, f".x{name}-0000.unfinished"}
        assert left_in(place) == {live, young, *expected}
        process.communicate()
    ALL[name](place / f"x{name}")  # removes the leftovers of its own name only
    assert left_in(place) == {live, young, longer, name, f"x{name}", "scene.ply"}


@every_writer
def test_an_empty_name_is_refused_in_one_sentence(place, name, monkeypatch):
    (place / "empty").mkdir()
    monkeypatch.chdir(place / "empty")
    for empty in ("", Path()):
        with pytest.raises(IgsrError, match=r"""(''|""|'\.'|\.: | is )"""):
            ALL[name](empty if name not in FOLDERS else Path(empty))
    assert not left_in(place / "empty")


def test_an_empty_argument_of_any_command_is_refused(place, monkeypatch, igsr_here):
    monkeypatch.chdir(place)
    for arguments, named in (
        (["fit", "x", "--out", ""], "An argument after --out"),
        (["fit", "x", "--out="], "--out"),
        (["info", "--json", ""], "An argument after --json"),
        (["convert", "scene.ply", ""], "An argument"),
    ):
        done = igsr_here(*arguments)
        assert (done.returncode, done.stdout) == (1, "")
        assert done.stderr == f"{named} is empty; give a value, or leave it out.\n"
    with pytest.raises(IgsrError, match="out is empty"):
        igsr.fit(CAPTURE, out="")
    assert left_in(place) == {"scene.ply"}


#: Writes one of two contents to a path, in several threads and forever.
WRITER = """
import sys, threading
from pathlib import Path
from igsr import Splats
from igsr._internal.json_file import write_json
folder, scenes = Path(sys.argv[1]), [Splats.load(path) for path in sys.argv[2:]]

def write():
    while True:
        for number, scene in enumerate(scenes):
            scene.save(folder / "scene.ply")
            write_json(folder / "a.json", {"text": str(number) * 100_000})

for _ in range(4):
    threading.Thread(target=write).start()
"""


def test_writers_at_once_that_are_killed_leave_whole_files(tmp_path):
    contents = [tmp_path / f"{number}.ply" for number in range(2)]
    for number, path in enumerate(contents):
        scenes.splats(count=3000, seed=number).save(path)
    texts = [path.read_bytes() for path in contents]
    out = tmp_path / "out"
    out.mkdir()
    command = [sys.executable, "-c", WRITER, out, *contents]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE, text=True) for _ in range(4)]
    seen = set()
    try:
        deadline = time.monotonic() + 60
        while not ((out / "a.json").exists() and (out / "scene.ply").exists()):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        end = time.monotonic() + 1.0
        while time.monotonic() < end or len(seen) < 2:
            assert time.monotonic() < deadline
            assert (out / "scene.ply").read_bytes() in texts
            text = (out / "a.json").read_text()
            assert len(text) > 100_000
            assert text.endswith("}\n")
            seen.add(text)
    finally:
        for process in processes:
            process.send_signal(signal.SIGKILL)
        messages = [process.communicate()[1] for process in processes]
    assert not any(messages)
    assert (out / "scene.ply").read_bytes() in texts
    for left in out.glob(".*.unfinished"):
        os.utime(left, (0, 0))
    Splats.load(contents[0]).save(out / "scene.ply")
    write_json(out / "a.json", {})
    assert left_in(out) == {"scene.ply", "a.json"}


@pytest.mark.skipif(sys.platform == "win32", reason="no fork")
def test_forked_writers_do_not_collide(tmp_path):
    """A fork copies the state of random numbers."""
    code = """
import os, sys
from igsr import Splats
scene = Splats.load(sys.argv[1])
scene.save(sys.argv[2])
children = []
for _ in range(4):
    if not (child := os.fork()):
        status = 1
        try:
            for _ in range(100):
                scene.save(sys.argv[2])
            status = 0
        finally:
            os._exit(status)
    children.append(child)
sys.exit(any([os.waitpid(child, 0)[1] for child in children]))
"""
    scenes.splats(count=3000).save(tmp_path / "scene.ply")
    command = [sys.executable, "-c", code, tmp_path / "scene.ply", tmp_path / "out.ply"]
    subprocess.run(command, check=True, timeout=60)
    assert left_in(tmp_path) == {"scene.ply", "out.ply"}


def test_inputs_of_one_name_have_an_output_each():
    names = ["a.png", "a.jpg", "../a.png", "A.tif", "b/a.png", "a.confidence.png", "/a.jpg"]
    ends = (".png", ".confidence.png")
    files = [f"{stem}{end}".lower() for stem in unique_stems(names, *ends) for end in ends]
    assert len(set(files)) == len(files) == 2 * len(names)
    assert unique_stems(names[:2], ".png") == ["a", "a.jpg"]
    views = [scenes.pseudo_view(CAPTURE.views[0], name=name) for name in [*names, "images/a.png"]]
    assert len({name.lower() for name in png_names(views)}) == len(views)


def test_outputs_of_thousands_of_inputs_of_one_name_are_named_at_once():
    start = time.process_time()
    assert len(set(unique_stems(["a.png", "A.png"] * 2000, ".png", ".npy"))) == 4000
    assert time.process_time() - start < 1.0


@pytest.mark.parametrize(
    ("command", "of_each"), [(("render", "--cameras"), 1), (("denoise", "--capture"), 2)]
)
def test_commands_write_an_output_for_each_view(place, command, of_each, igsr_here):
    made = [replace(CAPTURE.views[0], name=name) for name in ("a.png", "a.jpg", "../a.png")]
    capture = scenes.write_capture(place / "capture", replace(CAPTURE, views=made))
    name, option = command
    done = igsr_here(name, place / "scene.ply", option, capture, "--out", place / "out")
    assert done.returncode == 0, done.stderr
    assert len(left_in(place / "out")) == 3 * of_each


def test_the_message_after_an_interruption_says_whether_the_file_is_written(tmp_path):
    path = tmp_path / "a.json"
    for _ in range(2):
        message = nothing_written(path)
        assert message() == "Interrupted; nothing is written."
        write_json(path, {})
        assert message() == f"Interrupted; {path} is written."
