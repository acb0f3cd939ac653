"""Photos as people have them: formats, turned and damaged files, masks, sub-folders, videos."""

from __future__ import annotations

import math
import struct
import warnings
from pathlib import Path

import av
import numpy as np
import pytest
from capture_files import photo, save
from PIL import Image, ImageOps
from test_capture_photos import write_png

import igsr
from igsr.capture import memory_check
from igsr.capture.photo_folder import load_photos
from igsr.capture.video_frames import MIN_FRAMES, sharpest_frames
from igsr.errors import IgsrError

ORIENTATION, MAKE, MODEL, SUB_FOLDER = 0x0112, 0x010F, 0x0110, 0x8769


def smooth(width: int = 48, height: int = 32) -> np.ndarray:
    """uint8 [H, W, 3] that lossy formats keep nearly as it is."""
    x, y = np.meshgrid(np.linspace(0, 1, width), np.linspace(0, 1, height))
    return np.rint(255 * np.stack([x, y, 0.5 * (x + y)], axis=-1)).astype(np.uint8)


def exif_of(**sub_folder: object) -> Image.Exif:
    exif = Image.Exif()
    exif[MAKE], exif[MODEL] = "Maker ", "Model\0 1"
    tags = {"focal35": 0xA405, "focal": 0x920A, "resolution": 0xA20E, "unit": 0xA210, "w": 0xA002}
    exif.get_ifd(SUB_FOLDER).update({tags[name]: value for name, value in sub_folder.items()})
    return exif


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".heic", ".HEIC", ".tif"])
def test_formats(tmp_path: Path, suffix: str) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    for name in ("a", "b"):
        Image.fromarray(smooth()).save(tmp_path / (name + suffix), quality=95)
    photos = load_photos(tmp_path)
    assert [one.name for one in photos] == ["a" + suffix, "b" + suffix]
    assert photos[0].image.dtype == np.uint8
    assert np.abs(photos[0].image.astype(int) - smooth()).mean() < 4.0
    assert (photos[0].mask, photos[0].focal, photos[0].device) == (None, None, None)


