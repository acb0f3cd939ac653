"""Splat files read by numpy, from the formats' descriptions: a second opinion on our readers.

Each decoder returns means, log-scales, quats wxyz, opacities in [0, 1], DC colors in [0, 1] and
higher SH [N, K, 3], in the frame of the file.
"""

import gzip
import io
import json
import struct
import zipfile

import numpy as np
from PIL import Image

C0 = 0.28209479177387814

#: Formats with y up and z back instead of down and forward.
Y_UP = ("spz", "glb", "gltf")
#: Sign that the half turn about x gives each SH coefficient of degree 1 to 3, from the polynomials.
SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float64)


def decode(path):
    """The splats of a file, by its ending, turned to y down."""
    ending = "compressed" if path.name.endswith(".compressed.ply") else path.suffix[1:].lower()
    found = DECODERS[ending](path.read_bytes())
    if ending in Y_UP:
        found["means"] = found["means"] * [1, -1, -1]
        found["quats"] = found["quats"] * [1, 1, -1, -1]
        found["sh"] = found["sh"] * SH_SIGNS[: found["sh"].shape[1], None]
    return found


def largest_from_others(index, others):
    """Quaternions whose component ``index`` is left out."""
    quats = np.zeros((len(index), 4))
    for which in range(4):
        rows = index == which
        quats[np.ix_(rows, [k for k in range(4) if k != which])] = others[rows]
        quats[rows, which] = np.sqrt(np.maximum(0, 1 - (others[rows] ** 2).sum(axis=1)))
    return quats


def ply(content):
    head, body = content.split(b"end_header\n", 1)
    lines = head.decode().splitlines()
    count = next(int(line.split()[2]) for line in lines if line.startswith("element"))
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    table = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]), count)

    def columns(prefix, number):
        return np.stack([table[f"{prefix}{k}"] for k in range(number)], axis=1).astype(np.float64)

    rest = sum(name.startswith("f_rest_") for name in names)
    sh = columns("f_rest_", rest).reshape(count, 3, -1).transpose(0, 2, 1) if rest else None
    return {
        "means": np.stack([table[axis] for axis in "xyz"], axis=1).astype(np.float64),
        "scales": columns("scale_", 3),
        "quats": columns("rot_", 4),
        "opacities": 1 / (1 + np.exp(-table["opacity"].astype(np.float64))),
        "colors": 0.5 + C0 * columns("f_dc_", 3),
        "sh": np.zeros((count, 0, 3)) if sh is None else sh,
    }


