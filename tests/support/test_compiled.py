"""Compiled functions: their arguments, and the machine code that is kept for later processes."""

import functools
import gc
import re
import subprocess
import sys

import numpy as np
import pytest

from jetnormal.support import compiled as module
from jetnormal.support.compiled import compiled

FACTOR = 2.0


@compiled
def twice(value):
    return FACTOR * value


@compiled
def add_twice(values, count, shift, sums):
    """Add to sums (N,) twice the first of each row of values, so many, and shift."""
    for i in range(len(values)):
        for k in range(count):
            sums[i] += twice(values[i, k]) + shift


def returns_a_value(values):
    return values[0]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    return tmp_path


def fresh():
    """The function as another process has it, with nothing compiled."""
    return compiled(add_twice._function)


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.int32, np.uint8])
def test_arrays_of_all_types_and_numbers_are_taken(dtype):
    values, sums = np.arange(12, dtype=dtype).reshape(4, 3), np.ones(4)
    fresh()(values, 2, 0.5, sums)
    np.testing.assert_allclose(sums, 1 + 2 * values[:, :2].sum(axis=1, dtype=np.float64) + 2 * 0.5)


def test_another_function_loads_the_code_that_was_kept(folder, monkeypatch: pytest.MonkeyPatch):
    values, sums = np.arange(12.0).reshape(4, 3), np.zeros(4)
    fresh()(values, 3, 0.0, sums)
    monkeypatch.setattr(module.Compiled, "_compile", None)
    fresh()(values, 3, 0.0, sums)
    np.testing.assert_allclose(sums, 4 * values.sum(axis=1))


def test_what_it_calls_and_the_numbers_it_uses_decide_about_its_code(folder, monkeypatch: pytest.MonkeyPatch):
    values, sums = np.ones((1, 1)), np.zeros(1)
    fresh()(values, 1, 0.0, sums)
    monkeypatch.setattr(sys.modules[__name__], "FACTOR", 5.0)
    fresh()(values, 1, 0.0, sums)
    assert len(list(folder.glob("*.o"))) == 2


def test_damaged_code_is_compiled_again(folder):
    values, sums = np.ones((1, 1)), np.zeros(1)
    fresh()(values, 1, 0.0, sums)
    (file,) = folder.glob("*.o")
    whole = file.read_bytes()
    for damaged in (whole[:-1], whole[: len(whole) // 2], b"", b"\n", whole.replace(b"sha256", b"sha257")):
        file.write_bytes(damaged)
        fresh()(values, 1, 0.0, sums)
        assert len(file.read_bytes()) == len(whole)
    assert sums[0] == 6 * 2


def test_says_once_what_takes_so_long(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    monkeypatch.setattr(module, "_announce", functools.cache(module._announce.__wrapped__))
    with caplog.at_level("INFO", "jetnormal"):
        for dtype in (np.float32, np.float64, np.float64):
            fresh()(np.ones((1, 1), dtype), 1, 0.0, np.zeros(1))
    assert [record.message for record in caplog.records] == [
        "compiling loops for this machine: some seconds, this once"
    ]


def test_code_lies_in_the_folder_of_the_user(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setattr(module, "_user_cache", lambda: tmp_path)
    fresh()(np.ones((1, 1)), 1, 0.0, np.zeros(1))
    assert list((tmp_path / "jetnormal" / "compiled").glob("*add_twice*.o"))


def test_compiles_where_nothing_can_be_written(tmp_path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(module, "_folders", lambda: [tmp_path / "file"])
    sums = np.zeros(1)
    fresh()(np.ones((1, 1)), 1, 0.0, sums)
    assert sums[0] == 2


def test_refuses_what_it_cannot_do():
    with pytest.raises(ValueError, match="C-contiguous"):
        fresh()(np.ones((3, 3)).T, 1, 0.0, np.zeros(3))
    with pytest.raises(TypeError, match="returns a value"):
        compiled(returns_a_value)(np.ones(1))
    with pytest.raises(TypeError):
        fresh()(np.ones((1, 1)), "1", 0.0, np.zeros(1))


def test_other_conventions_of_calling_are_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "_convention", lambda _: ["ptr"])
    with pytest.raises(RuntimeError, match=re.escape("version of numba")):
        fresh()(np.ones((1, 1)), 1, 0.0, np.zeros(1))


def test_kept_code_needs_no_numba(folder):
    script = """
import sys
import numpy as np
from jetnormal.geometry.moments import moments_of
rng = np.random.default_rng(0)
scale = moments_of(rng.random((9, 3)), rng.random((9, 3)), rng.integers(0, 9, (9, 4), np.int32))[0]
print(scale.sum(), "numba" in sys.modules)
"""
    runs = [subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True) for _ in "ab"]
    (before, compiled_it), (after, compiled_again) = (run.stdout.split() for run in runs)
    assert before == after and (compiled_it, compiled_again) == ("True", "False")


@pytest.mark.parametrize("collects", [True, False])
def test_garbage_is_collected_after_compilation_as_before(collects):
    was = gc.isenabled()
    try:
        (gc.enable if collects else gc.disable)()
        with pytest.raises(TypeError, match="returns a value"):
            compiled(returns_a_value)(np.zeros(2))
        assert gc.isenabled() == collects
    finally:
        (gc.enable if was else gc.disable)()
