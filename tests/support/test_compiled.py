"""Compiled functions work where nothing can be kept on disk."""

import numpy as np
import pytest

from jetnormal.support.compiled import compiled


def double_sum(values):
    total = 0.0
    for value in values:
        total += 2 * value
    return total


def test_compiles_where_no_cache_can_be_written(monkeypatch: pytest.MonkeyPatch):
    from numba.core import dispatcher

    def nowhere(function):
        raise RuntimeError("cannot cache function: no locator available")

    monkeypatch.setattr(dispatcher, "FunctionCache", nowhere)
    assert compiled(double_sum)(np.arange(4.0)) == 12
