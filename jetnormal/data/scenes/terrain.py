"""Terrain: hills with houses, trees, poles and walls."""

from __future__ import annotations

import itertools

import numpy as np

from jetnormal.data.scenes.layout import Floor, Scene
from jetnormal.data.scenes.outdoors import car, fence, house, pole, tree
from jetnormal.data.scenes.surfaces import Floats, Rng, frustum, height_field


class Hills:
    """A height over the ground plane: a sum of plane waves, the longer the higher."""

    def __init__(self, extent: float, rng: Rng) -> None:
        count = 24
        wavelength = extent * np.exp(rng.uniform(np.log(0.02), np.log(2.0), count))
        angle = rng.uniform(0, 2 * np.pi, count)
        self._waves = 2 * np.pi / wavelength * np.stack([np.cos(angle), np.sin(angle)])
        steep = rng.choice([0.01, 0.05, 0.15, 0.4]) * rng.uniform(0.5, 1)
        self._heights = steep * wavelength / (2 * np.pi) * rng.random(count) / np.sqrt(count / 8)
        self._phases = rng.uniform(0, 2 * np.pi, count)

    def __call__(self, x: Floats | float, y: Floats | float) -> tuple[Floats, Floats, Floats]:
        """Return the height and the slopes along x and y."""
        angles = np.multiply.outer(x, self._waves[0]) + np.multiply.outer(y, self._waves[1]) + self._phases
        slopes = self._heights * np.cos(angles)
        return np.sin(angles) @ self._heights, slopes @ self._waves[0], slopes @ self._waves[1]


def terrain(rng: Rng) -> Scene:
    """Draw a piece of terrain of 60 to 250 m."""
    extent = float(np.exp(rng.uniform(np.log(60), np.log(250))))
    hills, floor = Hills(extent, rng), Floor()
    line = np.linspace(0, extent, 201)
    ground = height_field(line, line, hills)
    wooded, settled = rng.choice([0.0, 1.0, 4.0]), rng.choice([0.0, 1.0, 3.0])
    area = extent**2 / 1e4
    makers = [(house, 6 * settled), (car, 4 * settled), (fence, 3 * settled), (pole, 3), (tree, 12 * wooded)]
    for maker, share in makers:
        for _ in range(min(30, rng.poisson(share * area))):
            x, y = rng.uniform(0.03, 0.97, 2) * extent
            sunk = 0.3 if maker is tree or maker is pole else 0.0
            floor.put(maker(rng), x, y, float(hills(x, y)[0]) - sunk, rng.uniform(0, 2 * np.pi), room=0.8)
    if rng.random() < 0.3:
        _power_line(floor, hills, extent, rng)
    stands = floor.stands(np.full(2, 0.2 * extent), np.full(2, 0.8 * extent), (1.5, 2.2), rng)
    stands[:, 2] += hills(stands[:, 0], stands[:, 1])[0]
    high, across = rng.uniform(30, 1500), rng.uniform(0.3, 0.7) * extent
    trip = np.array([[0.0, across, high], [extent, across, high]])
    return Scene("terrain", floor.joined([ground]), stands, trip)


def _power_line(floor: Floor, hills: Hills, extent: float, rng: Rng) -> None:
    """Masts and wires along x."""
    y, high = rng.uniform(0.2, 0.8) * extent, rng.uniform(8, 25)
    xs = np.linspace(0.1, 0.9, max(2, round(extent / 45))) * extent
    tops = [np.array([x, y, float(hills(x, y)[0]) + high]) for x in xs]
    for top in tops:
        floor.pieces.append(frustum(top - [0, 0, high + 0.5], top, 0.2, 0.1))
    for before, after in itertools.pairwise(tops):
        share = np.linspace(0, 1, 9)[:, None]
        wire = before + share * (after - before) - [0, 0, 4.0] * share * (1 - share)
        floor.pieces += [frustum(a, b, 0.02) for a, b in itertools.pairwise(wire)]
