"""Photos in the pixel formats of cameras and tools, and files that are not photos."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, assert_refused, photo, save, write_transforms
from PIL import Image

from igsr.capture import load_capture
from igsr.errors import IgsrError


def write_png(path, pixels, color_type):
    """A 16-bit PNG, which Pillow cannot write in color."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)

    def chunk(kind, data):
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    header = struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0)
    chunks = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def loaded(folder, image, name="photo.png", **options):
    """The pixels that igsr loads of an image, or of a file that exists already."""
    write_transforms(folder, 1, {"file_path": f"images/{name}"})
    if image is not None:
        image.save(folder / "images" / name, **options)
    return load_capture(folder).views[0].image


GRAY, TWO = photo(1)[..., 0], photo(1, channels=2)
BITS = Image.fromarray(GRAY).convert("1")
PALETTE = Image.fromarray(photo(1)).quantize(16)
SIXTEEN_BITS = Image.fromarray(GRAY.astype(np.uint16) * 257)


@pytest.mark.parametrize(
    ("image", "name", "expected"),
    [
        (Image.fromarray(photo(1)), "photo.png", photo(1)),
        (Image.fromarray(photo(1, channels=4)), "photo.png", photo(1, channels=4)),
        (Image.fromarray(GRAY), "photo.png", GRAY[..., None].repeat(3, axis=2)),
        (BITS, "photo.png", np.array(BITS.convert("RGB"))),
        (Image.fromarray(TWO, mode="LA"), "photo.png", TWO[..., [0, 0, 0, 1]]),
        (SIXTEEN_BITS, "photo.png", GRAY[..., None].repeat(3, axis=2)),
        (SIXTEEN_BITS, "photo.tif", GRAY[..., None].repeat(3, axis=2)),
        (PALETTE, "photo.png", np.array(PALETTE.convert("RGB"))),
    ],
)
def test_pixel_formats(image, name, expected, tmp_path):
    np.testing.assert_array_equal(loaded(tmp_path, image, name), expected)


def test_palette_with_transparency(tmp_path):
    out = loaded(tmp_path, PALETTE, transparency=3)
    assert out.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(out[..., 3] == 0, np.array(PALETTE) == 3)


def test_cmyk(tmp_path):
    pixels = np.full((HEIGHT, WIDTH, 3), (200, 60, 30), dtype=np.uint8)
    out = loaded(tmp_path, Image.fromarray(pixels).convert("CMYK"), "photo.jpg")
    assert np.abs(out.astype(int) - pixels).max() <= 4


def test_unsupported_pixels_are_named(tmp_path):
    for dtype, words in ((np.float32, "floating-point"), (np.int32, "32-bit")):
        image = Image.fromarray(np.full((HEIGHT, WIDTH), 1 << 20, dtype))
        assert_refused(rf"photo\.tif has {words} pixels", loaded, tmp_path, image, "photo.tif")


def test_exif_orientation_is_never_applied(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate a quarter turn
    pixels = loaded(tmp_path, Image.fromarray(photo(1)), exif=exif)
    np.testing.assert_array_equal(pixels, photo(1))
    with pytest.raises(IgsrError, match=r"is 32x48 pixels but its camera .* EXIF orientation"):
        loaded(tmp_path, Image.fromarray(photo(1, HEIGHT, WIDTH)), exif=exif)


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif"])
def test_truncated_photos_are_refused(suffix, tmp_path):
    whole = loaded(tmp_path, Image.fromarray(photo(1)), f"photo.{suffix}")
    path = tmp_path / f"images/photo.{suffix}"
    data = path.read_bytes()
    for length in [*range(0, 100, 3), *range(100, len(data) - 200, 97)]:
        path.write_bytes(data[:length])
        with pytest.raises(IgsrError, match=r"photo\.\w+ (cannot be read as|is truncated|claims)"):
            load_capture(tmp_path)
    path.write_bytes(data)
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].image, whole)


def test_bad_photos_are_named_in_order(tmp_path):
    write_transforms(tmp_path, 6)
    for index in (2, 4):
        save(tmp_path / f"images/{index}.png", photo(0, WIDTH + index, HEIGHT))
    assert_refused(r"images/2\.png is 50x32", load_capture, tmp_path)
    (tmp_path / "images/1.png").write_text("no image")
    assert_refused(r"images/1\.png cannot be read as an image", load_capture, tmp_path)


@pytest.mark.parametrize(
    ("side", "words"),
    [(9000, "claims 9000x9000 pixels but has only"), (120000, "claims too many pixels")],
)
def test_claimed_size_is_compared_with_that_of_the_file(side, words, tmp_path):
    """A file of 60 bytes that claims 9000x9000 pixels would take 240 MB to decode."""
    path = tmp_path / "images/huge.png"
    path.parent.mkdir()
    write_png(path, photo(1, 2, 2).astype(np.uint16), 2)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", side, side)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    assert_refused(words, loaded, tmp_path, None, "huge.png")
