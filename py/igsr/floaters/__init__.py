"""Floaters: splats that no photo shows, that masks hide, before the surface, or alone."""

from igsr.floaters.removal import Cleaned, remove_floaters

__all__ = ["Cleaned", "remove_floaters"]
