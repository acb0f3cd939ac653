"""Files that a user or another file names may be pipes, devices, too large, or bombs."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import struct
import subprocess
import sys
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pillow_heif
import pytest
import scenes
from capture_files import write_transforms
from PIL import Image
from web_views import served, with_token

import igsr
from igsr._internal import input_files, peak_memory, untrusted_npz
from igsr.blocks.tasks import load_splats
from igsr.blocks.worker import read_progress
from igsr.cameras.cameras_file import read_cameras_file
from igsr.cameras.da3.checkpoint import load_checkpoint as da3_checkpoint
from igsr.cameras.dust3r.checkpoint import load_checkpoint as dust3r_checkpoint
from igsr.cameras.networks import config_of
from igsr.capture import colmap_files
from igsr.capture.image_files import MAX_FREE_DEPTH, open_image, read_depth
from igsr.capture.load import describe_capture, look_at
from igsr.capture.point_cloud import read_point_cloud
from igsr.capture.read_transforms import read_cameras, read_lens
from igsr.capture.video_frames import video_size
from igsr.capture.write_transforms import write_cameras
from igsr.cli import compact
from igsr.denoiser.weights import load_network
from igsr.errors import IgsrError
from igsr.fitting.checkpoint import load_checkpoint
from igsr.refinement.report import parts_so_far
from igsr.rendering import live_view
from igsr.rendering.run_folder import background_beside, cameras_of

ROOT = Path(__file__).parents[1]
MEMORY = 300_000_000

#: Readers of JSON, by the name of a file for them.
JSON_READERS = {
    "cameras.json": read_cameras,
    "lens.json": read_lens,
    "transforms.json": describe_capture,
    "page/report.json": lambda path: background_beside(path.with_name("scene.ply")),
    "scores/report.json": compact._reported_psnr,
    "parts/report.json": lambda path: parts_so_far(path.parent),
    "progress.json": lambda path: read_progress(path.parent),
    "config.json": lambda path: config_of(path.with_name("model.safetensors")),
}
READERS = {
    **JSON_READERS,
    "points.ply": read_point_cloud,
    **{f"cameras.{kind}": colmap_files.read_cameras for kind in ("bin", "txt")},
    **{f"images.{kind}": colmap_files.read_images for kind in ("bin", "txt")},
    **{f"points3D.{kind}": colmap_files.read_points for kind in ("bin", "txt")},
    **{f"frames.{kind}": colmap_files.read_frames for kind in ("bin", "txt")},
    "count/images.bin": lambda path: colmap_files.image_count(path.parent),
    **{f"depth{end}": lambda path: read_depth(path, None, (8, 8)) for end in (".npy", ".exr")},
    "depth.png": lambda path: read_depth(path, None, (8, 8)),
    "photo.png": open_image,
    "cameras.npz": read_cameras_file,
    "checkpoint.npz": load_checkpoint,
    "splats.npz": load_splats,
    "denoiser.safetensors": load_network,
    "da3/model.safetensors": da3_checkpoint,
    "dust3r.pth": dust3r_checkpoint,
    "video.mp4": video_size,
    **{f"scene{end}": igsr.Splats.load for end in (".ply", ".splat", ".spz", ".sog", ".glb")},
}
#: Files that igsr itself writes, or the system's, may be opened otherwise.
OTHER_OPENERS = {
    *("_internal/input_files.py", "_internal/peak_memory.py", "_internal/atomic_write.py"),
    *("_internal/available_memory.py", "rendering/scene_page.py", "rendering/scene_model.py"),
}
OPENING = re.compile(
    r"\.read_bytes\(|\.read_text\(|np\.load\(|np\.fromfile\(|\"rb\"\)|json\.load\("
    r'|(?<![\w.])open\((?!.*"[wa]b?")'
)
#: Libraries that open a file by its name; it is checked before.
LIBRARY_OPENING = re.compile(
    r'safe_open\(|load_file\(|ZipFile\(|torch\.load\(|Image\.open\(|av\.open\((?!.*mode="w")'
)
CHECK = re.compile(r"open_file\(|exists\(path\)")


@pytest.fixture
def in_time():
    """Fails a test that waits for a pipe, instead of waiting with it."""

    def late(*_):
        raise AssertionError("the file is waited for")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def peak_of(work):
    """The result of some work, and the peak of bytes that it took; 0 if the system cannot tell."""
    if not peak_memory.forget_peak():
        return work(), 0
    before = peak_memory.peak_bytes()
    return work(), peak_memory.peak_bytes() - before


def refused(read, path):
    """A reader's sentence, or "" if it takes the file for missing."""

    def attempt():
        try:
            found = read(path)
        except IgsrError as error:
            return str(error)
        assert not found, found
        return ""

    sentence, peak = peak_of(attempt)
    assert peak < MEMORY, f"{peak} bytes"
    assert len(sentence) < 1000
    return sentence


