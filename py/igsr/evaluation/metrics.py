"""Metrics of a render and its photo: PSNR, SSIM, MS-SSIM, FLIP; the first two color-corrected, too.

Every function takes two uint8 pictures [H, W, 3], sRGB-encoded: the 8-bit picture is scored, not
the renderer's floats. ``mask`` (bool [H, W], True for pixels that count) limits the score to a
part of the picture. Both pictures are set to black outside it first, so that windows over its edge
see the same in both.
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
#: Rows that SSIM is computed for at a time.
SSIM_ROWS = 16
#: The five scales of MS-SSIM (Wang et al. 2003) halve the picture four times, and the window must
#: still fit into the smallest.
MS_SSIM_MIN_SIDE = SSIM_WINDOW * 2**4
#: Exponents of the scales, from full size on.
MS_SSIM_EXPONENTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
#: PSNR of identical 8-bit pictures is infinite, which JSON cannot hold and a mean cannot use.
PSNR_CAP = 100.0
#: Color correction: repetitions, and how far from 0 and 1 a channel counts as not clipped.
CORRECTIONS, CLIPPED = 5, 0.5 / 255.0
#: Pixels whose features are held at a time: so few that BLAS takes one thread for them. Waking
#: others takes longer than the product.
PART = 1 << 12
#: What ``score`` gives.
NAMES = ("psnr", "ssim", "ms_ssim", "flip", "cc_psnr", "cc_ssim")


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
    outside = ~mask
    render, photo = render.copy(), photo.copy()
    render[outside] = 0
    photo[outside] = 0
    return render, photo, mask


def psnr(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Peak signal-to-noise ratio in dB, -10 log10 of the mean squared error on [0, 1].

    The mean runs over the three channels and the pixels that count. Equal pictures give 100 dB.
    """
    render, photo, mask = _checked(render, photo, mask)
    difference = (render.astype(np.float64) - photo) / 255.0
    squared = difference**2
    error = float(squared.mean() if mask is None else squared[mask].mean())
    return PSNR_CAP if error == 0.0 else min(PSNR_CAP, -10.0 * math.log10(error))


