"""Transient objects: in one photo and in no other, such as people and cars."""

from igsr.transients.detection import EVIDENT_FRACTION, find_transients

__all__ = ["EVIDENT_FRACTION", "find_transients"]
