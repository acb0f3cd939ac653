"""Pictures of captures and views for notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from igsr._internal.notebook import Picture

if TYPE_CHECKING:
    from igsr.capture import Capture, View

_MAX_PHOTOS = 5


def view_pictures(view: View) -> list[Picture]:
    """Return the photo of a view."""
    return [view.image]


def capture_pictures(capture: Capture) -> list[Picture]:
    """Return a few photos of a capture, evenly spaced."""
    count = min(_MAX_PHOTOS, len(capture.views))
    return [capture.views[k * len(capture.views) // count].image for k in range(count)]
