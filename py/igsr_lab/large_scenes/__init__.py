"""Measurements of fits in blocks and of levels of detail, on an artificial town."""
