"""Files that a user or another file names may be pipes, devices, too large, or bombs."""

from __future__ import annotations

import functools
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
from measured_process import measured
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
from igsr.capture.exif import read_exif
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
    """The result of some work, and the bytes that it took at most; 0 if the system cannot tell."""
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
    # The limit on pixels per byte allows a picture of zeros with these bytes.
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


@pytest.mark.filterwarnings("ignore:fields overlap")
@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP", "TIFF"])
def test_fields_of_a_photo_do_not_share_their_bytes(tmp_path, kind):
    count, size = 8000, 100_000
    fields = b"".join(struct.pack("<HHII", 1000 + k, 7, size, 8) for k in range(count))
    exif = (b"II*\0" + struct.pack("<IH", 8, count) + fields).ljust(size + 8, b"\0")
    file, small = io.BytesIO(), Image.new("RGB", (8, 8))
    if kind == "JPEG":
        small.save(file, kind)
        pieces = (b"Exif\0\0" + exif[at : at + 60_000] for at in (0, 60_000))
        segments = (b"\xff\xe1" + struct.pack(">H", len(piece) + 2) + piece for piece in pieces)
        content = file.getvalue()[:2] + b"".join(segments) + file.getvalue()[2:]
    elif kind == "TIFF":
        content = exif
    else:
        small.save(file, kind, exif=exif)
        content = file.getvalue()
    (tmp_path / "a.png").write_bytes(content)

    def focal(path):
        with open_image(path) as image:
            return read_exif(image).focal

    assert ("cannot be read" in refused(focal, tmp_path / "a.png")) == (kind == "TIFF")


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


IGSR = (sys.executable, "-m", "igsr.cli")
#: Shows the photo with a number, given as FOLDER?NUMBER, on the page of a live view.
SHOW = """
import sys
from pathlib import Path
from igsr.cli.error_messages import error_messages
from web_views import served, with_token
folder, _, number = sys.argv[1].partition("?")
with error_messages(), served(Path(folder)) as server:
    status, content = with_token(server, "photo?number=" + (number or "0"))
sys.exit(None if status == 200 else content.decode())
"""
DRAW = ("-m", "igsr.rendering.window", "--backend", "cpu", "--size")
#: Commands by the names below; an input and a free place are filled in.
COMMANDS = {
    "info": (*IGSR, "info", "{input}"),
    "load": (*IGSR, "convert", "{input}", "{out}"),
    "page": (*IGSR, "convert", "{input}", "{out}.html"),
    "show": (sys.executable, "-c", SHOW, "{input}"),
    "draw": (sys.executable, *DRAW, "{size}", "--screenshot", "{out}.png", "{input}"),
    "resume": (*IGSR, "fit", "{capture}", "--resume", "--out", "{input}"),
    "denoise": (*IGSR, "denoise", "{scene}", "--capture", "{capture}", "--out", "{out}")
    + ("--denoiser", "{input}"),
}
#: Bytes of addresses for each command. torch takes most of them for itself.
ADDRESSES = {**dict.fromkeys(COMMANDS, 2 << 30), "denoise": 16 << 30}


def shown(folder, content, photo="in.png"):
    """A folder of cameras whose photo has this content."""
    made = scenes.capture(views=1, size=8).views[0]
    (folder / photo).write_bytes(content)
    write_cameras(folder / "cameras.json", [igsr.View(photo, made.camera, "train", made.image)])
    return folder


def capture(folder, **fields):
    write_transforms(folder, **fields)
    return folder


def depths(folder, name, content, size=None):
    (folder / name).write_bytes(content)
    if size is not None:
        os.truncate(folder / name, size)  # takes no disk
    return capture(folder, frame={"depth_file_path": name})


def pipe(path):
    os.mkfifo(path)
    return path


def report(folder, make):
    """A scene and its report, which ``make`` writes."""
    scenes.splats().save(folder / "scene.ply")
    make(folder / "report.json")
    return folder / "scene.ply"


def zeros(path):
    path.symlink_to("/dev/zero")


def exr(folder):
    """An EXR of a hundred channels of 2000 x 2000 numbers, without its data."""

    def attribute(name, kind, value):
        return f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value

    names = sorted(["Z", *(f"c{number}" for number in range(99))])
    channels = b"".join(n.encode() + b"\0" + struct.pack("<iiii", 2, 0, 1, 1) for n in names)
    window = struct.pack("<iiii", 0, 0, 1999, 1999)
    content = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    content += attribute("channels", "chlist", channels + b"\0")
    content += attribute("compression", "compression", b"\0")
    content += attribute("dataWindow", "box2i", window)
    content += attribute("displayWindow", "box2i", window)
    content += attribute("lineOrder", "lineOrder", b"\0")
    content += attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0))
    content += attribute("screenWindowCenter", "v2f", struct.pack("<ff", 0.0, 0.0))
    content += attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)) + b"\0"
    return depths(folder, "depth.exr", content, 2 << 30)


