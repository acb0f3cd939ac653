"""Reduce photos and views with an area filter, and scale their tracks.

A pixel of the smaller photo is the mean of the area that it covers, including parts of pixels. The
field of view stays the same: focal lengths and principal point scale by the ratio of the two sizes
per axis, exactly, since pixel centers are at +0.5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from igsr.capture.types import Camera, Points, PseudoView, View
from igsr.errors import IgsrError

Float64 = npt.NDArray[np.float64]

#: Numbers that are held at a time; limits the rows that are reduced at once.
_BAND_NUMBERS = 1 << 20


def check_max_size(max_size: int | None) -> None:
    """Raise an IgsrError unless an option is None or a whole number of at least 1."""
    if max_size is None:
        return
    is_whole = isinstance(max_size, (int, np.integer)) and not isinstance(max_size, bool)
    if not is_whole or max_size < 1:
        raise IgsrError(
            f"max_size is {max_size!r}; give the longest side in pixels, at least 1, such as 1600"
        )


def reduced_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """Return width and height of a photo whose longest side is reduced to ``max_size`` pixels.

    Photos are not enlarged; None keeps the size.
    """
    longest = max(width, height)
    if max_size is None or longest <= max_size:
        return width, height
    # Rounds halves up, in integers, so that no rounding of a quotient matters.
    shorter = max(1, (2 * min(width, height) * int(max_size) + longest) // (2 * longest))
    return (int(max_size), shorter) if width >= height else (shorter, int(max_size))


def resized_camera(camera: Camera, width: int, height: int) -> Camera:
    """Return the pinhole camera of the same photo at another size in pixels."""
    if (width, height) == (camera.width, camera.height):
        return camera
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return replace(camera, K=K, width=width, height=height)


class PixelRows(Protocol):
    """Pixels [H, W, C] that are read by rows: an array, or a photo that is converted on demand."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    def __getitem__(self, rows: slice, /) -> np.ndarray: ...


def area_means(
    pixels: PixelRows,
    width: int,
    height: int,
    mask: np.ndarray | None = None,
    box: tuple[float, float] | None = None,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_] | None]:
    """Reduce a photo by an area filter.

    Colors are weighted by alpha and mask, if there are any: transparent and masked pixels lend no
    color. Alpha is weighted by the mask.

    Args:
        pixels: uint8 [H, W, 3] RGB, or [H, W, 4] with straight alpha.
        width, height: the smaller size in pixels, at most the larger.
        mask: bool [H, W], True for pixels that count, or None if all do.
        box: width and height, in pixels, of the upper left part of ``pixels`` that is the photo;
            None is all.

    Returns:
        The photo, uint8 [height, width, 3 or 4], and its mask, None without ``mask``: a pixel of it
        is False if no pixel under it counts.
    """
    alpha = pixels.shape[2] == 4

    def planes(rows: slice) -> np.ndarray:
        """The weighted colors, and their weights."""
        band = pixels[rows]
        if mask is None and not alpha:
            return band
        used = np.ones((*band.shape[:2], 1)) if mask is None else mask[rows, :, None] * 1.0
        if not alpha:
            return np.concatenate([band * used, used], axis=2)
        opacity = band[..., 3:] * used
        return np.concatenate([band[..., :3] * opacity, opacity, used], axis=2)

    covered = (pixels.shape[1], pixels.shape[0]) if box is None else box
    sums = _area_sums(planes, pixels.shape[:2], (height, width), covered)
    if mask is None and not alpha:
        return _rounded(sums / _area(covered, width, height)), None
    # A weight is 0 only if the color has no meaning.
    colors = sums[..., :3] / np.maximum(sums[..., 3:4], 1e-9)
    if alpha:
        colors = np.concatenate([colors, sums[..., 3:4] / np.maximum(sums[..., 4:], 1e-9)], axis=2)
    return _rounded(colors), None if mask is None else sums[..., -1] > 1e-9


def plane_area_means(plane: np.ndarray, width: int, height: int) -> Float64:
    """Reduce one number per pixel, [H, W], by an area filter; see ``area_means``."""
    covered = plane.shape[1], plane.shape[0]
    sums = _area_sums(lambda rows: plane[rows, :, None], plane.shape, (height, width), covered)
    return sums[..., 0] / _area(covered, width, height)


