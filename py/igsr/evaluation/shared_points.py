"""Points that photos share: counts and pictures, to check found cameras by eye."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from igsr.capture import View
from igsr.capture.types import Tracks

#: Number of other photos that a report names for each photo.
NAMED_PHOTOS = 3
#: Maximum number of pictures of pairs, and of lines in one.
MAX_PAIRS = 6
MAX_LINES = 60
#: Bounds the memory of counting.
POINTS_AT_ONCE = 8192
#: Longer side of each photo in a picture, pixels.
SIDE_PX = 360


def shared_counts(tracks: Tracks) -> npt.NDArray[np.int64]:
    """Count the points that each two photos show, int64 [P, P]; the diagonal is a photo's own."""
    count = len(tracks.names)
    shared = np.zeros((count, count), dtype=np.int64)
    order = np.argsort(tracks.point, kind="stable")
    view, point = tracks.view[order], tracks.point[order]
    for first in range(0, int(point[-1]) + 1 if len(point) else 0, POINTS_AT_ONCE):
        part = slice(*np.searchsorted(point, (first, first + POINTS_AT_ONCE)))
        shows = np.zeros((POINTS_AT_ONCE, count), dtype=np.float32)
        shows[point[part] - first, view[part]] = 1.0
        shared += (shows.T @ shows).astype(np.int64)
    return shared


def placed_by(tracks: Tracks) -> dict[str, dict[str, Any]]:
    """By photo, the number of its points and those it shares with the photos nearest to it.

    Returns:
        "points" and "shared" (number by the name of another photo, most first) of each name.
    """
    shared = shared_counts(tracks)
    rows = {}
    for index, name in enumerate(tracks.names):
        others = [i for i in np.argsort(-shared[index], kind="stable") if i != index]
        rows[name] = {
            "points": int(shared[index, index]),
            "shared": {tracks.names[i]: int(shared[index, i]) for i in others[:NAMED_PHOTOS]},
        }
    return rows


def pair_pictures(
    tracks: Tracks, photos: Sequence[View]
) -> list[tuple[str, npt.NDArray[np.uint8]]]:
    """Draw pairs of photos side by side, with lines between the points that both show.

    Each photo is paired with the photo that shares the largest number of points with it. Pairs with
    the fewest points come first, since they are the most doubtful.

    Args:
        tracks: in pixels of the views.
        photos: the photos to draw.

    Returns:
        At most ``MAX_PAIRS`` captions and pictures, uint8 [H, W, 3].
    """
    shared = shared_counts(tracks)
    np.fill_diagonal(shared, 0)
    strongest = {tuple(sorted((i, int(row.argmax())))) for i, row in enumerate(shared) if row.any()}
    views = {view.name: view for view in photos}
    drawn: list[tuple[str, npt.NDArray[np.uint8]]] = []
    for a, b in sorted(strongest, key=lambda pair: (shared[pair], pair)):
        names = tracks.names[a], tracks.names[b]
        if len(drawn) < MAX_PAIRS and all(name in views for name in names):
            caption = f"{names[0]} and {names[1]}: {shared[a, b]} points"
            drawn.append((caption, _pair_picture(tracks, (a, b), [views[name] for name in names])))
    return drawn


def _pair_picture(tracks: Tracks, pair: tuple[int, int], views: list[View]) -> Any:
    photos = []
    for view in views:
        photo = Image.fromarray(view.image[..., :3])
        photo.thumbnail((SIDE_PX, SIDE_PX), Image.Resampling.BOX)
        photos.append(photo)
    first, second = photos
    size = (first.width + second.width, max(first.height, second.height))
    sheet = Image.new("RGB", size)
    sheet.paste(first, (0, 0))
    sheet.paste(second, (first.width, 0))
    observed: list[dict[int, npt.NDArray[np.float64]]] = []
    for index, view, photo in zip(pair, views, photos, strict=True):
        rows = np.flatnonzero(tracks.view == index)
        xy = tracks.xy[rows] * (photo.width / view.camera.width)
        observed.append(dict(zip(tracks.point[rows].tolist(), xy, strict=True)))
    points = sorted(observed[0].keys() & observed[1].keys(), key=lambda p: tuple(observed[0][p]))
    chosen = np.linspace(0, len(points) - 1, min(len(points), MAX_LINES)).round().astype(np.int64)
    draw = ImageDraw.Draw(sheet)
    for index in chosen:
        (x0, y0), (x1, y1) = observed[0][points[index]], observed[1][points[index]]
        color = f"hsl({360.0 * index / len(points):.0f}, 90%, 60%)"
        draw.line((x0, y0, x1 + first.width, y1), fill=color)
        for x, y in ((x0, y0), (x1 + first.width, y1)):
            draw.ellipse((x - 2, y - 2, x + 2, y + 2), outline=color)
    return np.asarray(sheet)
