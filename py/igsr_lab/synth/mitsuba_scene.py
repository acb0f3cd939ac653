"""Mitsuba 3: make its scenes and sensors from descriptions and viewpoints, and render them.

The variant ``scalar_rgb`` needs no driver and no LLVM. Its results do not depend on the number of
threads: images are divided into blocks of a fixed size, each with its own seed.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from igsr.errors import IgsrError
from igsr_lab.synth.cameras import Viewpoint
from igsr_lab.synth.description import Description, Light, Material, Part
from igsr_lab.synth.meshes import Mesh, vertex_normals
from igsr_lab.synth.textures import to_linear, to_srgb

VARIANT = "scalar_rgb"
#: Maximum length of light paths; longer ones only brighten dark corners.
MAX_DEPTH = 3
#: Side of the blocks that are rendered with one seed.
BLOCK_SIZE_PX = 32
#: Start of rays, z along the camera's axis, world units.
NEAR_CLIP = 0.01


@contextlib.contextmanager
def one_threaded_mitsuba() -> Iterator[Any]:
    """Set Mitsuba's variant and one thread; restore both at the end."""
    try:
        import drjit
        import mitsuba
        import pyoidn  # noqa: F401
    except ImportError as error:
        raise IgsrError(
            "Synthetic captures need Mitsuba 3 and Open Image Denoise; install them with: "
            "pip install 'igsr[synth]'."
        ) from error
    variant, threads = mitsuba.variant(), drjit.thread_count()
    mitsuba.set_variant(VARIANT)
    drjit.set_thread_count(1)
    try:
        yield mitsuba
    finally:
        drjit.set_thread_count(threads)
        if variant is not None:
            mitsuba.set_variant(variant)


def bitmap(picture: np.ndarray) -> dict[str, Any]:
    """Mitsuba's dictionary of a texture, sRGB in [0, 1], [H, W, 3]."""
    import mitsuba as mi

    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(to_linear(picture).astype(np.float32)),
        "raw": True,
        "wrap_mode": "repeat",
    }


def shape(mesh: Mesh, bsdf: Any, smooth: bool = True) -> Any:
    """A Mitsuba mesh with a BSDF; ``smooth`` interpolates normals."""
    import mitsuba as mi

    vertices, faces, uv = mesh
    properties = mi.Properties()
    properties["mesh_bsdf"] = bsdf
    properties["face_normals"] = not smooth
    result = mi.Mesh(
        "mesh",
        vertex_count=len(vertices),
        face_count=len(faces),
        has_vertex_normals=smooth,
        has_vertex_texcoords=True,
        props=properties,
    )
    parameters = mi.traverse(result)
    parameters["vertex_positions"] = vertices.astype(np.float32).ravel()
    parameters["faces"] = faces.astype(np.uint32).ravel()
    parameters["vertex_texcoords"] = uv.astype(np.float32).ravel()
    if smooth:
        parameters["vertex_normals"] = vertex_normals(vertices, faces).astype(np.float32).ravel()
    parameters.update()
    return result


def _bsdf(material: Material) -> Any:
    import mitsuba as mi

    if material.kind == "glass":
        return mi.load_dict({"type": "dielectric", "int_ior": 1.5})
    if material.color.ndim == 3:
        color = bitmap(material.color)
    else:
        color = {"type": "rgb", "value": to_linear(material.color).tolist()}
    inner: dict[str, Any]
    if material.kind == "matte":
        inner = {"type": "diffuse", "reflectance": color}
    elif material.kind == "glossy":
        inner = {
            "type": "roughplastic",
            "distribution": "ggx",
            "alpha": material.roughness,
            "diffuse_reflectance": color,
            "nonlinear": True,
        }
    else:
        inner = {
            "type": "roughconductor",
            "material": "none",  # a perfect mirror, tinted
            "distribution": "ggx",
            "alpha": material.roughness,
            "specular_reflectance": color,
        }
    return mi.load_dict({"type": "twosided", "bsdf": inner})


def _lamp(light: Light) -> dict[str, Any]:
    import mitsuba as mi

    # Any up direction except the light's.
    way = np.abs(light.towards - light.at)
    up = np.eye(3)[int(way.argmin())]
    to_world = mi.ScalarTransform4f().look_at(
        origin=light.at.tolist(), target=light.towards.tolist(), up=up.tolist()
    ) @ mi.ScalarTransform4f().scale([*light.size, 1.0])
    return {
        "type": "rectangle",
        "to_world": to_world,
        "emitter": {
            "type": "area",
            "radiance": {"type": "rgb", "value": light.radiance.tolist()},
        },
    }


@dataclass(frozen=True, eq=False)
class LoadedScene:
    """A scene in Mitsuba."""

    scene: Any  # the whole scene
    objects: Any  # its objects only
    transparent: bool  # whether the background of photos is transparent


def load_scene(description: Description) -> LoadedScene:
    """Load a description."""
    import mitsuba as mi

    bsdfs: dict[int, Any] = {}

    def loaded(part: Part) -> Any:
        key = id(part.material)
        if key not in bsdfs:
            bsdfs[key] = _bsdf(part.material)
        return shape(part.mesh, bsdfs[key], part.smooth)

    objects = {f"object_{i}": loaded(part) for i, part in enumerate(description.objects)}
    items: dict[str, Any] = {"type": "scene", **objects}
    items.update({f"around_{i}": loaded(part) for i, part in enumerate(description.surroundings)})
    for index, light in enumerate(description.lights):
        items[f"lamp_{index}"] = _lamp(light)
    if description.sky is not None:
        items["sky"] = {
            "type": "envmap",
            "bitmap": mi.Bitmap(description.sky.astype(np.float32)),
            # Mitsuba's maps have y up.
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90.0),
        }
    return LoadedScene(
        mi.load_dict(items),
        mi.load_dict({"type": "scene", **objects}),
        description.family == "object",
    )


