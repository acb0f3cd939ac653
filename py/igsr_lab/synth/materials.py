"""Random materials that match one palette."""

from __future__ import annotations

import numpy as np

from igsr_lab.synth.description import Material
from igsr_lab.synth.textures import TEXTURES, palette

#: Rows and columns of a texture.
TEXTURE_SIZE = 256


class Materials:
    """Draws the materials of one object or room from one palette.

    Args:
        rng: draws everything.
        vividness: probability that the palette is saturated.
    """

    def __init__(self, rng: np.random.Generator, vividness: float = 0.35) -> None:
        self.rng = rng
        self.colors = palette(rng, vividness)
        self.shininess = rng.beta(1.5, 2.0)

    def color(self) -> np.ndarray:
        """One color of the palette, sRGB [3]."""
        return np.asarray(self.colors[self.rng.integers(len(self.colors))])

    def texture(self, *names: str) -> np.ndarray:
        """A texture of one of these kinds, or of any kind."""
        name = str(self.rng.choice(names or tuple(TEXTURES)))
        return TEXTURES[name](self.rng, self.colors, TEXTURE_SIZE)

    def coated(self, color: np.ndarray) -> Material:
        """A matte or glossy surface with a color or texture."""
        if self.rng.random() < self.shininess:
            return Material("glossy", color, float(self.rng.uniform(0.05, 0.4)))
        return Material("matte", color)

    def plain(self) -> Material:
        """A single color."""
        return self.coated(self.color())

    def textured(self, *names: str) -> Material:
        """A texture of one of these kinds, or of any kind."""
        return self.coated(self.texture(*names))

    def metal(self) -> Material:
        """Polished to brushed metal: steel, brass, copper or tinted."""
        tints = np.array([[0.85, 0.85, 0.86], [0.93, 0.8, 0.5], [0.93, 0.67, 0.55]])
        tint = tints[self.rng.integers(3)] if self.rng.random() < 0.7 else 0.5 + 0.5 * self.color()
        return Material("metal", tint, float(self.rng.uniform(0.12, 0.45)))

    def any(self) -> Material:
        """Usually textured, sometimes plain or metal, rarely glass."""
        draw = self.rng.random()
        if draw < 0.02:
            return Material("glass", np.ones(3))
        if draw < 0.02 + 0.2 * self.shininess:
            return self.metal()
        return self.plain() if draw < 0.4 else self.textured()
