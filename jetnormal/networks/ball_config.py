"""Configuration of the networks that look at balls of several sizes around a point: PCPNet and Nesti-Net."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from jetnormal.support.options import Option


@dataclass(frozen=True)
class BallConfig:
    """Configuration of a network of balls; the defaults are PCPNet's.

    Raises:
        ValueError: if a number is out of range.
    """

    radii: Annotated[
        tuple[float, ...], Option("Radii of the balls, as shares of the diagonal of the cloud's bounding box.")
    ] = (0.01, 0.03, 0.05)
    points: Annotated[int, Option("Points of a ball; from a fuller ball so many are drawn.")] = 500
    width: Annotated[float, Option("Factor on all numbers of channels; 1 is as published.")] = 1.0
    principal_axes: Annotated[
        bool,
        Option(
            "Whether the balls are first turned to the principal axes of the largest one. A small network then need "
            "not learn all rotations; the published networks do without."
        ),
    ] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "radii", tuple(self.radii))  # a model file has a list
        if not self.radii or min(self.radii) <= 0:
            raise ValueError(f"radii are positive, not {self.radii}")
        if self.points < 3:
            raise ValueError(f"a ball has 3 points or more, not {self.points}")
        if not 0 < self.width <= 4:
            raise ValueError(f"the width of a network lies between 0 and 4, not {self.width}")