def ssim(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Structural similarity (Wang et al. 2004) in the convention of the 3DGS papers.

    11 x 11 Gaussian window with sigma 1.5, per channel on [0, 1], C1 = 0.01^2, C2 = 0.03^2, the
    border padded with zeros, the map averaged over channels and the pixels that count.
    """
    render, photo, mask = _checked(render, photo, mask)
    height, width = photo.shape[:2]
    pad = SSIM_WINDOW // 2

    def padded(picture: Image) -> Planes:
        return np.pad(_planes(picture), ((0, 0), (pad, pad), (pad, pad)))

    per_pixel = np.empty((height, width))
    for rows, light, lights, shared, spread in _windowed(padded(render), padded(photo)):
        per_pixel[rows] = ((light * shared) / (lights * spread)).mean(axis=0)
    return float(per_pixel.mean() if mask is None else per_pixel[mask].mean())


def _planes(picture: Image) -> Planes:
    """uint8 [H, W, 3] as float64 [3, H, W] in [0, 1]."""
    return np.asarray(np.ascontiguousarray(picture.transpose(2, 0, 1)) / 255.0)


def _windowed(x: Planes, y: Planes) -> Iterator[tuple[slice, Planes, Planes, Planes, Planes]]:
    """The terms of SSIM at each place that the whole window fits at, in strips of rows.

    Strips whose planes stay in the cache take a third of the time.

    Args:
        x, y: float64 [C, H + 10, W + 10] in [0, 1].

    Yields:
        The strip of the H rows, and numerator and denominator of luminance, then of contrast and
        structure, float64 [C, strip, W] each.
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
    """Multi-scale SSIM (Wang et al. 2003) in the convention of torchmetrics, on [0, 1].

    Five scales, 11 x 11 Gaussian window with sigma 1.5, negative terms as 0. It has no per-pixel
    map, so a mask only blackens both pictures outside; the black part counts as equal.

    Returns:
        The score, or None where the shorter side is under 176 pixels: the smallest scale would
        no longer hold the window.
    """
    render, photo, _ = _checked(render, photo, mask)
    if min(photo.shape[:2]) < MS_SSIM_MIN_SIDE:
        return None
    x, y = _planes(render), _planes(photo)
    product = 1.0
    for scale, exponent in enumerate(MS_SSIM_EXPONENTS):
        # Contrast where the whole window is inside; at the last scale SSIM, with mirrored borders.
        is_last = scale == len(MS_SSIM_EXPONENTS) - 1
        if is_last:
            pad = SSIM_WINDOW // 2
            x, y = (np.pad(z, ((0, 0), (pad, pad), (pad, pad)), mode="reflect") for z in (x, y))
        total, count = 0.0, 0
        for _, light, lights, shared, spread in _windowed(x, y):
            terms = (light * shared) / (lights * spread) if is_last else shared / spread
            total += float(terms.sum())
            count += terms.size
        # Far-off renders reach negative terms, which have no fractional power.
        product *= max(0.0, total / count) ** exponent
        x, y = _halved(x), _halved(y)
    return product


def _halved(planes: Planes) -> Planes:
    """Means of 2 x 2 pixels; an odd last row or column is left out."""
    channels, height, width = planes.shape
    even = planes[:, : height // 2 * 2, : width // 2 * 2]
    return np.asarray(even.reshape(channels, height // 2, 2, width // 2, 2).mean(axis=(2, 4)))


def flip_map(render: Image, photo: Image, mask: Mask | None = None) -> npt.NDArray[np.float32]:
    """LDR-FLIP error of each pixel (Andersson et al. 2020), float32 [H, W], 0 = equal, 1 = worst.

    flip-evaluator's defaults: sRGB pictures seen at 67 pixels per degree (0.7 m from a 0.7 m
    wide 4K monitor). With a mask, both pictures are black outside.
    """
    import flip_evaluator

    render, photo, _ = _checked(render, photo, mask)
    error_map, _, _ = flip_evaluator.evaluate(
        photo.astype(np.float32) / 255.0,
        render.astype(np.float32) / 255.0,
        "LDR",
        inputsRGB=True,
        applyMagma=False,
        computeMeanError=False,
    )
    return np.asarray(error_map, np.float32).reshape(photo.shape[0], photo.shape[1], -1)[..., 0]


def flip(render: Image, photo: Image, mask: Mask | None = None) -> float:
    """Mean LDR-FLIP error (Andersson et al. 2020), 0 = equal, 1 = worst.

    flip-evaluator's defaults: sRGB pictures seen at 67 pixels per degree (0.7 m from a 0.7 m
    wide 4K monitor). With a mask, the mean of the error map over the pixels that count.
    """
    import flip_evaluator

    render, photo, mask = _checked(render, photo, mask)
    error_map, mean, _ = flip_evaluator.evaluate(
        photo.astype(np.float32) / 255.0,
        render.astype(np.float32) / 255.0,
        "LDR",
        inputsRGB=True,
        applyMagma=False,
        computeMeanError=True,
    )
    if mask is None:
        return float(mean)
    return float(np.asarray(error_map).reshape(photo.shape[0], photo.shape[1], -1)[mask].mean())


def color_corrected(render: Image, photo: Image, mask: Mask | None = None) -> Image:
    """The render with the photo's colors: mapped by a quadratic polynomial of R, G and B.

    Each channel is fitted to the photo's by least squares over pixels that are clipped in neither
    picture, five times, each on the result of the last. What is left are errors that no exposure,
    white balance or tone curve explains. As ``color_correct`` of Mip-NeRF 360's code (Barron et al.
    2022, multinerf ``internal/image.py``) and of gsplat, whose cc_psnr is of such pictures, but
    rounded to 8 bits.

    Args:
        render: uint8 [H, W, 3].
        photo: uint8 [H, W, 3].
        mask: bool [H, W], True for pixels to fit the map to; all are mapped.

    Returns:
        uint8 [H, W, 3]. A channel with too few pixels to fit a map to stays as it is.
    """
    render, photo, mask = _checked(render, photo, mask)
    wanted, start = (_planes(picture).reshape(3, -1) for picture in (photo, render))
    open_in_both = ~(_clipped(wanted) | _clipped(start))
    if mask is not None:
        open_in_both &= mask.reshape(-1)
    colors = start
    parts = [slice(at, at + PART) for at in range(0, colors.shape[1], PART)]
    for _ in range(CORRECTIONS):
        squares, products = np.zeros((3, 10, 10)), np.zeros((3, 10))
        usable = open_in_both & ~_clipped(colors)
        for part in parts:
            features = _quadratic(colors[:, part])
            for channel in range(3):
                kept = features * usable[channel, part]
                squares[channel] += kept @ features.T
                products[channel] += kept @ wanted[channel, part]
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
    return np.asarray((colors < CLIPPED) | (colors > 1.0 - CLIPPED))


def _quadratic(colors: Planes) -> Planes:
    """Products of two channels, the channels, and 1, of colors [3, P]: float64 [10, P]."""
    red, green, blue = colors
    products = (red * red, red * green, red * blue, green * green, green * blue, blue * blue)
    return np.stack([*products, red, green, blue, np.ones_like(red)])


def score(
    render: Image, photo: Image, mask: Mask | None = None, names: Sequence[str] = NAMES
) -> dict[str, float | None]:
    """Metrics of one picture.

    ``psnr``, ``ssim``, ``ms_ssim`` (or None) and ``flip`` of the render as it is; ``cc_psnr`` and
    ``cc_ssim`` of the render after ``color_corrected``.

    Args:
        render, photo, mask: as each metric takes them.
        names: those wanted; others are not computed.
    """
    metrics = {"psnr": psnr, "ssim": ssim, "ms_ssim": ms_ssim, "flip": flip}
    found = {name: metric(render, photo, mask) for name, metric in metrics.items() if name in names}
    if any(name.startswith("cc_") for name in names):
        corrected = color_corrected(render, photo, mask)
        found |= {
            f"cc_{name}": metrics[name](corrected, photo, mask)
            for name in ("psnr", "ssim")
            if f"cc_{name}" in names
        }
    return found
