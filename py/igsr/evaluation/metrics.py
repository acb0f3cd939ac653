"""Metrics of a render against its photo: PSNR, SSIM, MS-SSIM, FLIP, color-corrected PSNR and SSIM.

All functions take two sRGB pictures, uint8 [H, W, 3], and an optional mask, bool [H, W], True for
pixels that count. Masked pixels are set to black in both pictures first, so that windows over the
mask's edge are equal there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]
Planes = npt.NDArray[np.float64]

#: The Gaussian window of SSIM (Wang et al. 2004), as the 3DGS papers use it.
SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
#: Rows per strip of SSIM, so that the strip's planes stay in the cache.
SSIM_ROWS = 16
#: Shortest side for MS-SSIM: its window must fit after four halvings (Wang et al. 2003).
MS_SSIM_MIN_SIDE = SSIM_WINDOW * 2**4
#: Exponents of the five scales, full size first.
MS_SSIM_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
#: PSNR of equal pictures, dB: infinity has no mean and is not valid JSON.
PSNR_CAP = 100.0
#: Iterations of the color correction.
CORRECTIONS = 5
#: Channels within this distance of 0 or 1 are clipped.
CLIP_MARGIN = 0.5 / 255.0
#: Pixels per matrix product: few enough for BLAS to use one thread, which is faster.
PRODUCT_PIXELS = 1 << 12
#: Names of the metrics, in the order of tables.
METRICS = ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr", "cc_ssim")


def _checked(render: Image, photo: Image, mask: Mask | None) -> tuple[Image, Image, Mask | None]:
    for name, picture in (("render", render), ("photo", photo)):
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            raise ValueError(
                f"{name} must be uint8 [H, W, 3], not {picture.dtype} {list(picture.shape)}"
            )
    if render.shape != photo.shape:
        raise ValueError(
            f"render {list(render.shape)} and photo {list(photo.shape)} differ in size"
        )
    if mask is None:
        return render, photo, None
    if mask.dtype != np.bool_ or mask.shape != photo.shape[:2]:
        raise ValueError(
            f"mask must be bool {list(photo.shape[:2])}, not {mask.dtype} {list(mask.shape)}"
        )
    if not mask.any():
        raise ValueError("mask has no pixel that counts")
    return render * mask[..., None], photo * mask[..., None], mask


def psnr(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Compute the peak signal-to-noise ratio in dB over all channels; 100 for equal pictures."""
    render, photo, mask = _checked(render, photo, mask)
    difference = (render.astype(np.float64) - photo) / 255.0
    squared = difference**2
    error = float(squared.mean() if mask is None else squared[mask].mean())
    return PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * math.log10(error))


