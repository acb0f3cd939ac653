"""Measurements of pose networks combined with features, by a network with known errors."""