def spellings(folder):
    """A glTF that names a file of 20 MB by 60 spellings."""
    (folder / "aaaaaa.bin").write_bytes(bytes(20 << 20))
    names = ("".join(("a", "%61")[k >> bit & 1] for bit in range(6)) for k in range(60))
    buffers = [{"byteLength": 20 << 20, "uri": f"{name}.bin"} for name in names]
    document = {"asset": {"version": "2.0"}, "buffers": buffers}
    (folder / "a.gltf").write_text(json.dumps(document))
    return folder / "a.gltf"


def properties(folder):
    header = "".join(f"property uchar p{number}\n" for number in range(1_000_000))
    content = f"ply\nformat ascii 1.0\nelement vertex 1\n{header}end_header\n"
    (folder / "a.ply").write_text(content + "0 " * 1_000_000)
    return capture(folder, ply_file_path="a.ply")


def levels(folder):
    (folder / "lod-meta.json").write_text('{"a": [' + '{"":0},' * 8_500_000 + "{}]}")
    return folder


def scene(folder):
    scenes.splats().save(folder / "scene.ply")
    return folder / "scene.ply"


def progressive(folder):
    file = io.BytesIO()
    Image.new("RGB", (5600, 5600)).save(file, "JPEG", progressive=True, subsampling=0)
    return shown(folder, file.getvalue(), "in.jpg")


def vast(kind):
    """A photo of one color whose header claims 12000 x 10000 pixels; its data has 64 x 64."""
    pillow_heif.register_heif_opener()
    file = io.BytesIO()
    Image.new("RGB", (64, 64)).save(file, kind)
    size = struct.pack(">II", 64, 64)
    assert size in file.getvalue()
    return file.getvalue().replace(size, struct.pack(">II", 12000, 10000)) + bytes(20_000)


def vast_photo(folder, content):
    write_transforms(folder, w=12000, h=10000)
    for photo in (folder / "images").iterdir():
        photo.write_bytes(content)
    return folder


def small_photo():
    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "PNG")
    return file.getvalue()


def colmap(folder, width="8", name="a.png"):
    (folder / "sparse").mkdir()
    (folder / "a.png").write_bytes(png(8, 8))
    (folder / "sparse/cameras.txt").write_text(f"1 PINHOLE {width} 8 8 8 4 4\n")
    (folder / "sparse/images.txt").write_text(f"1 1 0 0 0 0 0 0 1 {name.format(folder)}\n\n")
    return folder


def checkpoint(folder, header):
    with zipfile.ZipFile(folder / "checkpoint.npz", "w") as archive:
        archive.writestr("settings.npy", header)
    return folder


SIGNS = BROKEN_ARRAYS["signs"]


#: Hostile inputs: the command, and a function that makes its input in a folder.
def rationals(folder):
    """A capture whose photos have an EXIF field of two million values."""
    count = 2_000_000
    field = struct.pack("<IHHHIII", 8, 1, 0x829A, 5, count, 26, 0)
    made = capture(folder)
    for photo in (made / "images").iterdir():
        with Image.open(photo) as image:
            image.save(photo, "PNG", exif=b"Exif\0\0II*\0" + field + bytes(8 * count))
    return made


