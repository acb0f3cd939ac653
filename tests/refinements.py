"""Refinements of a small made-up scene by known denoisers."""

from __future__ import annotations

import numpy as np
import scenes

import igsr
from igsr.rendering.renders import render

BALL = scenes.splats(60)
WHITE = (1.0, 1.0, 1.0)
#: Steps of each fit. With so few, and few photos, rounds by a truthful denoiser help for any seed.
STEPS = 300


def capture(views):
    """Photos of a ball with alpha, from all sides; every fourth is a test view."""
    return scenes.capture(views=views, size=40, alpha=True, scene=BALL)


def truthful(buffers, photos):
    """A denoiser that returns the true picture."""
    color = render(BALL, buffers.camera, WHITE, backend="cpu").color
    return np.clip(color, 0.0, 1.0), np.full(color.shape[:2], 0.95, np.float32)


def lying(buffers, photos):
    """A denoiser that inverts the render, with full confidence."""
    return 1.0 - np.clip(buffers.color, 0.0, 1.0), np.full(buffers.color.shape[:2], 1.0, np.float32)


def contented(buffers, photos):
    """A denoiser that changes nothing, with full confidence."""
    return np.clip(buffers.color, 0.0, 1.0), np.full(buffers.color.shape[:2], 1.0, np.float32)


def unsure(buffers, photos):
    """A denoiser that returns the true picture with almost no confidence."""
    picture, confidence = truthful(buffers, photos)
    return picture, np.full_like(confidence, 0.05)


def refine(capture, rounds, denoiser, **options):
    """``igsr.refine`` on the CPU, with ``STEPS`` steps and seed 0 unless given."""
    given = {"steps": STEPS, "backend": "cpu", **options}
    return igsr.refine(capture, rounds, denoiser=denoiser, **given)


def same(one, other):
    """Whether two scenes have the same bits."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for name in ("means", "quats", "scales", "opacities", "sh")
    )