def sensor(viewpoint: Viewpoint, sampler: dict[str, Any]) -> Any:
    """Mitsuba's camera of a viewpoint; each pixel is the average over its square."""
    import mitsuba as mi

    # Mitsuba's camera looks along +z with x to the left.
    to_world = viewpoint.camera_to_world @ np.diag([-1.0, 1.0, -1.0, 1.0])
    return mi.load_dict(
        {
            "type": "perspective",
            "fov": math.degrees(viewpoint.field_of_view),
            "fov_axis": "x",
            "near_clip": NEAR_CLIP,
            "to_world": mi.ScalarTransform4f(to_world),
            "film": {
                "type": "hdrfilm",
                "width": viewpoint.width,
                "height": viewpoint.height,
                "pixel_format": "rgba",
                "rfilter": {"type": "box"},
            },
            "sampler": sampler,
        }
    )


def take_photo(loaded: LoadedScene, viewpoint: Viewpoint, samples: int, seed: int) -> np.ndarray:
    """Render linear premultiplied RGBA, float32 [H, W, 4].

    Open Image Denoise removes the noise of light paths, using albedo and normals: a network trained
    on these photos would learn to paint the noise.
    """
    import mitsuba as mi
    import pyoidn

    paths = {
        "type": "path",
        "max_depth": MAX_DEPTH,
        "hide_emitters": loaded.transparent,
        "block_size": BLOCK_SIZE_PX,
    }
    integrator = mi.load_dict(
        {
            "type": "aov",
            "aovs": "albedo:albedo,normal:sh_normal",
            "block_size": BLOCK_SIZE_PX,
            "paths": paths,
        }
    )
    camera = sensor(viewpoint, {"type": "multijitter", "sample_count": samples, "seed": seed})
    drawn = np.array(
        mi.render(loaded.scene, sensor=camera, integrator=integrator, spp=samples, seed=seed),
        dtype=np.float32,
    )
    rgb, alpha, albedo, normal = np.split(drawn, [3, 4, 7], axis=-1)
    finite = np.nan_to_num(rgb, nan=0.0, posinf=0.0, neginf=0.0)
    clean = pyoidn.denoise(finite, albedo=np.clip(albedo, 0.0, 1.0), normal=normal, hdr=True)
    return np.concatenate([clean, alpha], axis=-1)


def first_hits(loaded: LoadedScene, viewpoint: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    """Depth and object mask at the center of each pixel.

    Returns:
        z-depth along the camera's axis, float32 [H, W], world units, NaN for none; and whether an
        object is hit, bool [H, W].
    """
    import mitsuba as mi

    # One sample without jitter is at the pixel's center.
    camera = sensor(viewpoint, {"type": "stratified", "sample_count": 1, "jitter": False})
    integrator = mi.load_dict({"type": "depth", "block_size": BLOCK_SIZE_PX})

    def distances(scene: Any) -> np.ndarray:
        far = np.array(mi.render(scene, sensor=camera, integrator=integrator, spp=1))[..., 0]
        return np.where(far > 0.0, far, np.inf).astype(np.float64)

    far = distances(loaded.scene)
    # The same triangle has the same distance, except for rounding.
    is_object = np.isfinite(far) & (distances(loaded.objects) <= far * (1.0 + 1e-5))
    x = (np.arange(viewpoint.width) + 0.5 - 0.5 * viewpoint.width) / viewpoint.focal
    y = (np.arange(viewpoint.height) + 0.5 - 0.5 * viewpoint.height) / viewpoint.focal
    along = 1.0 / np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    depth = np.where(np.isfinite(far), NEAR_CLIP + far * along, np.nan)
    return depth.astype(np.float32), is_object


def encode(linear: np.ndarray) -> np.ndarray:
    """Convert premultiplied linear RGBA to straight 8-bit sRGB RGBA, with a black background."""
    alpha = np.clip(linear[..., 3:], 0.0, 1.0)
    color = np.clip(linear[..., :3] / np.maximum(alpha, 1e-6), 0.0, 1.0)
    pixels = np.round(255.0 * np.concatenate([to_srgb(color), alpha], axis=-1)).astype(np.uint8)
    pixels[pixels[..., 3] == 0] = 0
    return pixels


def camera_error(viewpoints: Sequence[Viewpoint], lamps: np.ndarray, radius: float) -> float:
    """Maximum distance in pixels between rendered and projected lamps.

    Args:
        viewpoints: each sees every lamp.
        lamps: [N, 3], centers of small luminous balls.
        radius: of the balls, world units.
    """
    import mitsuba as mi

    worst = 0.0
    for lamp in lamps:
        scene = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "direct"},
                "lamp": {
                    "type": "sphere",
                    "center": lamp.tolist(),
                    "radius": radius,
                    "emitter": {"type": "area", "radiance": 1.0},
                },
            }
        )
        for viewpoint in viewpoints:
            rows, columns = np.mgrid[: viewpoint.height, : viewpoint.width] + 0.5
            camera = sensor(viewpoint, {"type": "multijitter", "sample_count": 64})
            weight = np.array(mi.render(scene, sensor=camera, spp=64))[..., 3]
            seen = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
            worst = max(worst, float(np.linalg.norm(seen - viewpoint.project(lamp))))
    return worst
