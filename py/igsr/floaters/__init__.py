"""Floaters: splats that no photo shows, that stand before what photos show, or that stand alone."""

from igsr.floaters.removal import Cleaned, remove_floaters

__all__ = ["Cleaned", "remove_floaters"]
