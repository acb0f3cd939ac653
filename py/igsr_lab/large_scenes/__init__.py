"""Measurements of fits in blocks and of levels of detail, on a made-up town."""