@pytest.mark.parametrize("name", READERS)
def test_only_files_of_a_limited_size_are_read(tmp_path, in_time, name):
    for kind in ("pipe", "device", "huge"):
        path = tmp_path / kind / name
        path.parent.mkdir(parents=True)
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "device":
            path.symlink_to("/dev/zero")
        else:
            path.touch()
            os.truncate(path, input_files.MAX_BYTES + 1)  # takes no disk
        refused(READERS[name], path)


@pytest.mark.parametrize("name", JSON_READERS)
def test_json_has_a_limited_number_of_values(tmp_path, name):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text('{"frames": [' + '{"":{"":{}}},' * 2_000_000 + "{}]}")
    refused(JSON_READERS[name], path)
    path.write_text("[" * 100_000)
    refused(JSON_READERS[name], path)


def test_files_are_opened_in_one_place():
    package = ROOT / "py" / "igsr"
    for source in package.rglob("*.py"):
        if source.relative_to(package).as_posix() not in OTHER_OPENERS:
            found = OPENING.search(source.read_text(encoding="utf-8"))
            assert found is None, f"{source}: open files by igsr._internal.input_files ({found[0]})"
            found = LIBRARY_OPENING.search(source.read_text(encoding="utf-8"))
            is_checked = CHECK.search(source.read_text(encoding="utf-8"))
            assert not found or is_checked, f"{source}: open_file(path).close() before {found[0]}"
    for source in ROOT.glob("crates/*/src/**/*.rs"):
        text = source.read_text(encoding="utf-8").partition("#[cfg(test)]")[0]
        if not source.as_posix().endswith(("/open.rs", "/atomic.rs", "levels/write.rs")):
            found = re.search(r"File::open\(|fs::read(_to_string)?\(", text)
            assert found is None, f"{source}: use open_file"
    for path in (ROOT, "/dev/zero"):
        with pytest.raises(OSError, match="folder, a pipe or a device"):
            input_files.open_file(path)


