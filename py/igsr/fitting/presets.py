"""Default settings of a fit, chosen from the photos and the quality that is asked for."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal, TypeAlias

from igsr._internal.settings import checked_given
from igsr.errors import IgsrError
from igsr.fitting.photo_statistics import PhotoStatistics
from igsr.fitting.settings import FitSettings

Quality: TypeAlias = Literal["draft", "normal", "high"]
#: Factors on the sides of photos, the number of steps and the maximum number of splats.
QUALITIES: dict[Quality, tuple[float, float, float]] = {
    "draft": (0.6, 0.4, 0.4),
    "normal": (1.0, 1.0, 1.0),
    "high": (1.6, 2.0, 2.5),
}

#: Dropout is this divided by the number of photos that see the same place, clipped to the maximum;
#: below the minimum there is none. Without it, fits to few photos overfit.
DROPOUT_PHOTOS = 1.2
MAX_DROPOUT = 0.3
MIN_DROPOUT = 0.05
#: MCMC density control is used if photos are further apart than this (mean, degrees) and at least
#: this fraction of them show the same place. Its pull on opacities acts in every step. In large
#: scenes few photos show a place, and most splats would fade.
MCMC_SPACING_DEG = 7.0
MCMC_VISIBLE_FRACTION = 0.5
#: Minimum number of photos of the same place for SH degree 2; with fewer it overfits.
SH2_PHOTOS = 12.0
#: "original" takes MAX_STEPS. With "mcmc" or joint cameras, which overfit few photos, n photos have
#: min(MAX_STEPS, BASE_STEPS + MORE_STEPS_PER_PHOTO n, STEPS_PER_PHOTO n).
BASE_STEPS = 1500
MORE_STEPS_PER_PHOTO = 25
STEPS_PER_PHOTO = 250
MAX_STEPS = 2500
#: 3DGS's learning rates are for this many steps. With ``n`` times fewer, rates are multiplied by
#: ``sqrt(n)``, up to the maximum, above which splats overshoot.
RATE_STEPS = 30_000
MAX_LEARNING_RATE = 3.0
#: Factor on the steps if cameras are optimized. Learning rates are then 3DGS's: splats that move
#: fast fit wrong cameras.
JOINT_STEPS_FACTOR = 2
#: Maximum splats per pixel of one photo, times (photos / REFERENCE_PHOTOS) ** SPLATS_POWER. With
#: more splats, few photos are overfitted; with "mcmc" also at quality "high".
SPLATS_PER_PIXEL = 0.11
REFERENCE_PHOTOS = 8.0
SPLATS_POWER = 0.4
MAX_SPLATS = 1_000_000
#: Small photos may have this many splats, or this many per pixel.
SMALL_SPLATS = 45_000
SMALL_SPLATS_PER_PIXEL = 0.3
#: Detailed photos have a splat per square of one tone, up to this many per pixel; finer detail is
#: noise.
DETAIL_PER_PIXEL = 0.5
#: Initial weight of the relative depth error beside color errors in 0..1.
DEPTH_WEIGHT = 1.0
#: Longest side of photos by default, pixels: minutes on two cores; nerfstudio's size on GPUs.
MAX_SIZES = {"cpu": 1000, "gpu": 1600}

_DEFAULT = FitSettings(
    steps=MAX_STEPS,
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
    # Exposures are found well, but held-out photos gain in SSIM only (docs/research/own-photos.md).
    exposure="off",
    transients="auto",
    remove_floaters=True,
    backdrop=True,
)
#: Settings that do not depend on the photos.
_NOT_CHOSEN = ("seed", "background")


def default_max_size(backend: str, quality: Quality = "normal") -> int:
    """Return the default longest side of photos in pixels.

    It depends on the backend only, so a command gives the same result on every machine.

    Args:
        backend: "cpu" or "gpu".
        quality: "draft", "normal" or "high".

    Raises:
        IgsrError: the quality is unknown.
    """
    return round(MAX_SIZES[backend] * _quality(quality)[0])


def _quality(quality: Quality) -> tuple[float, float, float]:
    if quality not in QUALITIES:
        raise IgsrError(f"quality must be one of {', '.join(QUALITIES)}, not {quality!r}.")
    return QUALITIES[quality]


def settings_for(
    photos: PhotoStatistics | int, quality: Quality = "normal", **given: Any
) -> FitSettings:
    """Choose the settings of a fit; those given (not None) stay as they are.

    Args:
        photos: statistics of the photos, or their number, for small ones all round an object.
        quality: "draft", "normal" or "high": fewer or more steps and splats.
        **given: fields of ``FitSettings``.

    Raises:
        IgsrError: a setting or the quality is unknown or invalid.
    """
    if isinstance(photos, int):
        photos = PhotoStatistics.of_number(photos)
    given = checked_given(FitSettings, given)
    joint = replace(_DEFAULT, **given).moves_cameras
    return replace(_default(photos, quality, given.get("steps"), joint), **given)


def _default(
    statistics: PhotoStatistics, quality: Quality, steps: int | None, joint: bool
) -> FitSettings:
    """The default settings for these photos; ``steps`` and ``joint`` are as asked for."""
    dropout = min(MAX_DROPOUT, DROPOUT_PHOTOS / statistics.overlap)
    is_mcmc = (
        statistics.spacing_deg > MCMC_SPACING_DEG
        and statistics.visible_fraction >= MCMC_VISIBLE_FRACTION
    )
    _, more_steps, more_splats = _quality(quality)
    if is_mcmc:
        more_splats = min(1.0, more_splats)
    if steps is None:
        usual = MAX_STEPS
        if is_mcmc or joint:
            photos = statistics.photos
            usual = min(usual, BASE_STEPS + MORE_STEPS_PER_PHOTO * photos, STEPS_PER_PHOTO * photos)
        steps = round(more_steps * usual * (JOINT_STEPS_FACTOR if joint else 1))
    rate = 1.0 if joint else min(MAX_LEARNING_RATE, max(1.0, math.sqrt(RATE_STEPS / steps)))
    more = (statistics.photos / REFERENCE_PHOTOS) ** SPLATS_POWER
    splats = max(
        SPLATS_PER_PIXEL * statistics.pixels * more,
        min(SMALL_SPLATS, SMALL_SPLATS_PER_PIXEL * statistics.pixels * max(1.0, more)),
        min(statistics.detail * more, DETAIL_PER_PIXEL * statistics.pixels),
    )
    return replace(
        _DEFAULT,
        steps=steps,
        learning_rate=round(rate, 2),
        max_splats=max(1000, min(MAX_SPLATS, round(more_splats * splats))),
        sh_degree=2 if statistics.overlap >= SH2_PHOTOS else 1,
        density="mcmc" if is_mcmc else "original",
        dropout=round(dropout, 2) if dropout >= MIN_DROPOUT else 0.0,
    )


def chosen_keywords(settings: FitSettings) -> dict[str, Any]:
    """The settings that depend on the photos, as keywords of ``igsr.fit``."""
    values = settings.plain()
    return {name: value for name, value in values.items() if name not in _NOT_CHOSEN}
