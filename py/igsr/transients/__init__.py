"""Transient things: what is in one photo and not in the others, such as people and cars."""

from igsr.transients.detection import PLAIN, find_transients

__all__ = ["PLAIN", "find_transients"]
