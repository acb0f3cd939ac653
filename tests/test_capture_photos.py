"""Photos in the pixel formats that cameras and tools write, and files that are no photos."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from capture_files import HEIGHT, WIDTH, photo, save, write_json, write_transforms
from PIL import Image

from igsr.capture import load_capture
from igsr.errors import IgsrError


def write_png(path: Path, pixels: np.ndarray, color_type: int) -> None:
    """A 16-bit PNG, which Pillow cannot write in color."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)

    def chunk(kind: bytes, data: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + checksum

    header = struct.pack(">IIBBBBB", width, height, 16, color_type, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def loaded(folder: Path, image: Image.Image, name: str = "0.png") -> np.ndarray:
    """The pixels igsr makes of an image saved under a name."""
    document = write_transforms(folder, 1)
    path = folder / "images" / name
    image.save(path)
    return load_named(folder, document, name)


def load_named(folder: Path, document: dict, name: str) -> np.ndarray:  # type: ignore[type-arg]
    document["frames"][0]["file_path"] = f"images/{name}"
    write_json(folder / "transforms.json", document)
    return load_capture(folder).views[0].image


def test_rgb_and_rgba_come_as_stored(tmp_path: Path) -> None:
    for channels in (3, 4):
        pixels = photo(1, channels=channels)
        np.testing.assert_array_equal(loaded(tmp_path, Image.fromarray(pixels)), pixels)


def test_grays(tmp_path: Path) -> None:
    gray = photo(1)[..., 0]
    expected = np.repeat(gray[..., None], 3, axis=2)
    np.testing.assert_array_equal(loaded(tmp_path, Image.fromarray(gray)), expected)
    bits = Image.fromarray(gray).convert("1")
    np.testing.assert_array_equal(loaded(tmp_path, bits), np.array(bits.convert("RGB")))


def test_gray_with_alpha(tmp_path: Path) -> None:
    pixels = photo(1, channels=2)
    out = loaded(tmp_path, Image.fromarray(pixels, mode="LA"))
    np.testing.assert_array_equal(out, pixels[..., [0, 0, 0, 1]])


def test_sixteen_bits(tmp_path: Path) -> None:
    gray = photo(1)[..., 0]
    expected = np.repeat(gray[..., None], 3, axis=2)
    wide = Image.fromarray(gray.astype(np.uint16) * 257)
    np.testing.assert_array_equal(loaded(tmp_path, wide), expected)
    np.testing.assert_array_equal(loaded(tmp_path, wide, "0.tif"), expected)
    document = write_transforms(tmp_path, 1)
    write_png(tmp_path / "images/rgb.png", photo(2).astype(np.uint16) * 257, 2)
    np.testing.assert_array_equal(load_named(tmp_path, document, "rgb.png"), photo(2))


def test_palettes(tmp_path: Path) -> None:
    palette = Image.fromarray(photo(1)).quantize(16)
    np.testing.assert_array_equal(loaded(tmp_path, palette), np.array(palette.convert("RGB")))
    palette.info["transparency"] = 3
    document = write_transforms(tmp_path, 1)
    palette.save(tmp_path / "images/p.png", transparency=3)
    out = load_named(tmp_path, document, "p.png")
    assert out.shape == (HEIGHT, WIDTH, 4)
    np.testing.assert_array_equal(out[..., 3] == 0, np.array(palette) == 3)


def test_cmyk(tmp_path: Path) -> None:
    pixels = np.full((HEIGHT, WIDTH, 3), (200, 60, 30), dtype=np.uint8)
    out = loaded(tmp_path, Image.fromarray(pixels).convert("CMYK"), "0.jpg")
    assert np.abs(out.astype(int) - pixels).max() <= 4


def test_floating_point_pixels_are_refused(tmp_path: Path) -> None:
    image = Image.fromarray(np.zeros((HEIGHT, WIDTH), dtype=np.float32))
    with pytest.raises(IgsrError, match=r"0\.tif has floating-point pixels"):
        loaded(tmp_path, image, "0.tif")


def test_exif_orientation_is_never_applied(tmp_path: Path) -> None:
    """The camera's size decides what the pixels mean: as stored, or not at all."""
    exif = Image.Exif()
    exif[0x0112] = 6  # rotate a quarter turn
    document = write_transforms(tmp_path, 1)
    path = tmp_path / "images/turned.png"
    Image.fromarray(photo(1)).save(path, exif=exif)
    np.testing.assert_array_equal(load_named(tmp_path, document, "turned.png"), photo(1))
    Image.fromarray(photo(1, HEIGHT, WIDTH)).save(path, exif=exif)
    with pytest.raises(IgsrError, match=r"is 32x48 pixels but its camera .* EXIF orientation"):
        load_named(tmp_path, document, "turned.png")


@pytest.mark.parametrize("name", ["0.png", "0.jpg", "0.webp", "0.tif"])
def test_photo_cut_short_anywhere_is_refused(name: str, tmp_path: Path) -> None:
    """Nothing but the sentence comes out, whatever Pillow makes of the stump."""
    whole = loaded(tmp_path, Image.fromarray(photo(1)), name)
    path = tmp_path / "images" / name
    data = path.read_bytes()
    for length in [*range(0, 100, 3), *range(100, len(data) - 200, 97)]:
        path.write_bytes(data[:length])
        with pytest.raises(IgsrError, match=r"0\.\w+ (cannot be read as|is truncated|claims)"):
            load_capture(tmp_path)
    path.write_bytes(data)
    np.testing.assert_array_equal(load_capture(tmp_path).views[0].image, whole)


def test_text_named_png_is_refused(tmp_path: Path) -> None:
    write_transforms(tmp_path)
    (tmp_path / "images/1.png").write_text("no image")
    with pytest.raises(IgsrError, match=r"images/1\.png cannot be read as an image"):
        load_capture(tmp_path)


def test_claimed_size_is_held_against_the_file_s(tmp_path: Path) -> None:
    """A stump of 60 bytes that claims 9000x9000 pixels would take 240 MB to decode."""
    document = write_transforms(tmp_path, 1, w=9000, h=9000)
    path = tmp_path / "images/huge.png"
    write_png(path, photo(1, 2, 2).astype(np.uint16), 2)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 9000, 9000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    with pytest.raises(IgsrError, match="claims 9000x9000 pixels but has only"):
        load_named(tmp_path, document, "huge.png")
    data[16:24] = struct.pack(">II", 120000, 120000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    with pytest.raises(IgsrError, match="claims too many pixels"):
        load_named(tmp_path, document, "huge.png")


def test_first_bad_photo_in_order_is_named(tmp_path: Path) -> None:
    write_transforms(tmp_path, 6)
    for index in (2, 4):
        save(tmp_path / f"images/{index}.png", photo(0, WIDTH + index, HEIGHT))
    with pytest.raises(IgsrError, match=r"images/2\.png is 50x32"):
        load_capture(tmp_path)
