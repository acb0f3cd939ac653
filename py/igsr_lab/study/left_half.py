"""The left-half protocol: find a photo's exposure on its left half, score its right half.

Photos of unknown exposure cannot be scored as they are, and a color map fitted to the scored pixels
would hide errors. NeRF in the Wild (Martin-Brualla et al. 2021) splits the photo; hierarchical
3D Gaussians (Kerbl et al. 2024) fit a 3x4 affine map, too.
"""

from __future__ import annotations

import numpy as np

from igsr.evaluation.metrics import CLIP_MARGIN, Image, Mask, psnr, ssim

#: Scores of ``left_half_scores``.
LEFT_HALF = ("lh_psnr", "lh_ssim")
#: Minimum number of pixels to fit the color map to.
MIN_PIXELS = 12


def left_half_scores(
    render: Image, photo: Image, mask: Mask | None = None
) -> dict[str, float | None]:
    """PSNR and SSIM of the right half, with the render's colors mapped by the left half.

    Args:
        render: uint8 [H, W, 3].
        photo: uint8 [H, W, 3].
        mask: bool [H, W], True for pixels that count.

    Returns:
        "lh_psnr" in dB and "lh_ssim"; None if no pixel of the right half counts. The render is not
        mapped if fewer than 12 pixels of the left half are unclipped in both pictures.
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
    if len(rows) >= MIN_PIXELS:
        affine = np.linalg.lstsq(rows, wanted[usable])[0]
        colors = np.clip(colors @ affine[:3] + affine[3], 0.0, 1.0)
    mapped = (colors[:, middle:] * 255.0 + 0.5).astype(np.uint8)
    right = None if mask is None else np.ascontiguousarray(mask[:, middle:])
    return {
        "lh_psnr": psnr(mapped, photo[:, middle:], right),
        "lh_ssim": ssim(mapped, photo[:, middle:], right),
    }