def png(width, height, depth=8, color=2):
    """A PNG whose header claims a size, with no pixels."""

    def chunk(kind, data):
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    header = struct.pack(">IIBBBBB", width, height, depth, color, 0, 0, 0)
    # The size of a picture of zeros, which the limit on pixels per byte allows.
    data = zlib.compress(bytes(1000)) + bytes(width * height // 500)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    )


def test_a_small_heic_claims_no_vast_picture(tmp_path):
    pillow_heif.register_heif_opener()
    path = tmp_path / "a.heic"
    Image.new("RGB", (64, 64)).save(path)
    size, vast = struct.pack(">II", 64, 64), struct.pack(">II", 9000, 9000)
    assert size in path.read_bytes()
    path.write_bytes(path.read_bytes().replace(size, vast))
    assert "claims 9000x9000 pixels" in refused(open_image, path)


def npy(header):
    return b"\x93NUMPY\x01\0" + struct.pack("<H", len(header)) + header.encode()


HEADER = "{{'descr': '<f4', 'fortran_order': False, 'shape': {}, }}"
BROKEN_ARRAYS = {
    "signs": npy("-" * 9000 + "1"),
    "brackets": npy("(" * 900),
    "open": npy("{'descr': '<f4', 'shape': (8"),
    "negative": npy(HEADER.format((-1, 8))) + bytes(100),
    "vast": npy(HEADER.format((1 << 40, 1 << 40))) + bytes(100),
    "objects": npy(HEADER.format((1,)).replace("<f4", "|O")) + bytes(8),
    "empty": b"",
    "text": b"no array",
}


@pytest.mark.parametrize("kind", BROKEN_ARRAYS)
def test_broken_arrays_are_one_sentence(tmp_path, kind):
    content = BROKEN_ARRAYS[kind]
    (tmp_path / "depth.npy").write_bytes(content)
    sentence = refused(lambda path: read_depth(path, None, (8, 8)), tmp_path / "depth.npy")
    assert re.fullmatch(r"\S*depth.npy cannot be read as depth: [^\n]{1,80}", sentence)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.writestr("settings.npy", content)
    for read in (load_checkpoint, read_cameras_file, load_splats):
        assert re.fullmatch(
            r"[^\n]*a.npz cannot be read [^\n]{1,150}", refused(read, tmp_path / "a.npz")
        )


def test_arrays_in_the_order_of_fortran_are_read(tmp_path):
    array = np.arange(12.0, dtype=np.float32).reshape(3, 4) + 1
    np.save(tmp_path / "a.npy", np.asfortranarray(array))
    assert np.array_equal(untrusted_npz.stored_array(tmp_path / "a.npy", 12), array)
    assert np.array_equal(read_depth(tmp_path / "a.npy", 2.0, (4, 3)), 2 * array)


def test_an_array_that_is_cut_while_it_is_read_is_damaged():
    header = npy("{'descr': '|u1', 'fortran_order': False, 'shape': (100,)}")
    # One byte would fill all hundred if it were broadcast.
    with pytest.raises(ValueError, match="memoryview"):
        untrusted_npz._read_array(io.BytesIO(header + b"\1"), len(header) + 100)


def test_depth_is_no_larger_than_its_photo(tmp_path):
    def read(path):
        return read_depth(path, None, (48, 32))

    (tmp_path / "depth.png").write_bytes(png(9000, 9000, 16, 0))
    assert "more than its photo" in refused(read, tmp_path / "depth.png")
    path = tmp_path / "depth.npy"
    np.save(path, np.zeros((3000, 3000), np.uint8))
    assert "more than the limit of 4194304 numbers" in refused(read, path)
    assert read_depth(path, None, (3000, 3000)).shape == (3000, 3000)
    header = npy(HEADER.format((12288, 24576)))
    path.write_bytes(header)
    os.truncate(path, len(header) + 4 * 12288 * 24576)  # takes no disk
    assert "more than the limit" in refused(read, path)


def test_archives_of_arrays_are_no_larger_than_the_memory(tmp_path, monkeypatch):
    np.savez(tmp_path / "a.npz", settings=np.zeros(1 << 26, np.uint8))
    monkeypatch.setattr(untrusted_npz, "available_memory", lambda: 1 << 26)
    for read in (load_checkpoint, read_cameras_file, load_splats):
        assert "bytes of memory are free" in refused(read, tmp_path / "a.npz")
    monkeypatch.undo()
    arrays, peak = peak_of(lambda: untrusted_npz.stored_arrays(tmp_path / "a.npz"))
    assert arrays["settings"].size == 1 << 26
    assert peak < 1.2 * (1 << 26), f"{peak} bytes"  # the array is held once


def test_json_in_archives_has_a_limited_number_of_values(tmp_path):
    text = np.frombuffer(b"[" + b"[]," * 3_000_000 + b"0]", np.uint8)
    np.savez(tmp_path / "a.npz", settings=text, about=text)
    for read in (load_checkpoint, read_cameras_file):
        assert "values" in refused(read, tmp_path / "a.npz")


def test_weights_are_read_only_if_their_shapes_are_a_networks(tmp_path):
    path = tmp_path / "denoiser.safetensors"
    about = {"architecture": json.dumps({"width": 256, "blocks": [32, 32, 32]})}
    entry = {"dtype": "F16", "shape": [1 << 29], "data_offsets": [0, 1 << 30]}
    header = json.dumps({"__metadata__": about, "head.weight": entry}).encode()
    path.write_bytes(struct.pack("<Q", len(header)) + header)
    os.truncate(path, 8 + len(header) + (1 << 30))  # takes no disk
    assert "head.weight has shape [536870912]" in refused(load_network, path)


def test_depth_counts_in_the_memory_check(tmp_path):
    np.save(tmp_path / "depth.npy", np.ones((32, 48), np.float32))
    write_transforms(tmp_path)
    before = look_at(tmp_path).needed_memory()
    write_transforms(tmp_path, depth_file_path="depth.npy")
    assert look_at(tmp_path).needed_memory() > before + 16 * MAX_FREE_DEPTH


def test_photos_of_the_page_are_decoded_one_at_a_time_and_within_a_limit(tmp_path):
    made = scenes.capture(views=1, size=8)
    (tmp_path / "in.png").write_bytes(png(13000, 13000))
    write_cameras(
        tmp_path / "cameras.json",
        [igsr.View("in.png", made.views[0].camera, "train", made.views[0].image)],
    )
    with served(tmp_path) as server, ThreadPoolExecutor(4) as pool:
        asked = ["photo?number=0"] * 4
        answers, peak = peak_of(lambda: list(pool.map(with_token, [server] * 4, asked)))
        assert peak < MEMORY, f"{peak} bytes"
        for status, content in answers:
            assert status == 422
            assert b"13000x13000 pixels, too many" in content
        assert with_token(server, "photo?number=" + "9" * 5000)[0] == 404


def test_photos_of_the_page_may_keep_coefficients_of_all_pixels(tmp_path):
    image = Image.new("RGB", (5600, 5600))
    image.save(tmp_path / "a.jpg", progressive=True, subsampling=0)
    assert "5600x5600 pixels, too many" in refused(live_view._jpeg, tmp_path / "a.jpg")
    image.save(tmp_path / "a.jpg")
    assert live_view._jpeg(tmp_path / "a.jpg").startswith(b"\xff\xd8")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "AVIF", "HEIF", "BMP", "GIF", "TIFF"])