def compressed(content):
    head, body = content.split(b"end_header\n", 1)
    counts, floats, rest = {}, 0, 0
    for line in head.decode().splitlines():
        words = line.split()
        if words[0] == "element":
            counts[words[1]] = int(words[2])
        floats += words[:2] == ["property", "float"]
        rest += words[:2] == ["property", "uchar"]
    bounds = np.frombuffer(body, "<f4", counts["chunk"] * floats).reshape(-1, floats)
    start, count = bounds.nbytes, counts["vertex"]
    packed = np.frombuffer(body, "<u4", count * 4, start).reshape(-1, 4).astype(np.int64)
    bounds = bounds.astype(np.float64)[np.arange(count) // 256]
    sh = np.frombuffer(body, np.uint8, count * rest, start + 16 * count).reshape(count, 3, -1)

    def lerp(first, unit):
        low, high = bounds[:, first : first + 3], bounds[:, first + 3 : first + 6]
        return low + (high - low) * unit

    def three(column):
        bits = packed[:, column]
        parts = [(bits >> 21) / 2047, (bits >> 11 & 1023) / 1023, (bits & 2047) / 2047]
        return np.stack(parts, axis=1)

    rotation, color = packed[:, 1], packed[:, 3]
    others = np.stack([rotation >> shift & 1023 for shift in (20, 10, 0)], axis=1) / 1023 - 0.5
    rgb = np.stack([color >> shift & 255 for shift in (24, 16, 8)], axis=1) / 255
    unit = (sh.astype(np.float64) + 0.5) / 256
    unit[sh == 0], unit[sh == 255] = 0, 1
    return {
        "means": lerp(0, three(0)),
        "scales": lerp(6, three(2)),
        "quats": largest_from_others(rotation >> 30, others * np.sqrt(2)),
        "opacities": (color & 255) / 255,
        "colors": lerp(12, rgb) if floats == 18 else rgb,
        "sh": (unit.transpose(0, 2, 1) - 0.5) * 8,
    }


def splat(content):
    kind = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
    table = np.frombuffer(content, kind)
    return {
        "means": table["mean"].astype(np.float64),
        "scales": np.log(table["scale"].astype(np.float64)),
        "quats": table["quat"] / 128 - 1,
        "opacities": table["rgba"][:, 3] / 255,
        "colors": table["rgba"][:, :3] / 255,
        "sh": np.zeros((len(table), 0, 3)),
    }


def ksplat(content):
    """Of compression level 0 and one section only."""
    count, _, _, buckets = struct.unpack_from("<4I", content, 4096)
    (sections,), (partial,) = (struct.unpack_from("<I", content, at) for at in (4, 4096 + 36))
    (stored,), (degree,) = (struct.unpack_from("<H", content, 4096 + at) for at in (20, 40))
    assert (content[0], content[1], content[20]) == (0, 1, 0)
    assert (sections, degree) == (1, 0)
    floats = ("mean", "<f4", 3), ("scale", "<f4", 3), ("quat", "<f4", 4), ("rgba", "u1", 4)
    start = 4096 + 1024 + 4 * partial + stored * buckets
    table = np.frombuffer(content, np.dtype(list(floats)), count, start)
    return {
        "means": table["mean"].astype(np.float64),
        "scales": np.log(table["scale"].astype(np.float64)),
        "quats": table["quat"].astype(np.float64),
        "opacities": table["rgba"][:, 3] / 255,
        "colors": table["rgba"][:, :3] / 255,
        "sh": np.zeros((count, 0, 3)),
    }


def spz(content):
    """Of versions 2 and 3: numpy brings no zstd for version 4."""
    content = gzip.decompress(content)
    magic, version, count, degree, fraction, _, _ = struct.unpack_from("<4sIIBBBB", content)
    assert magic == b"NGSP"
    assert version in (2, 3)
    start = 16

    def take(width):
        nonlocal start
        rows = np.frombuffer(content, np.uint8, count * width, start).reshape(count, width)
        start += count * width
        return rows.astype(np.int64)

    fixed = (take(9).reshape(count, 3, 3) * [1, 1 << 8, 1 << 16]).sum(axis=2)
    fixed -= (fixed >= 1 << 23) * (1 << 24)
    alphas, colors, scales = take(1)[:, 0], take(3), take(3)
    if version == 2:
        xyz = take(3) / 127.5 - 1
        w = np.sqrt(np.maximum(0, 1 - (xyz**2).sum(axis=1)))
        xyzw = np.concatenate([xyz, w[:, None]], axis=1)
    else:
        packed = (take(4) * [1, 1 << 8, 1 << 16, 1 << 24]).sum(axis=1)
        parts = np.stack([packed >> shift & 1023 for shift in (20, 10, 0)], axis=1)
        sign = np.where(parts & 512, -1.0, 1.0)
        xyzw = largest_from_others(packed >> 30, sign * (parts & 511) / 511 / np.sqrt(2))
    bands = (degree + 1) ** 2 - 1
    return {
        "means": fixed / 2.0**fraction,
        "scales": scales / 16 - 10,
        "quats": np.roll(xyzw, 1, axis=1),
        "opacities": alphas / 255,
        "colors": 0.5 + C0 * (colors / 255 - 0.5) / 0.15,
        "sh": (take(3 * bands).reshape(count, bands, 3) - 128) / 128,
    }


def sog(content):
    archive = zipfile.ZipFile(io.BytesIO(content))
    meta = json.loads(archive.read("meta.json"))
    count = meta["count"]

    def image(name):
        with Image.open(io.BytesIO(archive.read(name))) as picture:
            return np.asarray(picture.convert("RGBA")).astype(np.int64)

    def pixels(part, which=0):
        return image(meta[part]["files"][which]).reshape(-1, 4)[:count]

    low, high = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    place = (pixels("means", 0)[:, :3] + 256 * pixels("means", 1)[:, :3]) / 65535
    logs = low + (high - low) * place
    quats, sh0 = pixels("quats"), pixels("sh0")
    others = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
    sh = np.zeros((count, 0, 3))
    if "shN" in meta:
        bands = (meta["shN"]["bands"] + 1) ** 2 - 1
        centroids, labels = sorted(meta["shN"]["files"])
        codes = image(centroids)[:, :, :3].reshape(-1, 64, bands, 3).reshape(-1, bands, 3)
        label = image(labels).reshape(-1, 4)[:count]
        sh = np.array(meta["shN"]["codebook"])[codes[label[:, 0] + 256 * label[:, 1]]]
    return {
        "means": np.sign(logs) * np.expm1(np.abs(logs)),
        "scales": np.array(meta["scales"]["codebook"])[pixels("scales")[:, :3]],
        "quats": largest_from_others(quats[:, 3] - 252, others),
        "opacities": sh0[:, 3] / 255,
        "colors": 0.5 + C0 * np.array(meta["sh0"]["codebook"])[sh0[:, :3]],
        "sh": sh,
    }


def glb(content):
    """Of one primitive of floats, its node shifted at most."""
    magic, version, _, length, kind = struct.unpack_from("<4sII I4s", content)
    assert (magic, version, kind) == (b"glTF", 2, b"JSON")
    document = json.loads(content[20 : 20 + length])
    binary = content[28 + length :]
    attributes = document["meshes"][0]["primitives"][0]["attributes"]

    def rows(name):
        accessor = document["accessors"][attributes[name]]
        view = document["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        assert accessor["componentType"] == 5126
        count = accessor["count"]
        data = np.frombuffer(binary, "<f4", count * width, view["byteOffset"])
        return data.reshape(count, width).astype(np.float64)

    prefix = "KHR_gaussian_splatting:"
    higher = [
        rows(f"{prefix}SH_DEGREE_{degree}_COEF_{k}")
        for degree in (1, 2, 3)
        for k in range(2 * degree + 1)
        if f"{prefix}SH_DEGREE_{degree}_COEF_{k}" in attributes
    ]
    means = rows("POSITION")
    return {
        "means": means + document["nodes"][0].get("translation", [0, 0, 0]),
        "scales": np.log(rows(f"{prefix}SCALE")),
        "quats": np.roll(rows(f"{prefix}ROTATION"), 1, axis=1),
        "opacities": rows(f"{prefix}OPACITY")[:, 0],
        "colors": 0.5 + C0 * rows(f"{prefix}SH_DEGREE_0_COEF_0"),
        "sh": np.stack(higher, axis=1) if higher else np.zeros((len(means), 0, 3)),
    }


DECODERS = {
    "ply": ply,
    "compressed": compressed,
    "splat": splat,
    "ksplat": ksplat,
    "spz": spz,
    "sog": sog,
    "glb": glb,
}
