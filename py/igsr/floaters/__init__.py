"""Removal of floaters: splats that no photo supports."""

from igsr.floaters.removal import Cleaned, remove_floaters

__all__ = ["Cleaned", "remove_floaters"]
