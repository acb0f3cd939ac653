"""Protocols of the literature as commands: fixed views, seeds and scores, so that runs compare."""

from .blender import blender8

__all__ = ["blender8"]
