"""Blocks of a large cloud and what they see around them."""

import numpy as np
import pytest

from jetnormal.geometry import blocks


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def square(points: int, rng: np.random.Generator, low: float = 0.0, width: float = 1.0) -> np.ndarray:
    """Points of a plane, x from `low` on."""
    return rng.random((points, 3)) * [width, 1, 0] + [low, 0, 0]


def box_of(points: np.ndarray) -> np.ndarray:
    return np.stack([points.min(axis=0), points.max(axis=0)])


@pytest.mark.parametrize("count", [2000, 40_000])
def test_the_spacing_is_the_distance_of_sixteen_neighbors(rng, count):
    """On a square, k neighbors lie in a circle of k / N; the mean square of their distances is half that of the rim."""
    expected = np.sqrt(16 / (2 * np.pi * count))
    points = square(count, rng)
    assert np.median(blocks.Spacing.of(points).at(points)) == pytest.approx(expected, rel=0.1)


def test_a_halo_is_as_wide_as_its_own_points_are_apart(rng):
    """A core between a dense and a sparse cell sees equally many rows of points of both."""
    core, dense, sparse = square(10_000, rng), square(160_000, rng, 1.0), square(2500, rng, -1.0)
    for cell, spacing in ((dense, 1 / 400), (sparse, 1 / 50)):
        rows, apart = blocks.seen_from(box_of(core), cell, blocks.Spacing.of(cell), reach=5.0)
        seen = cell[rows, 0]
        width = max(seen.max() - 1, -seen.min())
        expected = 5.0 * spacing * np.sqrt(8 / np.pi)
        assert expected < width < 2.2 * expected  # at the border, and in corners, neighbors lie on one side
        assert apart.max() <= 5.0


def test_a_dense_cell_beside_a_core_does_not_fill_the_memory(rng):
    core, dense = square(1000, rng), square(50_000, rng, 1.0, 0.05)
    seen = [blocks.seen_from(box_of(core), dense, blocks.Spacing.of(dense), reach=200.0)]
    (rows,) = blocks.nearest(seen, len(core))
    assert len(seen[0][0]) > blocks.HALO_SHARE * len(core) >= len(rows) > 0
    assert dense[rows, 0].max() < np.quantile(dense[:, 0], 0.05)


def test_a_cell_of_copies_of_a_point_has_a_spacing(rng):
    copies = np.ones((50_000, 3))
    assert blocks.Spacing.of(copies).largest == 0
    rows, _ = blocks.seen_from(box_of(square(10, rng)), copies, blocks.Spacing.of(copies), reach=10.0)
    assert len(rows) == 0


def test_blocks_hold_each_point_once_in_their_cores(rng, monkeypatch):
    monkeypatch.setattr(blocks, "CORE", 500)
    points = square(3000, rng)
    cut = list(blocks.blocks(points, reach=5.0))
    assert len(cut) > 5
    np.testing.assert_array_equal(np.sort(np.concatenate([core for core, _ in cut])), np.arange(3000))
    for core, halo in cut:
        assert 0 < len(halo) <= len(core) < 600
        assert not np.isin(halo, core).any()
