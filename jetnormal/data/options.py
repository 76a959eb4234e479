"""The options of `jetnormal dataset`, each defined once, and the sizes of training data. It imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from jetnormal.support.options import Option, OptionSet

CLOUDS_PER_EPOCH = 24  # of a source that draws its clouds anew
POINTS_PER_CLOUD = 100_000  # of such a cloud, at most
Split = Literal["test", "training", "validation"]


@dataclass(frozen=True)
class DatasetOptions(OptionSet):
    """What is drawn of each shape and scene.

    Raises:
        UsageError: an option is out of range.
    """

    points: Annotated[int, Option("Points of each cloud; for scans the largest number.", low=3, metavar="N")] = 100_000
    queries: Annotated[int, Option("Points of each cloud that its .pidx names, at most.", low=1, metavar="N")] = 5_000
    split: Annotated[
        Split, Option("What the set is for, which decides how its lists are named: test, training or validation.",
                      metavar="SPLIT")
    ] = "test"  # fmt: skip
    seed: Annotated[int, Option("Random seed.", low=0, metavar="S")] = 1
