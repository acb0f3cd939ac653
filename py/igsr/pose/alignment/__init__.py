"""Pointmaps of pairs of photos brought into one world."""
