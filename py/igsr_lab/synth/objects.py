"""``random_object``: one of all kinds of objects."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from igsr_lab.synth import built_objects as built
from igsr_lab.synth import still_life as still
from igsr_lab.synth.description import Part
from igsr_lab.synth.materials import Materials
from igsr_lab.synth.parts import bounds, moved

#: All kinds of objects; their order decides which is drawn.
OBJECTS: dict[str, Callable[[np.random.Generator, Materials], list[Part]]] = {
    kind.__name__: kind
    for kind in (
        still.pile, still.vessel, still.plant, still.tree, built.chair, built.bricks, built.cage,
        built.machine, built.figure, built.vehicle, still.books, built.tower, still.fruit,
        still.drums, still.cloth,
    )
}  # fmt: skip


def random_object(rng: np.random.Generator) -> tuple[str, list[Part]]:
    """Draw an object that stands on z = 0 and fits a radius of 1; return its name and parts."""
    name = str(rng.choice(tuple(OBJECTS)))
    parts = OBJECTS[name](rng, Materials(rng))
    lowest, highest = bounds(parts)
    middle = 0.5 * (lowest + highest)
    reach = max(0.5 * float(np.hypot(*(highest - lowest)[:2])), 0.6 * float((highest - lowest)[2]))
    at = -np.array([middle[0], middle[1], lowest[2]]) / reach
    return name, moved(parts, np.eye(3) / reach, at)
