"""Tracks of made-up captures: exact image positions of known points."""

from __future__ import annotations

import numpy as np

from igsr.capture import Points
from igsr.capture.types import Tracks


def projected(camera, xyz):
    """[P, 2] pixels, by the camera matrix."""
    homogeneous = (xyz @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]) @ camera.K.T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def tracked(views, xyz, noise=0.0, miss=0.0, seed=0):
    """Points that each view sees, to ``noise`` pixels, but for a part of ``miss`` at random."""
    random = np.random.default_rng(seed)
    view, point, xy = [], [], []
    for k, one in enumerate(views):
        seen = np.flatnonzero(random.uniform(size=len(xyz)) >= miss)
        places = projected(one.camera, xyz[seen])
        view.append(np.full(len(seen), k))
        point.append(seen)
        xy.append(places + noise * random.normal(size=places.shape))
    tracks = Tracks([one.name for one in views], *map(np.concatenate, (view, point, xy)))
    gray = np.full((len(xyz), 3), 128, np.uint8)
    return Points(xyz, gray, tracks=tracks)