def reduced_view(view: View, width: int, height: int) -> View:
    """Return a view reduced to a size in pixels, with its camera, mask, weights and depth.

    A pixel is masked if all under it were. Weights are averaged. Depth is that of the pixel in the
    middle: a mean over an edge is on no surface.
    """
    if (width, height) == (view.camera.width, view.camera.height):
        return view
    image, mask = area_means(view.image, width, height, view.mask)
    weights: dict[str, Any] = {}
    if isinstance(view, PseudoView):
        weights["weights"] = plane_area_means(view.weights, width, height).astype(np.float32)
    depth, confidence = (
        None if plane is None else resampled_plane(plane, width, height)
        for plane in (view.depth, view.depth_confidence)
    )
    return replace(
        view,
        camera=resized_camera(view.camera, width, height),
        image=image,
        mask=mask,
        depth=depth,
        depth_confidence=confidence,
        **weights,
    )


def resampled_plane(plane: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return one number per pixel [H, W] at another size [height, width], larger or smaller.

    Each is taken from the pixel that contains its center, without interpolation.
    """
    if plane.shape == (height, width):
        return plane
    rows, columns = (
        ((np.arange(count) + 0.5) * size / count).astype(np.int64)
        for count, size in ((height, plane.shape[0]), (width, plane.shape[1]))
    )
    return np.ascontiguousarray(plane[np.ix_(rows, columns)])


def halved(view: View) -> View:
    """Average each 2 x 2 pixels of a view into one; an odd last row or column is dropped.

    See ``reduced_view``; focal lengths and principal point are halved.
    """
    width, height = view.camera.width // 2, view.camera.height // 2
    planes = ("image", "mask", "weights", "depth", "depth_confidence")
    cropped = {
        name: plane[: 2 * height, : 2 * width]
        for name in planes
        if (plane := getattr(view, name, None)) is not None
    }
    camera = replace(view.camera, width=2 * width, height=2 * height)
    return reduced_view(replace(view, camera=camera, **cropped), width, height)


def resized_tracks(
    points: Points | None, before: Mapping[str, Camera], after: Mapping[str, Camera]
) -> Points | None:
    """Return points with tracks in pixels of resized photos.

    Only the sizes of the cameras before and after, by name, count. Photos that are not in both keep
    their pixels.
    """
    if points is None or points.tracks is None:
        return points
    tracks = points.tracks
    scale = np.ones((len(tracks.names), 2))
    for index, name in enumerate(tracks.names):
        if name in before and name in after:
            old, new = before[name], after[name]
            scale[index] = new.width / old.width, new.height / old.height
    if (scale == 1.0).all():
        return points
    return replace(points, tracks=replace(tracks, xy=tracks.xy * scale[tracks.view]))


def _rounded(values: Float64) -> npt.NDArray[np.uint8]:
    return np.floor(values + 0.5).astype(np.uint8)


def _area(covered: tuple[float, float], width: int, height: int) -> float:
    """The number of pixels that a pixel of the smaller photo covers."""
    return covered[0] / width * (covered[1] / height)


def _bounds(covered: float, count: int) -> tuple[npt.NDArray[np.int64], Float64]:
    """Bounds of ``count`` equal parts of ``covered`` pixels: whole pixels, and their rest."""
    ends = np.arange(count + 1) * covered / count
    whole = ends.astype(np.int64)
    return whole, ends - whole


def _area_sums(
    planes: Callable[[slice], np.ndarray],
    shape: tuple[int, ...],
    size: tuple[int, int],
    covered: tuple[float, float],
) -> Float64:
    """Sum planes over the areas that the smaller pixels cover, float64 [h, w, C].

    Whole numbers are summed exactly if areas consist of whole pixels. ``planes`` returns rows of
    the planes, [rows, W, C]; ``shape`` is H, W and ``size`` h, w; ``covered`` is the width and
    height of the part that the smaller pixels cover.
    """
    (full_height, full_width), (height, width) = shape[:2], size
    rows, row_parts = _bounds(covered[1], height)
    columns, column_parts = _bounds(covered[0], width)
    at_once = max(1, _BAND_NUMBERS * height // (full_height * full_width * 4))
    parts = []
    for top in range(0, height, at_once):
        bottom = min(top + at_once, height)
        first = int(rows[top])
        band = planes(slice(first, int(rows[bottom]) + 1))
        summed = np.empty((bottom - top, *band.shape[1:]))
        for row in range(top, bottom):
            start, end = int(rows[row]) - first, int(rows[row + 1]) - first
            out = summed[row - top]
            np.sum(band[start:end], axis=0, dtype=np.float64, out=out)
            if row_parts[row + 1]:
                out += row_parts[row + 1] * band[end]
            if row_parts[row]:
                out -= row_parts[row] * band[start]
        sums = np.add.reduceat(summed[:, : columns[-1]], columns[:-1], axis=1)
        if column_parts.any():
            # The first part of the pixel in which one area ends and the next begins.
            edge = summed[:, np.minimum(columns, full_width - 1)] * column_parts[:, None]
            sums += np.diff(edge, axis=1)
        parts.append(sums)
    return np.concatenate(parts)
