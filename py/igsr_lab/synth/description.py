"""A synthetic scene as data: shapes with materials, lights and a sky, without the renderer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from igsr_lab.synth.meshes import Mesh


@dataclass(frozen=True, eq=False)
class Material:
    """A surface; two-sided unless it is glass."""

    #: "matte" (Lambertian), "glossy" (a rough dielectric coat over a matte base), "metal" (a rough
    #: conductor of this color) or "glass" (smooth, clear)
    kind: str
    color: np.ndarray  # sRGB in [0, 1], [3] or a repeated texture [H, W, 3]; not used for glass
    roughness: float = 0.2  # GGX alpha of glossy and metal


@dataclass(frozen=True, eq=False)
class Part:
    """A mesh with a material; ``smooth`` interpolates normals between faces."""

    mesh: Mesh
    material: Material
    smooth: bool = True


@dataclass(frozen=True, eq=False)
class Light:
    """A rectangle at a point that emits towards another; ``size`` has half extents."""

    at: np.ndarray
    towards: np.ndarray
    size: tuple[float, float]
    radiance: np.ndarray


@dataclass(eq=False)
class Description:
    """A whole scene; lengths in world units, z up."""

    family: str  # "object" (photos have a transparent background) or "surroundings"
    kind: str  # of the surroundings; "none" for the family "object"
    contents: list[str]  # names of the objects
    objects: list[Part]  # the parts that masks show
    #: Linear RGB radiance, equirectangular [H, W, 3], row 0 at the zenith, or None.
    sky: np.ndarray | None
    surroundings: list[Part] = field(default_factory=list)  # all other parts
    lights: list[Light] = field(default_factory=list)  # all lights except the sky
    #: About the point that cameras look at.
    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    radius: float = 1.0  # maximum distance of the objects from ``center``
    #: Azimuth in radians from which objects are seen best, or None for all.
    open_towards: float | None = None
    room: float = np.inf  # maximum distance of cameras from ``center``; infinite outdoors
