"""Random materials that suit one palette."""

from __future__ import annotations

import numpy as np

from igsr_lab.synth.description import Material
from igsr_lab.synth.textures import TEXTURES, palette

#: Rows and columns of a texture.
TEXTURE_SIZE = 256


class Materials:
    """Draws the materials of one object or room: one palette, and a taste for how shiny things are.

    Args:
        rng: draws everything.
        vividness: how likely the palette is to be saturated.
    """

    def __init__(self, rng: np.random.Generator, vividness: float = 0.35) -> None:
        """Draw the palette."""
        self.rng = rng
        self.colours = palette(rng, vividness)
        self.shininess = rng.beta(1.5, 2.0)

    def colour(self) -> np.ndarray:
        """[3], sRGB: one of the palette."""
        return np.asarray(self.colours[self.rng.integers(len(self.colours))])

    def texture(self, *names: str) -> np.ndarray:
        """A texture of one of these kinds, or of any kind where none is named."""
        name = str(self.rng.choice(names or tuple(TEXTURES)))
        return TEXTURES[name](self.rng, self.colours, TEXTURE_SIZE)

    def coated(self, colour: np.ndarray) -> Material:
        """A colour or texture as a matte or glossy surface."""
        if self.rng.random() < self.shininess:
            return Material("glossy", colour, float(self.rng.uniform(0.05, 0.4)))
        return Material("matte", colour)

    def plain(self) -> Material:
        """A single colour."""
        return self.coated(self.colour())

    def textured(self, *names: str) -> Material:
        """A texture of one of these kinds, or of any kind where none is named."""
        return self.coated(self.texture(*names))

    def metal(self) -> Material:
        """Polished to brushed metal: steel, brass, copper, or a tinted one."""
        tints = np.array([[0.85, 0.85, 0.86], [0.93, 0.8, 0.5], [0.93, 0.67, 0.55]])
        tint = tints[self.rng.integers(3)] if self.rng.random() < 0.7 else 0.5 + 0.5 * self.colour()
        return Material("metal", tint, float(self.rng.uniform(0.12, 0.45)))

    def glass(self) -> Material:
        """Clear glass."""
        return Material("glass", np.ones(3))

    def any(self) -> Material:
        """Mostly textured, sometimes plain, at times metal, rarely glass."""
        draw = self.rng.random()
        if draw < 0.02:
            return self.glass()
        if draw < 0.02 + 0.2 * self.shininess:
            return self.metal()
        return self.plain() if draw < 0.4 else self.textured()