HOSTILE = {
    "a scene that is a pipe": ("info", lambda folder: pipe(folder / "a.ply")),
    "points that are a pipe": (
        "info",
        lambda folder: capture(folder, ply_file_path=pipe(folder / "a.ply").name),
    ),
    "points without end": ("info", lambda folder: capture(folder, ply_file_path="/dev/zero")),
    "points of a million properties": ("info", properties),
    "report that is a pipe": ("page", lambda folder: report(folder, pipe)),
    "report without end": ("page", lambda folder: report(folder, zeros)),
    "vast depth": ("load", lambda folder: depths(folder, "d.png", png(9000, 9000, 16, 0))),
    "sparse depth": (
        "load",
        lambda folder: depths(folder, "d.npy", npy(HEADER.format((50000, 40000))), 8 * 10**9 + 128),
    ),
    "depth of many channels": ("load", exr),
    "vast PNG": ("load", lambda folder: vast_photo(folder, png(12000, 10000))),
    "vast AVIF": ("load", lambda folder: vast_photo(folder, vast("AVIF"))),
    "vast HEIC": ("load", lambda folder: vast_photo(folder, vast("HEIF"))),
    "vast PNG on the page": ("show", lambda folder: shown(folder, png(13000, 13000))),
    "vast AVIF on the page": ("show", lambda folder: shown(folder, vast("AVIF"))),
    "progressive JPEG on the page": ("show", progressive),
    "photo number": ("show", lambda folder: f"{shown(folder, png(8, 8))}?{'9' * 5000}"),
    "one file by many spellings": ("info", spellings),
    "index of empty objects": ("draw", levels),
    "vast picture": ("draw", scene),
    "checkpoint of signs": ("resume", lambda folder: checkpoint(folder, SIGNS)),
    "EXIF of many values": ("load", rationals),
    "width of many digits": ("load", lambda folder: colmap(folder, "9" * 4000)),
    "absolute name": ("load", lambda folder: colmap(folder, name="/dev/zero")),
    "weights that are a pipe": ("denoise", lambda folder: pipe(folder / "a.safetensors")),
}
#: These files may be missing; igsr goes on without them.
OPTIONAL = ("report that is a pipe", "report without end", "EXIF of many values")
#: Photos often have no EXIF, so this is no reason for a message.
SILENT = "EXIF of many values"
#: torch takes seconds to load.
LONG = ("weights that are a pipe",)
#: Small inputs of the commands.
SMALL = {
    **dict.fromkeys(("info", "page", "draw"), scene),
    "load": capture,
    "show": lambda folder: shown(folder, small_photo()),
    "resume": lambda folder: checkpoint(folder, npy(HEADER.format((1,))) + bytes(4)),
    "denoise": lambda folder: folder / "missing.safetensors",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Runs a command on an input that is made for it."""
    usual = tmp_path_factory.mktemp("usual")
    scenes.write_capture(usual / "capture", scenes.capture(views=2, size=16))
    given = {"scene": scene(usual), "capture": usual / "capture"}

    @functools.cache
    def run(command, make, size="16x16"):
        folder = tmp_path_factory.mktemp("input")
        out = tmp_path_factory.mktemp("out") / "out"
        places = {**given, "input": make(folder), "out": out, "size": size}
        words = (word if word == SHOW else word.format(**places) for word in COMMANDS[command])
        return measured(words, ADDRESSES[command])

    return run


@pytest.mark.skipif(sys.platform != "linux", reason="address spaces are limited on Linux only")
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.long if name in LONG else ()) for name in HOSTILE],
)
def test_hostile_inputs_take_little(run, monkeypatch, name):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT / "py"), str(ROOT / "tests")]))
    command, make = HOSTILE[name]
    usual = run(command, SMALL[command])
    hostile = run(command, make, "16384x16384" if name == "vast picture" else "16x16")
    assert hostile.status == (0 if name in OPTIONAL else 1), hostile.errors
    assert not re.search("Traceback|Warning|panicked", hostile.errors), hostile.errors
    if name == SILENT:
        assert hostile.errors == ""
    else:
        last = hostile.errors.splitlines()[-1]
        assert last.endswith("."), last
        assert len(last) < 500
    assert hostile.seconds < usual.seconds + 2.0
    assert hostile.peak < usual.peak + MEMORY


@pytest.mark.skipif(sys.platform != "linux", reason="address spaces are limited on Linux only")
@pytest.mark.parametrize("command", ["denoise", "refine", "pose"])
def test_libraries_without_memory_are_one_sentence(tmp_path, monkeypatch, command):
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "py"))
    photos = capture(tmp_path) / "images"
    options = {"denoise": ("--capture", photos), "pose": ("--estimator", "da3")}
    words = [command, photos, *options.get(command, ()), "--out", tmp_path / "out"]
    ended = measured([*IGSR, *words], 1 << 30)
    assert ended.status == 1
    assert re.fullmatch(r"[^\n]*free memory, or raise its limit[^\n]*\n", ended.errors), (
        ended.errors
    )


BROKEN_EXIF = b"Exif\0\0II*\0" + struct.pack("<IHHHII", 8, 3, 0x010F, 2, 5000, 90000)


@pytest.mark.parametrize(
    "words", [("info",), ("pose", "--out", "out"), ("fit", "--out", "out", "--backend", "cpu")]
)
def test_warnings_of_pillow_are_not_printed(tmp_path, words):
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.new("RGB", (64, 64)).save(photos / "0.jpg", exif=BROKEN_EXIF)
    (photos / "a.png").write_bytes(png(9500, 9500))
    with pytest.warns(UserWarning, match="Corrupt EXIF|Truncated|overlap"):
        Image.open(photos / "0.jpg").getexif()
    with pytest.warns(Image.DecompressionBombWarning):
        Image.open(photos / "a.png")
    command = [*IGSR, words[0], photos, *words[1:]]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert ended.returncode in (0, 1)
    printed = ended.stdout + ended.stderr
    assert printed
    assert not re.search(r"Warning|warn\(|EXIF|exceeds limit|Traceback|Truncated", printed), printed
