"""Named settings of a fit: the default, by what the photos tell, and two baselines."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, TypeAlias, get_args

from igsr._internal.settings import checked_given
from igsr.errors import IgsrError
from igsr.fitting.photo_support import PhotoSupport
from igsr.fitting.settings import FitSettings

Preset: TypeAlias = Literal["default", "3dgs", "instantsplat"]
PRESETS: tuple[Preset, ...] = get_args(Preset)
Quality: TypeAlias = Literal["draft", "normal", "high"]
#: What qualities multiply the sides of photos, the steps and the most splats by.
QUALITIES: dict[Quality, tuple[float, float, float]] = {
    "draft": (0.6, 0.4, 0.4),
    "normal": (1.0, 1.0, 1.0),
    "high": (1.6, 2.0, 2.5),
}

#: Fits to few photos overfit without help: dropout is this over the number of photos that see the
#: same place, at most ``MOST_DROPOUT``, and none where that is less than ``LEAST_DROPOUT``.
DROPOUT_PHOTOS = 1.2
MOST_DROPOUT, LEAST_DROPOUT = 0.3, 0.05
#: Photos further apart than this (degrees, in the mean) leave so much open that splats are only
#: added where opaque ones are, with a pull to small and faint ones (MCMC). Nearer ones show where
#: splats are missing. The pull is on all splats in each step, so most fade where less than this
#: part of the photos show the same place: a large scene, a walk through rooms.
WIDE_APART, SHOWN_BY = 7.0, 0.5
#: From so many photos of the same place on, view-dependent color is more than a way to overfit.
SH2_PHOTOS = 12.0
#: Steps of any fit, and more for each photo, up to a most; but for few photos only so many each.
STEPS, STEPS_MORE, MOST_STEPS = 1500, 25, 2500
STEPS_PER_PHOTO = 250
#: 3DGS's learning rates are for this many steps. With ``n`` times fewer, rates ``sqrt(n)`` times as
#: large reach more than theirs do; above ``MOST_LEARNING_RATE`` splats overshoot.
RATE_STEPS = 30_000
MOST_LEARNING_RATE = 3.0
#: Where cameras are optimized, fits have 3DGS's learning rates and so many times the steps: splats
#: that move fast fit wrong cameras, and cameras move once in a round of the photos.
JOINT_STEPS = 2
#: Most splats per pixel of one photo, times this power of the photos over ``FEW``: more photos show
#: more of a scene, but not as many times more. With more splats, few photos are only overfitted.
SPLATS_PER_PIXEL = 0.11
FEW, SPLATS_POWER = 8.0, 0.4
MOST_SPLATS = 1_000_000
#: Small photos may have this many, or so many per pixel, times the same power where they are more
#: than ``FEW``: they cost little there.
SMALL_SPLATS, SMALL_SPLATS_PER_PIXEL = 45_000, 0.3
#: Photos of much detail have a splat for each of their squares of one tone, times the same power,
#: at most so many per pixel: what is finer is noise.
DETAIL_PER_PIXEL = 0.5
#: What depths of photos count at first, where there are any. Their relative difference is compared
#: with differences of colors in 0..1.
DEPTH_WEIGHT = 1.0
#: Steps of the paper's fits to photos whose cameras have noise.
PAPER_STEPS = 5000

#: Most splats of 3DGS, which has no such limit: as many as 8 GB of memory hold.
UNLIMITED_SPLATS = 4_000_000

#: Longest side of photos that fits have where none is asked for, pixels: what two cores do in
#: minutes, and what other tools have on GPUs (nerfstudio: 1600).
MAX_SIZES = {"cpu": 1000, "gpu": 1600}

_DEFAULT = FitSettings(
    steps=MOST_STEPS,
    max_splats=30_000,
    sh_degree=2,
    density="original",
    learning_rate=1.0,
    dropout=0.0,
    start="auto",
    coarse_to_fine=True,
    depth_weight=DEPTH_WEIGHT,
    poses="fixed",
    focal="fixed",
    # Gains of photos are found well, but held-out photos of sceaux and museum gain in SSIM alone.
    exposure="off",
    transients="auto",
    remove_floaters=True,
    backdrop=True,
)
#: As Kerbl et al. 2023 fit, at their shorter number of steps: SfM points where there are some, and
#: as many splats as their density control adds.
_3DGS = replace(
    _DEFAULT,
    steps=7000,
    max_splats=UNLIMITED_SPLATS,
    sh_degree=3,
    start="sfm",
    coarse_to_fine=False,
    depth_weight=0.0,
    transients="off",
    remove_floaters=False,
    backdrop=False,
)
#: As InstantSplat (Fan et al. 2024) fits: many splats from dense points, which stay as many, with
#: cameras and one focal length optimized. Here the points are the capture's or made from its
#: photos, and all have one learning rate.
_INSTANTSPLAT = replace(
    _DEFAULT,
    steps=1000,
    max_splats=60_000,
    sh_degree=1,
    density="fixed",
    coarse_to_fine=False,
    depth_weight=0.0,
    poses="joint",
    focal="shared",
    transients="off",
    remove_floaters=False,
    backdrop=False,
)
#: What a preset says nothing of.
_NOT_OF_PRESETS = ("seed", "background")


def default_max_size(backend: str, quality: Quality = "normal") -> int:
    """Longest side in pixels of the photos that a backend fits where nothing else is asked for.

    By the backend alone, so that the same command gives the same result on every machine.

    Args:
        backend: "cpu" or "gpu".
        quality: "draft", "normal" or "high".

    Raises:
        IgsrError: there is no such quality.
    """
    return round(MAX_SIZES[backend] * _quality(quality)[0])


def _quality(quality: Quality) -> tuple[float, float, float]:
    if quality not in QUALITIES:
        raise IgsrError(f"quality must be one of {', '.join(QUALITIES)}, not {quality!r}.")
    return QUALITIES[quality]


def settings_for(
    preset: str, photos: PhotoSupport | int, quality: Quality = "normal", **given: Any
) -> FitSettings:
    """The settings of a fit: those given, and the preset's where none or None is given.

    Args:
        preset: "default" (measured to be best; how many photos see the same place, from how far
            apart, and their size decide), or a baseline: "3dgs" (3D Gaussian Splatting without help
            for few photos) or "instantsplat" (dense initialization, fixed number of splats, joint
            poses, shared focal length).
        photos: what the photos to fit tell, or their number, for small ones all round an object.
        quality: "draft", "normal" or "high": fewer or more steps and splats. Only the default
            preset has qualities.
        **given: fields of ``FitSettings``.

    Raises:
        IgsrError: there is no such preset, quality or setting, or a setting cannot be used.
    """
    if preset not in PRESETS:
        raise IgsrError(f"preset must be one of {', '.join(PRESETS)}, not {preset!r}.")
    support = photos if isinstance(photos, PhotoSupport) else PhotoSupport.of_number(photos)
    given = checked_given(FitSettings, given)
    joint = replace(_DEFAULT, **given).moves_cameras
    default = _default(support, quality, given.get("steps"), joint)
    base = {"default": default, "3dgs": _3DGS, "instantsplat": _INSTANTSPLAT}[preset]
    return replace(base, **given)


def _default(
    support: PhotoSupport, quality: Quality, steps: int | None, joint: bool
) -> FitSettings:
    """The default for these photos: one rule from few of them to many.

    Args:
        support: what the photos tell.
        quality: "draft", "normal" or "high".
        steps: those asked for, if any are.
        joint: whether cameras are optimized, too.
    """
    dropout = min(MOST_DROPOUT, DROPOUT_PHOTOS / support.seen_by)
    _, more_steps, more_splats = _quality(quality)
    if steps is None:
        photos = support.photos
        usual = min(MOST_STEPS, STEPS + STEPS_MORE * photos, STEPS_PER_PHOTO * photos)
        steps = round(more_steps * usual * (JOINT_STEPS if joint else 1))
    rate = 1.0 if joint else min(MOST_LEARNING_RATE, max(1.0, math.sqrt(RATE_STEPS / steps)))
    wide = support.apart > WIDE_APART
    more = (support.photos / FEW) ** SPLATS_POWER
    splats = max(
        SPLATS_PER_PIXEL * support.pixels * more,
        min(SMALL_SPLATS, SMALL_SPLATS_PER_PIXEL * support.pixels * max(1.0, more)),
        min(support.detail * more, DETAIL_PER_PIXEL * support.pixels),
    )
    return replace(
        _DEFAULT,
        steps=steps,
        learning_rate=round(rate, 2),
        max_splats=max(1000, min(MOST_SPLATS, round(more_splats * splats))),
        sh_degree=2 if support.seen_by >= SH2_PHOTOS else 1,
        density="mcmc" if wide and support.shown >= SHOWN_BY else "original",
        dropout=round(dropout, 2) if dropout >= LEAST_DROPOUT else 0.0,
    )


def preset_settings(
    name: str, photos: PhotoSupport | int, quality: Quality = "normal", **given: Any
) -> dict[str, Any]:
    """As ``settings_for``, but as keywords of ``igsr.fit``, without seed and background.

    Raises:
        IgsrError: as ``settings_for``.
    """
    return preset_keywords(settings_for(name, photos, quality, **given))


def preset_keywords(settings: FitSettings) -> dict[str, Any]:
    """Those settings that presets have, as keywords of ``igsr.fit``."""
    values = settings.plain()
    return {name: value for name, value in values.items() if name not in _NOT_OF_PRESETS}
