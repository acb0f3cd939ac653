"""Named settings of a fit: the default, by what the photos can support, and two baselines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

from igsr._internal.settings import checked_given
from igsr.errors import IgsrError
from igsr.fitting.settings import FitSettings

Preset: TypeAlias = Literal["default", "3dgs", "instantsplat"]
PRESETS: tuple[Preset, ...] = get_args(Preset)

#: With so few photos or fewer, most novel views are barely constrained: fits overfit without help.
FEW_PHOTOS = 20
#: Steps per photo after which fits to few photos gain no more, and later lose.
STEPS_PER_PHOTO = 500
#: Steps of the paper's fits to photos whose cameras have noise.
PAPER_STEPS = 5000

_MANY = FitSettings(
    steps=5000,
    max_splats=30_000,
    sh_degree=2,
    density="original",
    dropout=0.0,
    hull=False,
    start="auto",
    poses="fixed",
    focal="fixed",
)
_FEW = replace(_MANY, steps=4000, sh_degree=1, density="mcmc", dropout=0.3)
#: As Kerbl et al. 2023 fit synthetic scenes, at their shorter number of steps, but for our number
#: of splats. From few photos it only overfits more with the steps, so there it has the default's.
_3DGS = replace(_MANY, steps=7000, sh_degree=3, start="random")
_3DGS_FEW = replace(_3DGS, steps=_MANY.steps)
#: As InstantSplat (Fan et al. 2024) fits: many splats from dense points, which stay as many, with
#: cameras and one focal length optimized. Here the points are the capture's or made from its
#: photos, and all have one learning rate.
_INSTANTSPLAT = replace(
    _MANY,
    steps=1000,
    max_splats=60_000,
    sh_degree=1,
    density="fixed",
    poses="joint",
    focal="shared",
)
#: What a preset says nothing of.
_NOT_OF_PRESETS = ("seed", "background")


def settings_for(preset: str, photos: int, **given: Any) -> FitSettings:
    """The settings of a fit: those given, and the preset's where none or None is given.

    Args:
        preset: "default" (measured to be best: one set for up to ``FEW_PHOTOS`` photos, another for
            more), or a baseline: "3dgs" (3D Gaussian Splatting without help for few photos) or
            "instantsplat" (dense initialization, fixed number of splats, joint poses, shared focal
            length).
        photos: number of photos to fit.
        **given: fields of ``FitSettings``.

    Raises:
        IgsrError: there is no such preset or setting, or a setting cannot be used.
    """
    if preset not in PRESETS:
        raise IgsrError(f"preset must be one of {', '.join(PRESETS)}, not {preset!r}.")
    is_few = photos <= FEW_PHOTOS
    few = replace(_FEW, steps=min(_FEW.steps, STEPS_PER_PHOTO * max(1, photos)))
    base = {
        "default": few if is_few else _MANY,
        "3dgs": _3DGS_FEW if is_few else _3DGS,
        "instantsplat": _INSTANTSPLAT,
    }[preset]
    return replace(base, **checked_given(FitSettings, given))


def preset_settings(name: str, photos: int, **given: Any) -> dict[str, Any]:
    """As ``settings_for``, but as keywords of ``igsr.fit``, without seed and background.

    Raises:
        IgsrError: as ``settings_for``.
    """
    return preset_keywords(settings_for(name, photos, **given))


def preset_keywords(settings: FitSettings) -> dict[str, Any]:
    """Those settings that presets have, as keywords of ``igsr.fit``."""
    values = settings.plain()
    return {name: value for name, value in values.items() if name not in _NOT_OF_PRESETS}
