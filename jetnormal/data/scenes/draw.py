"""The drawing of a scene at random."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jetnormal.data.scenes.layout import Scene
from jetnormal.data.scenes.rooms import room
from jetnormal.data.scenes.streets import street
from jetnormal.data.scenes.terrain import terrain

SCENES: dict[str, tuple[Callable[[np.random.Generator], Scene], float]] = {
    "room": (room, 0.5),
    "street": (street, 0.3),
    "terrain": (terrain, 0.2),
}


def random_scene(rng: np.random.Generator, kind: str | None = None) -> Scene:
    """Draw a scene of a kind, a key of `SCENES`, or of any, by its share there."""
    chosen = kind or str(rng.choice(list(SCENES), p=[share for _, share in SCENES.values()]))
    return SCENES[chosen][0](rng)
