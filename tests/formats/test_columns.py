from __future__ import annotations

import time

from jetnormal.formats.columns import UniqueNames


def test_names_that_come_again_get_numbers():
    names = UniqueNames(["x", "b_2"])
    assert [names.add(name) for name in ("a", "x", "a", "b", "b", "a", "a_2")] == [
        "a",
        "x_2",
        "a_2",
        "b",
        "b_3",
        "a_3",
        "a_2_2",
    ]


def test_many_names_take_no_time():
    """A header of 20,000 names took 18 seconds, when each was compared with all others; here it would take an hour."""
    names, started = UniqueNames(), time.perf_counter()
    found = {names.add(name) for name in ["a"] * 200_000 + [f"b{index}" for index in range(200_000)]}
    assert len(found) == 400_000 and time.perf_counter() - started < 20
