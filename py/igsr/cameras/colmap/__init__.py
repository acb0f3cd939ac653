"""Cameras by incremental structure from motion, through pycolmap: SIFT features, matches, mapping.

Nothing is downloaded. Photos with too few matches are not registered.
"""

from igsr.cameras.colmap.estimator import Colmap

__all__ = ["Colmap"]
