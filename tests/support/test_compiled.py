"""Compiled functions work where nothing can be kept on disk."""

import numpy as np
import pytest

from jetnormal.support.compiled import compiled, is_kept


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


def test_the_cache_lies_in_the_folder_of_the_user(monkeypatch: pytest.MonkeyPatch, tmp_path):
    from numba import config

    monkeypatch.setattr(config, "CACHE_DIR", "")
    monkeypatch.setattr("jetnormal.support.compiled._user_cache", lambda: tmp_path)
    assert compiled(double_sum)(np.arange(4.0)) == 12
    assert list((tmp_path / "jetnormal" / "numba").rglob("*double_sum*.nbc"))
    assert config.CACHE_DIR == ""


def test_a_cache_folder_of_the_users_choice_is_taken(monkeypatch: pytest.MonkeyPatch, tmp_path):
    monkeypatch.setattr("numba.config.CACHE_DIR", str(tmp_path))
    function = compiled(double_sum)
    assert not is_kept(function)
    function(np.arange(4.0))
    assert list(tmp_path.rglob("*double_sum*.nbc"))
    assert is_kept(compiled(double_sum))
