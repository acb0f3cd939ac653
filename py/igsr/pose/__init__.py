"""Cameras of photos that have none."""
