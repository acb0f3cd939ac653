"""Whether seams between blocks show: photos across them, by the joined scene and by the blocks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from igsr._internal.choices import Backend
from igsr.blocks.manifest import Manifest
from igsr.blocks.photo_parts import Box, cut_out
from igsr.capture import View
from igsr.capture.exposure import Exposure
from igsr.capture.photos import DescribedCapture
from igsr.evaluation.scores import score_views
from igsr.fitting.fitter import without_exposures
from igsr.splats import Splats

#: Photos that are held in memory at a time while they are scored.
AT_A_TIME = 8
#: Seams are visible where photos across them lose more than this by joining, dB in the mean.
VISIBLE = 0.2


def loaded_in_parts(
    manifest: Manifest,
    photos: Sequence[int],
    max_size: int | None,
    exposures: Mapping[str, Exposure],
    *,
    as_taken: bool = False,
) -> Iterator[list[View]]:
    """Decode photos of a capture, a few at a time.

    Args:
        manifest: the capture's photos.
        photos: their numbers in it.
        max_size: longest side in pixels of photos as loaded, or None.
        exposures: of photos, by name.
        as_taken: photos keep the exposures that are known, and views tell them; else they have the
            scene's colors.

    Raises:
        IgsrError: a photo cannot be decoded.
    """
    for first in range(0, len(photos), AT_A_TIME):
        shots = [manifest.shots[index] for index in photos[first : first + AT_A_TIME]]
        described = DescribedCapture(manifest.path, shots, lambda: None)
        views = described.loaded(max_size).views
        known = [exposures.get(view.name) for view in views]
        if as_taken:
            yield [replace(v, exposure=one) for v, one in zip(views, known, strict=True)]
        else:
            yield without_exposures(views, known)


def seam_scores(
    own: Sequence[Mapping[str, float]], by_joined: Sequence[Mapping[str, float]]
) -> dict[str, Any] | None:
    """What parts of photos across seams lose by joining; None where there are none.

    Args:
        own: of each block, the PSNR in dB of its parts of photos across seams, by its splats before
            those beyond its cell were left out, with the coarse splats around them.
        by_joined: of each block, the PSNR of the same parts by the joined scene.
    """
    alone = [psnr for scores in own for psnr in scores.values()]
    if not alone:
        return None
    joined = [found[name] for scores, found in zip(own, by_joined, strict=True) for name in scores]
    loss = float(np.mean(alone) - np.mean(joined))
    return {
        "photos": len({name for scores in own for name in scores}),
        "parts": len(alone),
        "psnr_joined": round(float(np.mean(joined)), 3),
        "psnr_alone": round(float(np.mean(alone)), 3),
        "loss_db": round(loss, 3),
        "visible": loss > VISIBLE,
    }


def psnr_of_parts(
    splats: Splats,
    loaded: Iterator[list[View]],
    boxes: Sequence[Mapping[str, Box]],
    background: Sequence[float],
    backend: Backend,
) -> list[dict[str, float]]:
    """PSNR in dB of the parts of photos that blocks have.

    Args:
        splats: the scene.
        loaded: the photos, some at a time.
        boxes: of each block, the parts by the photo's name.
        background: RGB in [0, 1] behind splats.
        backend: "cpu" or "gpu".

    Returns:
        Of each block, by name.
    """
    found: list[dict[str, float]] = [{} for _ in boxes]
    for views in loaded:
        for scores, box in zip(found, boxes, strict=True):
            parts = [cut_out(view, box[view.name]) for view in views if view.name in box]
            for one in score_views(splats, parts, background, backend, ("psnr",)):
                scores[one.name] = float(one.scores["psnr"] or 0.0)
    return found
