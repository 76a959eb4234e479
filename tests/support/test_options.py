from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pytest

from jetnormal.errors import UsageError
from jetnormal.support.options import Option, OptionSet, Vector, build, fields


@dataclass(frozen=True)
class Example(OptionSet):
    k: Annotated[int | None, Option("Neighbors.", low=1)] = None
    scale: Annotated[float, Option("Scale.", low=1, high=10)] = 1.5
    orient: Annotated[Literal["auto", "up"], Option("Signs.")] = "auto"
    viewpoint: Annotated[Vector | None, Option("Position.")] = None
    folders: Annotated[tuple[str, ...], Option("Folders.")] = ()
    fast: Annotated[bool, Option("Fast.")] = False
    internal: int = 3


def test_values_that_fit_are_taken():
    Example()
    made = Example(k=np.int64(3), scale=2, orient="up", viewpoint=(0, 1.0, 2), folders=("a", "b"), fast=True)
    assert made.k == 3 and made.folders == ("a", "b")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"k": 0}, "k is 1 or more, not 0"),
        ({"k": 1.5}, "k is a whole number, not 1.5"),
        ({"k": True}, "k is a whole number, not True"),
        ({"scale": 11}, "scale is 1 to 10, not 11"),
        ({"scale": float("nan")}, "scale is 1 to 10, not nan"),
        ({"scale": None}, "scale is a number, not None"),
        ({"orient": "upp"}, "orient is one of auto, up, not 'upp'; did you mean up?"),
        ({"viewpoint": (1.0, 2.0)}, "viewpoint is 3 values, not (1.0, 2.0)"),
        ({"folders": ("a", 1)}, "folders is a list, each item a text, not ('a', 1)"),
        ({"fast": 1}, "fast is true or false, not 1"),
    ],
)
def test_values_that_do_not_fit_are_refused_by_name(values, message):
    with pytest.raises(UsageError) as refusal:
        Example(**values)
    assert str(refusal.value) == message


def test_a_table_becomes_an_option_set():
    assert build(Example, {"k": 5, "folders": ["a"], "viewpoint": [0, 0, 1]}) == Example(
        k=5, folders=("a",), viewpoint=(0, 0, 1)
    )
    with pytest.raises(UsageError, match=r"^file.toml: unknown setting orientt; did you mean orient\?$"):
        build(Example, {"orientt": "up"}, "file.toml: ")
    with pytest.raises(UsageError, match=r"^file.toml: k is a whole number, not 'x'$"):
        build(Example, {"k": "x"}, "file.toml: ")


def test_fields_tell_types_and_notes():
    k, *_, internal = fields(Example)
    assert (k.name, k.types, k.default, k.note.low) == ("k", (int, type(None)), None, 1)
    assert internal.note is None
    assert fields(Example)[2].choices == ("auto", "up")
