"""What networks that look at balls of several sizes around a point have in common: PCPNet and Nesti-Net."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class BallConfig:
    """What rebuilds a network of balls; the defaults are PCPNet's.

    Attributes:
        radii: of the balls, in diagonals of the cloud's bounding box.
        points: of a ball: as many are drawn from a fuller one.
        width: factor on every channel count.
        principal_axes: whether the balls are turned to the principal axes of the largest one, which spares a small
            network learning all rotations; the published networks do without.

    Raises:
        ValueError: if a number is out of range.
    """

    radii: tuple[float, ...] = (0.01, 0.03, 0.05)
    points: int = 500
    width: float = 1.0
    principal_axes: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "radii", tuple(self.radii))  # a model file has a list
        if not self.radii or min(self.radii) <= 0:
            raise ValueError(f"radii are positive, not {self.radii}")
        if self.points < 3:
            raise ValueError(f"a ball has 3 points or more, not {self.points}")
        if not 0 < self.width <= 4:
            raise ValueError(f"the width of a network lies between 0 and 4, not {self.width}")