def ssim(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Compute the structural similarity (Wang et al. 2004) as the 3DGS papers do.

    11 x 11 Gaussian window with sigma 1.5, per channel on [0, 1], C1 = 0.01^2, C2 = 0.03^2, zero
    padding.
    """
    render, photo, mask = _checked(render, photo, mask)
    pad = SSIM_WINDOW // 2
    x, y = (np.pad(_planes(z), ((0, 0), (pad, pad), (pad, pad))) for z in (render, photo))
    per_pixel = np.empty(photo.shape[:2])
    for rows, light, lights, shared, spread in _windowed(x, y):
        per_pixel[rows] = ((light * shared) / (lights * spread)).mean(axis=0)
    return float(per_pixel.mean() if mask is None else per_pixel[mask].mean())


def _planes(picture: Image) -> Planes:
    """uint8 [H, W, 3] as float64 [3, H, W] in [0, 1]."""
    return np.asarray(np.ascontiguousarray(picture.transpose(2, 0, 1)) / 255.0)


def _windowed(x: Planes, y: Planes) -> Iterator[tuple[slice, Planes, Planes, Planes, Planes]]:
    """Compute the terms of SSIM of ``x``, ``y`` [C, H + 10, W + 10], in strips of rows.

    Yields a slice of the H rows; numerator and denominator of the luminance term, then of the
    contrast and structure term, float64 [C, rows, W] each.
    """
    offset = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(offset**2) / (2.0 * SSIM_SIGMA**2))
    window /= window.sum()
    margin = SSIM_WINDOW - 1
    height, width = x.shape[1] - margin, x.shape[2] - margin

    def blur(z: Planes) -> Planes:
        columns = np.zeros((len(z), z.shape[1] - margin, width + margin))
        for k, weight in enumerate(window):
            columns += weight * z[:, k : k + columns.shape[1]]
        blurred = np.zeros((*columns.shape[:2], width))
        for k, weight in enumerate(window):
            blurred += weight * columns[:, :, k : k + width]
        return blurred

    c1, c2 = 0.01**2, 0.03**2
    for top in range(0, height, SSIM_ROWS):
        bottom = min(height, top + SSIM_ROWS)
        here_x, here_y = x[:, top : bottom + margin], y[:, top : bottom + margin]
        mean_x, mean_y = blur(here_x), blur(here_y)
        variance_x = blur(here_x * here_x) - mean_x**2
        variance_y = blur(here_y * here_y) - mean_y**2
        covariance = blur(here_x * here_y) - mean_x * mean_y
        yield (
            slice(top, bottom),
            2 * mean_x * mean_y + c1,
            mean_x**2 + mean_y**2 + c1,
            2 * covariance + c2,
            variance_x + variance_y + c2,
        )


def ms_ssim(render: Image, photo: Image, mask: Mask | None = None) -> float | None:
    """Compute the multi-scale SSIM (Wang et al. 2003) as torchmetrics does.

    Five scales, 11 x 11 Gaussian window with sigma 1.5, negative terms set to 0. There is no map
    per pixel, so masked pixels count as equal. None if the shorter side is less than 176 pixels.
    """
    render, photo, _ = _checked(render, photo, mask)
    if min(photo.shape[:2]) < MS_SSIM_MIN_SIDE:
        return None
    x, y = _planes(render), _planes(photo)
    product = 1.0
    for scale, exponent in enumerate(MS_SSIM_EXPONENTS):
        # Contrast and structure without padding; at the last scale SSIM, with mirrored borders.
        is_last = scale == len(MS_SSIM_EXPONENTS) - 1
        if is_last:
            pad = SSIM_WINDOW // 2
            x, y = (np.pad(z, ((0, 0), (pad, pad), (pad, pad)), mode="reflect") for z in (x, y))
        total, count = 0.0, 0
        for _, light, lights, shared, spread in _windowed(x, y):
            terms = (light * shared) / (lights * spread) if is_last else shared / spread
            total += float(terms.sum())
            count += terms.size
        # Negative numbers have no fractional power.
        product *= max(0.0, total / count) ** exponent
        x, y = _halved(x), _halved(y)
    return product


def _halved(planes: Planes) -> Planes:
    """Means of 2 x 2 pixels; an odd last row or column is dropped."""
    channels, height, width = planes.shape
    even = planes[:, : height // 2 * 2, : width // 2 * 2]
    return np.asarray(even.reshape(channels, height // 2, 2, width // 2, 2).mean(axis=(2, 4)))


def flip(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Compute the mean LDR-FLIP error (Andersson et al. 2020): 0 for equal pictures, at worst 1.

    flip-evaluator's defaults: 67 pixels per degree (0.7 m from a 0.7 m wide 4K monitor).
    """
    render, photo, mask = _checked(render, photo, mask)
    errors, mean = flip_errors(render, photo)
    return mean if mask is None else float(errors[mask].mean())


def flip_errors(render: Image, photo: Image) -> tuple[npt.NDArray[np.float32], float]:
    """Compute the LDR-FLIP error of each pixel, float32 [H, W], and their mean."""
    import flip_evaluator

    errors, mean, _ = flip_evaluator.evaluate(
        photo.astype(np.float32) / 255.0,
        render.astype(np.float32) / 255.0,
        "LDR",
        inputsRGB=True,
        applyMagma=False,
        computeMeanError=True,
    )
    return np.asarray(errors, np.float32).reshape(*photo.shape[:2], -1)[..., 0], float(mean)


def color_corrected(render: Image, photo: Image, mask: Mask | None = None) -> Image:
    """Map the render's colors to the photo's by a quadratic polynomial of R, G and B.

    This removes differences of exposure, white balance and tone. Each channel is fitted by least
    squares to pixels that count and are not clipped in either picture, five times, each time on the
    previous result; channels with too few such pixels do not change. The method is
    ``color_correct`` of Mip-NeRF 360 (Barron et al. 2022, multinerf ``internal/image.py``) and of
    gsplat's cc_psnr, but rounds to 8 bits.
    """
    render, photo, mask = _checked(render, photo, mask)
    target, colors = (_planes(picture).reshape(3, -1) for picture in (photo, render))
    unclipped = ~(_clipped(target) | _clipped(colors))
    if mask is not None:
        unclipped &= mask.reshape(-1)
    starts = range(0, colors.shape[1], PRODUCT_PIXELS)
    parts = [slice(start, start + PRODUCT_PIXELS) for start in starts]
    for _ in range(CORRECTIONS):
        squares, products = np.zeros((3, 10, 10)), np.zeros((3, 10))
        usable = unclipped & ~_clipped(colors)
        for part in parts:
            features = _quadratic(colors[:, part])
            for channel in range(3):
                kept = features * usable[channel, part]
                squares[channel] += kept @ features.T
                products[channel] += kept @ target[channel, part]
        weights = np.zeros((3, 10))
        for channel in range(3):
            if usable[channel].sum() < 10:
                weights[channel, 6 + channel] = 1.0
            else:
                weights[channel] = np.linalg.lstsq(squares[channel], products[channel])[0]
        colors = np.concatenate(
            [np.clip(weights @ _quadratic(colors[:, part]), 0.0, 1.0) for part in parts], axis=1
        )
    return np.ascontiguousarray((colors.T * 255.0 + 0.5).astype(np.uint8)).reshape(render.shape)


def _clipped(colors: Planes) -> Mask:
    return np.asarray((colors < CLIP_MARGIN) | (colors > 1.0 - CLIP_MARGIN))


def _quadratic(colors: Planes) -> Planes:
    """Monomials of colors [3, P] up to degree 2, float64 [10, P]."""
    red, green, blue = colors
    products = (red * red, red * green, red * blue, green * green, green * blue, blue * blue)
    return np.stack([*products, red, green, blue, np.ones_like(red)])


def score(
    render: Image, photo: Image, mask: Mask | None = None, names: Sequence[str] = METRICS
) -> dict[str, float | None]:
    """Compute the metrics ``names`` of one picture; "ms_ssim" is None for small pictures.

    "cc_psnr" and "cc_ssim" are of the render after ``color_corrected``.
    """
    metrics = {"psnr": psnr, "ssim": ssim, "ms_ssim": ms_ssim, "flip": flip}
    scores = {name: metrics[name](render, photo, mask) for name in metrics if name in names}
    corrected_names = [name for name in ("psnr", "ssim") if f"cc_{name}" in names]
    if corrected_names:
        corrected = color_corrected(render, photo, mask)
        for name in corrected_names:
            scores[f"cc_{name}"] = metrics[name](corrected, photo, mask)
    return scores