def test_sixteen_bits_and_alpha(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", photo(2).astype(np.uint16) * 257, 2)
    save(tmp_path / "b.png", photo(3, channels=4))
    wide, alpha = load_photos(tmp_path)
    np.testing.assert_array_equal(wide.image, photo(2))
    np.testing.assert_array_equal(alpha.image, photo(3, channels=4))


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    stored = Image.fromarray(photo(1))
    stored.save(tmp_path / "a.png", exif=exif)
    exif[ORIENTATION] = 9  # no such thing
    stored.save(tmp_path / "b.png", exif=exif)
    turned, upright = load_photos(tmp_path)
    with Image.open(tmp_path / "a.png") as image:
        np.testing.assert_array_equal(turned.image, np.array(ImageOps.exif_transpose(image)))
    np.testing.assert_array_equal(upright.image, photo(1))


def test_turned_heic_is_turned_once(tmp_path: Path) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    for name in ("a.heic", "b.heic"):
        Image.fromarray(smooth()).save(tmp_path / name, exif=exif.tobytes(), quality=95)
    image = load_photos(tmp_path)[0].image
    assert image.shape == (48, 32, 3)
    assert np.abs(image.astype(int) - np.rot90(smooth(), -1)).mean() < 4.0


def test_focal_length_and_device_from_exif(tmp_path: Path) -> None:
    stored = Image.fromarray(photo(1, 400, 300))
    stored.save(tmp_path / "a.jpg", exif=exif_of(focal35=26))
    # 8 mm on a plane of 1000 pixels per cm, taken at 800 pixels and reduced to 400.
    plane = exif_of(focal=8.0, resolution=1000.0, unit=3, w=800)
    stored.save(tmp_path / "b.jpg", exif=plane)
    turned = exif_of(focal35=26)
    turned[ORIENTATION] = 6
    stored.save(tmp_path / "c.jpg", exif=turned)
    for name, wrong in (("d", exif_of(focal35=0)), ("e", exif_of(focal35=9000)), ("f", exif_of())):
        stored.save(tmp_path / f"{name}.jpg", exif=wrong)
    photos = load_photos(tmp_path)
    assert photos[0].focal == pytest.approx(26 * 500 / math.hypot(36, 24))
    assert photos[1].focal == pytest.approx(8.0 * 1000 / 10 / 2)
    assert photos[2].focal == photos[0].focal
    assert photos[2].image.shape == (400, 300, 3)
    assert [one.focal for one in photos[3:]] == [None] * 3
    assert {one.device for one in photos} == {"Maker Model 1"}


def test_exif_that_lies_is_no_exif(tmp_path: Path) -> None:
    stored = Image.fromarray(photo(1, 400, 300))
    # 1 mm on film, 1 mm on a plane of 110 pixels per cm, and a kilometre.
    lies = [
        exif_of(focal35=1),
        exif_of(focal=1.0, resolution=110.0, unit=3, w=400),
        exif_of(focal=1e6, resolution=1000.0, unit=3, w=400),
    ]
    for exposure, f_number, iso in ((0.0, 2.0, 100), (0.01, 0.0, 100), (0.01, 2.0, 0)):
        lies.append(exif_of())
        fields = lies[-1].get_ifd(0x8769)
        fields[0x829A], fields[0x829D], fields[0x8827] = exposure, f_number, iso
    for index, lie in enumerate(lies):
        stored.save(tmp_path / f"{index}.jpg", exif=lie)
    photos = load_photos(tmp_path)
    assert [one.focal for one in photos] == [None] * 6
    assert [one.exposure_value for one in photos] == [None] * 6


def test_damaged_exif_is_no_exif(tmp_path: Path) -> None:
    for name in ("a.jpg", "b.jpg"):
        Image.fromarray(photo(1)).save(tmp_path / name, exif=b"Exif\0\0II*\0\xff\xff\xff\xff")
    assert load_photos(tmp_path)[0].focal is None


def test_sub_folders_sizes_and_what_is_passed_over(tmp_path: Path) -> None:
    for name in ("b.png", "a/c.png", "a/d/e.JPG", ".hidden/f.png", ".g.png", "masks/b.png"):
        save(tmp_path / name, photo(1, 20 + len(name), 30))
    save(tmp_path / "masks/b.png", np.full((30, 25), 255, dtype=np.uint8))
    (tmp_path / "notes.txt").write_text("no photo")
    photos = load_photos(str(tmp_path))
    assert [one.name for one in photos] == ["a/c.png", "a/d/e.JPG", "b.png"]
    assert [one.image.shape[1] for one in photos] == [27, 29, 25]


def test_masks_by_either_name(tmp_path: Path) -> None:
    for name in ("1.jpg", "a/2.jpg", "3.jpg"):
        save(tmp_path / "images" / name, photo(1))
    mask = np.zeros((32, 48), dtype=np.uint8)
    mask[:, 20:] = 255
    save(tmp_path / "masks/1.jpg.png", mask)
    save(tmp_path / "masks/a/2.png", 255 - mask)
    photos = {one.name: one for one in load_photos(tmp_path)}
    np.testing.assert_array_equal(photos["1.jpg"].mask, mask > 0)
    np.testing.assert_array_equal(photos["a/2.jpg"].mask, mask == 0)
    assert photos["3.jpg"].mask is None
    assert {one.name for one in load_photos(tmp_path / "images")} == set(photos)
    save(tmp_path / "masks/3.png", mask.T)
    with pytest.warns(UserWarning, match=r"masks/3\.png is 32x48 pixels but its photo 3\.jpg"):
        assert len(load_photos(tmp_path)) == 2


@pytest.mark.parametrize("suffix", [".heic", ".jpg", ".png", ".webp"])
def test_damaged_photo_is_left_out_by_name(tmp_path: Path, suffix: str) -> None:
    import pillow_heif

    pillow_heif.register_heif_opener()
    save(tmp_path / "a.png", photo(1))
    save(tmp_path / "c.png", photo(2))
    broken = tmp_path / ("b" + suffix)
    Image.fromarray(photo(3)).save(broken)
    whole = broken.read_bytes()
    random = np.random.default_rng(0)
    for length in (0, 20, len(whole) // 2):
        broken.write_bytes(whole[:length])
        with pytest.warns(UserWarning, match=rf"One of 3 photos is left out: .*b\{suffix}"):
            assert [one.name for one in load_photos(tmp_path)] == ["a.png", "c.png"]
    for _ in range(20):
        spoilt = bytearray(whole)
        for at in random.integers(0, len(whole), 12):
            spoilt[at] = random.integers(0, 256)
        broken.write_bytes(spoilt)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert len(load_photos(tmp_path)) in (2, 3)
    (tmp_path / "a.png").unlink()
    broken.write_bytes(b"no photo at all")
    with pytest.raises(IgsrError, match=rf"b\{suffix} cannot be read as an image"):
        load_photos(tmp_path)


def test_several_damaged_photos_are_one_sentence(tmp_path: Path) -> None:
    for index in range(3):
        save(tmp_path / f"{index}.png", photo(index))
    for index in range(3, 9):
        (tmp_path / f"{index}.png").write_bytes(b"nothing")
    with pytest.warns(UserWarning, match=r"6 of 9 .*3\.png .*; so are 4\.png, .* and 2 more$"):
        assert len(load_photos(tmp_path)) == 3


def test_mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(IgsrError, match="does not exist"):
        load_photos(tmp_path / "nowhere")
    with pytest.raises(IgsrError, match="holds no photos"):
        load_photos(tmp_path)
    with pytest.raises(IgsrError, match="empty list"):
        load_photos([])
    one = save(tmp_path / "1.png", photo(1))
    with pytest.raises(IgsrError, match="given twice"):
        load_photos([one, one])
    with pytest.raises(IgsrError, match="frames is 0"):
        load_photos(tmp_path, frames=0)
    (tmp_path / "a.txt").write_text("")
    with pytest.raises(IgsrError, match=r"a\.txt is no photo"):
        load_photos([one, tmp_path / "a.txt"])
    two = save(tmp_path / "b/2.png", photo(2))
    assert [photo.name for photo in load_photos([two, one])] == ["b/2.png", "1.png"]
    monkeypatch.setattr(memory_check, "available_memory", lambda: 8192)
    with pytest.raises(IgsrError, match=r"The 2 photos of 48x32 would need 0.0 GB and 0.0 GB are"):
        load_photos(tmp_path)


def write_video(path: Path, frames: list[np.ndarray]) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.bit_rate = 4_000_000
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())


def film(count: int, sharp: set[int]) -> list[np.ndarray]:
    """Stripes, whose number in the first frames' rows says which frame; blurred but for some."""
    frames = []
    for index in range(count):
        pixels = np.full((64, 96, 3), 128.0)
        contrast = 100.0 if index in sharp else 20.0
        pixels[:, ::8] += contrast
        pixels[:, 4::8] -= contrast
        frames.append(pixels.astype(np.uint8))
    return frames


def test_sharpest_frames_evenly_spaced(tmp_path: Path) -> None:
    sharp = {7, 24, 46, 63}  # one in the middle half of each span of 16, but 46's is at an end
    write_video(tmp_path / "clip.mp4", film(64, sharp))
    chosen = [index for index, _ in sharpest_frames(tmp_path / "clip.mp4", 4)]
    assert chosen[:2] == [7, 24]
    assert all(16 * span + 4 <= index < 16 * span + 12 for span, index in enumerate(chosen))
    photos = load_photos(tmp_path, frames=4)
    assert [one.name for one in photos] == [f"clip.mp4/{index:06d}.png" for index in chosen]
    assert {one.device for one in photos} == {"video clip.mp4"}
    assert photos[0].image.shape == (64, 96, 3)
    assert photos[0].image[:, ::8].mean() - photos[0].image[:, 4::8].mean() > 120.0
    assert len(load_photos(tmp_path / "clip.mp4", frames=1000)) == MIN_FRAMES, "it does not move"


def test_a_video_of_one_frame_is_one_photo(tmp_path: Path) -> None:
    write_video(tmp_path / "clip.mp4", film(1, {0}))
    assert [one.name for one in load_photos(tmp_path)] == ["clip.mp4/000000.png"]
    with pytest.raises(IgsrError, match=r"2 photos at least; there is only clip\.mp4/000000\.png"):
        igsr.estimate_poses(tmp_path, "colmap")


def test_video_is_turned_as_its_file_says(tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    frame = np.zeros((64, 96, 3), dtype=np.uint8)
    frame[:, 48:] = 255  # the right half
    write_video(path, [frame] * 4)
    data = bytearray(path.read_bytes())
    # The matrix of the track header, in 16.16 and 2.30 fixed point: a quarter turn clockwise.
    at = data.index(b"tkhd") + 4 + 40
    data[at : at + 36] = struct.pack(">9i", 0, 1 << 16, 0, -1 << 16, 0, 0, 64 << 16, 0, 1 << 30)
    path.write_bytes(data)
    image = load_photos(path, frames=2)[0].image
    assert image.shape == (96, 64, 3)
    assert image[:40].mean() < 30.0
    assert image[56:].mean() > 220.0


def test_damaged_videos(tmp_path: Path) -> None:
    path = tmp_path / "clip.avi"
    write_video(path, film(40, {3}))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    photos = load_photos(path, frames=4)
    assert 1 <= len(photos) <= 4  # what can be read is kept
    for content in (b"", b"no video", whole[:100]):
        path.write_bytes(content)
        with pytest.raises(IgsrError, match=r"clip\.avi (cannot be read as a video|has no frame)"):
            load_photos(path)
