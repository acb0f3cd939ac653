"""Settings that studies compare: igsr's default and two baselines.

"3dgs" is the recipe of Kerbl et al. 2023 with 7 000 steps; "instantsplat" the recipe of Fan et al.
2024: many splats from dense points, whose number stays fixed, with cameras and one focal length
optimized. Its points are the capture's, or are made from its photos.
"""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, get_args

from igsr.capture import Capture
from igsr.errors import IgsrError
from igsr.fitting.photo_statistics import PhotoStatistics
from igsr.fitting.presets import Quality, chosen_keywords, settings_for

Preset: TypeAlias = Literal["default", "3dgs", "instantsplat"]
PRESETS: tuple[Preset, ...] = get_args(Preset)

#: Steps of the paper's fits to photos whose cameras have noise.
PAPER_STEPS = 5000
#: 3DGS has no maximum number of splats; this number fits in 8 GB of memory.
_UNLIMITED_SPLATS = 4_000_000
#: 3DGS starts from SfM points if there are at least this many, else from random ones.
_MIN_POINTS = 100

_WITHOUT_EXTRAS: dict[str, Any] = {
    "learning_rate": 1.0,
    "dropout": 0.0,
    "coarse_to_fine": False,
    "depth_weight": 0.0,
    "transients": "off",
    "remove_floaters": False,
    "backdrop": False,
}
_KEYWORDS: dict[str, dict[str, Any]] = {
    "default": {},
    "3dgs": {
        **_WITHOUT_EXTRAS,
        "steps": 7000,
        "max_splats": _UNLIMITED_SPLATS,
        "sh_degree": 3,
        "density": "original",
        "poses": "fixed",
        "focal": "fixed",
    },
    "instantsplat": {
        **_WITHOUT_EXTRAS,
        "steps": 1000,
        "max_splats": 60_000,
        "sh_degree": 1,
        "density": "fixed",
        "poses": "joint",
        "focal": "shared",
    },
}


def preset_keywords(name: str, capture: Capture | None = None) -> dict[str, Any]:
    """The keywords of ``igsr.fit`` for a preset; ``capture`` decides how "3dgs" starts.

    Raises:
        IgsrError: the preset is unknown.
    """
    if name not in PRESETS:
        raise IgsrError(f"preset must be one of {', '.join(PRESETS)}, not {name!r}.")
    keywords = dict(_KEYWORDS[name])
    if name == "3dgs":
        points = 0 if capture is None or capture.points is None else len(capture.points.xyz)
        keywords["start"] = "points" if points >= _MIN_POINTS else "random"
    return keywords


def preset_settings(
    name: str, photos: PhotoStatistics | int, quality: Quality = "normal", **given: Any
) -> dict[str, Any]:
    """All settings of a preset that depend on the photos, as keywords of ``igsr.fit``.

    Args:
        name: one of ``PRESETS``.
        photos, quality: as ``igsr.fitting.presets.settings_for``.
        **given: settings that replace the preset's, unless None.

    Raises:
        IgsrError: the preset or a setting is unknown or invalid.
    """
    chosen = {key: value for key, value in given.items() if value is not None}
    return chosen_keywords(settings_for(photos, quality, **{**preset_keywords(name), **chosen}))
