"""Photos near a novel view as inputs of the denoiser, with a bounded number in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Camera, View
from igsr.denoiser import Source, photo_sources
from igsr.splats import Splats

#: Maximum number of photos for a novel view, the nearest ones. The denoiser uses fewer.
NEAR = 24
#: Photos kept in memory; successive novel views share them.
CACHED = 32


class NearSources:
    """Sources of the photos near a camera, made on first use."""

    def __init__(
        self,
        splats: Splats,
        photos: Sequence[View],
        background: Sequence[float],
        backend: Backend,
    ) -> None:
        """Keep the arguments; nothing is rendered yet.

        Args:
            splats: the scene fitted to the photos.
            photos: the photos with their cameras.
            background: RGB in [0, 1] behind photos with alpha.
            backend: "auto", "cpu", "gpu" or "reference".
        """
        self._splats, self._photos = splats, photos
        self._background, self._backend = background, backend
        self._centers = np.stack([photo.camera.center for photo in photos])
        self._cached: OrderedDict[int, Source] = OrderedDict()

    def of(self, camera: Camera) -> list[Source]:
        """The sources of at most ``NEAR`` photos, in the order of the photos."""
        distances = np.linalg.norm(self._centers - camera.center, axis=1)
        near = sorted(int(k) for k in np.argsort(distances, kind="stable")[:NEAR])
        return [self._source(k) for k in near]

    def _source(self, k: int) -> Source:
        if k not in self._cached:
            one = photo_sources(self._splats, [self._photos[k]], self._background, self._backend)
            self._cached[k] = one[0]
            if len(self._cached) > CACHED:
                self._cached.popitem(last=False)
        self._cached.move_to_end(k)
        return self._cached[k]
