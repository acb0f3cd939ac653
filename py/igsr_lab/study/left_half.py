"""The left-half protocol: a photo's exposure is found on its left half, and scored on its right.

Photos whose exposure is not known cannot be scored as they are, and a color map that is fitted to
the scored pixels explains away errors, too. NeRF in the Wild (Martin-Brualla et al. 2021) divides
the photo; the map is the 3x4 affine one of hierarchical 3D Gaussians (Kerbl et al. 2024).
"""

from __future__ import annotations

import numpy as np

from igsr.evaluation.metrics import CLIP_MARGIN, Image, Mask, psnr, ssim

#: What ``left_half_scores`` gives.
LEFT_HALF = ("lh_psnr", "lh_ssim")
#: Fewest pixels that a map of four numbers for each channel is fitted to.
FEWEST = 12


def left_half_scores(
    render: Image, photo: Image, mask: Mask | None = None
) -> dict[str, float | None]:
    """PSNR and SSIM of the right half, the render mapped to the photo's colors by the left half.

    Args:
        render: uint8 [H, W, 3].
        photo: uint8 [H, W, 3].
        mask: bool [H, W], True for pixels that count.

    Returns:
        "lh_psnr" in dB and "lh_ssim"; None where the right half has no pixel that counts. Where the
        left half has fewer than 12 pixels that are clipped in neither picture, the render stays as
        it is.
    """
    middle = photo.shape[1] // 2
    counts = np.ones(photo.shape[:2], np.bool_) if mask is None else mask
    if not counts[:, middle:].any():
        return dict.fromkeys(LEFT_HALF)
    colors, wanted = render / 255.0, photo / 255.0
    usable = counts.copy()
    usable[:, middle:] = False
    for picture in (colors, wanted):
        usable &= ((picture >= CLIP_MARGIN) & (picture <= 1.0 - CLIP_MARGIN)).all(axis=2)
    rows = np.column_stack([colors[usable], np.ones(usable.sum())])
    if len(rows) >= FEWEST:
        affine = np.linalg.lstsq(rows, wanted[usable])[0]
        colors = np.clip(colors @ affine[:3] + affine[3], 0.0, 1.0)
    mapped = (colors[:, middle:] * 255.0 + 0.5).astype(np.uint8)
    right = None if mask is None else np.ascontiguousarray(mask[:, middle:])
    return {
        "lh_psnr": psnr(mapped, photo[:, middle:], right),
        "lh_ssim": ssim(mapped, photo[:, middle:], right),
    }
