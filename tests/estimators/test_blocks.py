"""Blocks of a large cloud and what they see around them."""

import numpy as np

from jetnormal.estimators import blocks


def test_a_dense_region_beside_a_block_does_not_fill_the_memory():
    rng = np.random.default_rng(0)
    sparse, dense = rng.random((1000, 3)) * [1, 1, 0], rng.random((50_000, 3)) * [0.05, 1, 0] + [1, 0, 0]
    core = np.arange(1000)
    rows = blocks.with_halo(np.concatenate([sparse, dense]), core, blocks.halo_width(sparse, None))
    assert len(rows) == 1000 + blocks.HALO_SHARE * 1000
    assert len(np.unique(rows)) == len(rows)
    assert set(core) <= set(rows)