def test_photos_of_the_page_take_no_more_memory_than_counted(tmp_path, kind):
    pillow_heif.register_heif_opener()
    path, fast = tmp_path / "a.png", {"compress_level": 1, "speed": 10, "method": 0, "quality": 1}
    Image.new("RGB", (3000, 3000), (9, 99, 200)).save(path, kind, **fast)
    path.write_bytes(path.read_bytes() + bytes(1000))  # for the limit on pixels per byte
    with open_image(path) as photo:
        assert photo.format == kind
        photo.draft("RGB", (live_view.MAX_PHOTO_SIDE_PX,) * 2)
        counted = live_view._bytes_to_decode(photo, 3000 * 3000)
    _, peak = peak_of(lambda: live_view._jpeg(path))
    smaller = 40_000_000  # the picture of the page
    assert peak < counted + smaller, f"{peak} bytes"


def test_the_page_keeps_no_large_reports(tmp_path):
    (tmp_path / "view").mkdir()
    for name in ("report.json", "view/run.json", "view/progress.json"):
        (tmp_path / name).write_text('{"": [' + '{"":{}},' * 300_000 + "{}]}")
    view = live_view.LiveView([tmp_path])
    _, peak = peak_of(view.state)
    assert peak < 50_000_000, f"{peak} bytes"
    content = '{"camera_model": "PINHOLE", "frames": [' + '{"":{}},' * 700_000 + "{}]}"
    (tmp_path / "cameras.json").write_text(content)
    assert live_view._cameras(tmp_path / "cameras.json") == []
    with pytest.raises(IgsrError, match="more than 1048576 values"):
        cameras_of(tmp_path / "cameras.json", 1 << 20)
    with pytest.raises(IgsrError, match="frame 0"):  # captures may be larger
        cameras_of(tmp_path / "cameras.json")


@pytest.mark.parametrize("digits", [13, 4000])
def test_sizes_of_thousands_of_digits_are_refused(tmp_path, digits):
    (tmp_path / "sparse").mkdir()
    (tmp_path / "a.png").write_bytes(png(8, 8))
    (tmp_path / "sparse/cameras.txt").write_text(f"1 PINHOLE {'9' * digits} 8 8 8 4 4\n")
    (tmp_path / "sparse/images.txt").write_text("1 1 0 0 0 0 0 0 1 a.png\n\n")
    sentence = refused(igsr.load_capture, tmp_path)
    assert "camera 1: width is more than" in sentence


def test_a_photo_is_not_its_own_depth(tmp_path):
    for folder in ("sparse", "images", "depths"):
        (tmp_path / folder).mkdir()
    (tmp_path / "depths/a.png").write_bytes(png(8, 8, 16, 0))
    (tmp_path / "sparse/cameras.txt").write_text("1 PINHOLE 8 8 8 8 4 4\n")
    for name in ("../depths/a.png", str(tmp_path / "depths/a.png")):
        (tmp_path / "sparse/images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name}\n\n")
        (shot,) = describe_capture(tmp_path).shots
        assert shot.path.samefile(tmp_path / "depths/a.png")
        assert shot.depth_path is None or not shot.depth_path.samefile(shot.path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a full device")
@pytest.mark.parametrize("words", ["--help", "--version"])
def test_a_full_device_is_one_sentence(words):
    with open("/dev/full", "wb") as full:
        result = subprocess.run(
            [sys.executable, "-m", "igsr.cli", *words.split()], stdout=full, stderr=subprocess.PIPE
        )
    assert (result.returncode, result.stderr) == (1, b"No space left on device.\n")
