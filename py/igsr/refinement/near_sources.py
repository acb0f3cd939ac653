"""The photos near novel views, as the denoiser looks them up: a bounded number in memory."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

from igsr._internal.choices import Backend
from igsr.capture import Camera, View
from igsr.denoiser import Source, photo_sources
from igsr.splats import Splats

#: Photos that a novel view is denoised with, at most: those whose cameras are nearest. The denoiser
#: looks up fewer.
NEAR = 24
#: Photos held at a time: novel views that follow each other share most of theirs.
HELD = 32


class NearSources:
    """Sources of photos near a camera, made when they are first asked for."""

    def __init__(
        self,
        splats: Splats,
        photos: Sequence[View],
        background: Sequence[float],
        backend: Backend,
    ) -> None:
        """Keep what is given; nothing is rendered yet.

        Args:
            splats: the scene fitted to the photos.
            photos: the photos with their cameras.
            background: RGB in [0, 1] behind photos with alpha.
            backend: "auto", "cpu", "gpu" or "reference".
        """
        self._splats, self._photos = splats, photos
        self._background, self._backend = background, backend
        self._centers = np.stack([photo.camera.center for photo in photos])
        self._held: OrderedDict[int, Source] = OrderedDict()

    def of(self, camera: Camera) -> list[Source]:
        """The sources of at most ``NEAR`` photos, in the order of the photos."""
        distances = np.linalg.norm(self._centers - camera.center, axis=1)
        near = sorted(int(k) for k in np.argsort(distances, kind="stable")[:NEAR])
        return [self._source(k) for k in near]

    def _source(self, k: int) -> Source:
        if k not in self._held:
            one = photo_sources(self._splats, [self._photos[k]], self._background, self._backend)
            self._held[k] = one[0]
            if len(self._held) > HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(k)
        return self._held[k]
