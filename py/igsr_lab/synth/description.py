"""A procedural scene as data: shapes with materials, lights and a sky, nothing of the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from igsr_lab.synth.meshes import Mesh


@dataclass(frozen=True, eq=False)
class Material:
    """What a surface is made of; two-sided unless it is glass.

    Attributes:
        kind: "matte" (Lambertian), "glossy" (a rough dielectric coat over a matte base), "metal"
            (a rough conductor of this colour) or "glass" (smooth, clear).
        colour: sRGB in [0, 1], [3] or a texture [H, W, 3], repeated; of no meaning for glass.
        roughness: GGX alpha of glossy and metal.
    """

    kind: str
    colour: np.ndarray
    roughness: float = 0.2


@dataclass(frozen=True, eq=False)
class Part:
    """One mesh with its material.

    Attributes:
        mesh: in world units (or those of the object it is a part of).
        material: what it is made of.
        smooth: whether normals are interpolated between faces.
    """

    mesh: Mesh
    material: Material
    smooth: bool = True


@dataclass(frozen=True, eq=False)
class Light:
    """A rectangle that shines to one side.

    Attributes:
        at: its center.
        towards: the point that it faces.
        size: half extents.
        radiance: linear RGB, [3].
    """

    at: np.ndarray
    towards: np.ndarray
    size: tuple[float, float]
    radiance: np.ndarray


@dataclass(eq=False)
class Description:
    """A whole scene; lengths in world units, z up.

    Attributes:
        family: "object" (photos are transparent where nothing is hit) or "surroundings".
        kind: what the surroundings are, "none" for the family "object".
        contents: the names of the objects in it.
        objects: the parts that masks show.
        surroundings: all other parts.
        lights: beside the sky.
        sky: linear RGB radiance, equirectangular [H, W, 3], row 0 at the zenith, or None for none.
        center: the point that cameras look at, about.
        radius: how far the objects reach from ``center``.
        open_towards: the azimuth in radians from which objects are seen best, or None where they
            can be seen from all around.
        room: how far from ``center`` cameras may stand; infinite outdoors.
    """

    family: str
    kind: str
    contents: list[str]
    objects: list[Part]
    sky: np.ndarray | None
    surroundings: list[Part] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = 1.0
    open_towards: float | None = None
    room: float = np.inf
