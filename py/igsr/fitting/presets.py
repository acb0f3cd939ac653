"""Named sets of fit settings: the default, by what the photos can support, and a baseline."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from igsr.errors import IgsrError

#: So many photos or fewer leave most of a scene's views unseen: fits to them over-fit without help.
FEW_PHOTOS = 20
#: Steps per photo after which fits to few photos gain no more, and later drift.
STEPS_PER_PHOTO = 500


@dataclass(frozen=True)
class Preset:
    """Settings of ``igsr.fit`` where the caller names none; see there."""

    steps: int
    max_splats: int
    sh_degree: int
    density: str
    dropout: float
    hull: bool
    start: str
    poses: str = "fixed"
    focal: str = "fixed"


_MANY = Preset(
    steps=5000,
    max_splats=30_000,
    sh_degree=2,
    density="original",
    dropout=0.0,
    hull=False,
    start="auto",
)
_FEW = replace(_MANY, steps=4000, sh_degree=1, density="mcmc", dropout=0.3)
#: As Kerbl et al. 2023 fit synthetic scenes, at their shorter number of steps, but for our number
#: of splats. From few photos it only over-fits more with the steps, so there it has the default's.
_3DGS = replace(_MANY, steps=7000, sh_degree=3, start="random")
_3DGS_FEW = replace(_3DGS, steps=_MANY.steps)
#: As InstantSplat (Fan et al. 2024) fits: many splats from dense points, which stay as many, with
#: cameras and one focal length fitted. Here the points are made up or the capture's, and all have
#: one rate.
_INSTANTSPLAT = replace(
    _MANY,
    steps=1000,
    max_splats=60_000,
    sh_degree=1,
    density="fixed",
    poses="joint",
    focal="shared",
)

PRESETS = ("default", "3dgs", "instantsplat")


def preset_settings(name: str, photos: int, **given: object) -> dict[str, Any]:
    """The settings of ``Preset`` by name: those given, and the preset's where None is given.

    Args:
        name: "default" (measured to be best: one set for up to ``FEW_PHOTOS`` photos, another for
            more), or a baseline: "3dgs" (3D Gaussian Splatting without help for few photos) or
            "instantsplat" (dense start, fixed number, joint poses, shared focal length).
        photos: number of photos to fit.
        **given: what a caller asked for.

    Raises:
        IgsrError: there is no such preset.
    """
    if name not in PRESETS:
        raise IgsrError(f"preset must be one of {', '.join(PRESETS)}, not {name!r}.")
    few = replace(_FEW, steps=min(_FEW.steps, STEPS_PER_PHOTO * max(1, photos)))
    is_few = photos <= FEW_PHOTOS
    presets = {
        "default": few if is_few else _MANY,
        "3dgs": _3DGS_FEW if is_few else _3DGS,
        "instantsplat": _INSTANTSPLAT,
    }
    preset = presets[name]
    return vars(preset) | {key: value for key, value in given.items() if value is not None}


#: Steps of the paper's fits to photos whose cameras have noise.
PAPER_STEPS = 5000
