"""What was decided about the signs of a cloud, why, and what a user should know of it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from jetnormal.orientation.methods import Orientation

# Probabilities that a cloud was scanned from inside, from which on a warning says so, normals look inward, and no
# warning is needed.
SUSPECT, RATHER, CERTAIN = 0.125, 0.5, 0.9
# Mean confidence of signs inside. Of 199 simulated scans that were certain, 13 are below it, of which 7 have less than
# 85 % right signs, as have 9 of the others.
HARDLY = 0.8


@dataclass(frozen=True)
class Decision:
    """How the signs were settled.

    Attributes:
        asked: the option `orient`.
        used: the method: "viewpoint", "terrain", "global", "inside", "origin", "view", "mst", "up" or "none".
        reason: why that method.
        open_share: of the points that lie on surfaces without an outside.
        confidence: mean of the signs' confidence.
        guessed: whether the side of open surfaces is a guess.
        unseen: points without a finite viewpoint; their normals look up.
        inside: the probability that the cloud was scanned from inside.
    """

    asked: str
    used: str
    reason: str
    open_share: float = 0.0
    confidence: float = 0.0
    guessed: bool = field(default=False, repr=False)
    unseen: int = field(default=0, repr=False)
    inside: float = field(default=0.0, repr=False)

    def facts(self) -> dict[str, Any]:
        """What a summary in JSON says."""
        values = asdict(self)
        return {name: values[name] for name in ("asked", "used", "reason", "open_share", "confidence")}

    def warnings(self) -> list[str]:
        """What a user should know."""
        found = []
        if self.guessed:
            found.append(
                f"{self.open_share:.0%} of the points lie on open surfaces, which have no outside, and nothing tells "
                "which side was seen: their normals may all look the wrong way; `viewpoint` or `orient` settles it"
            )
        if self.used == "inside" and self.inside < CERTAIN:
            found.append(
                f"it looks like a room or street that was scanned from inside (probability {self.inside:.0%}), and its "
                "normals look inward: for an object, `orient=global` turns them outward"
            )
        elif self.used == "inside" and self.confidence < HARDLY:
            found.append(
                f"it was scanned from inside, but its signs are right by {self.confidence:.0%} only: `viewpoint`, a "
                "place inside that sees its walls, makes them sure"
            )
        elif self.used != "inside" and self.inside >= SUSPECT and not self.guessed:
            found.append(
                f"it may be a room or street that was scanned from inside (probability {self.inside:.0%}): then its "
                "normals all look the wrong way, and `viewpoint`, any place inside, turns them"
            )
        if self.unseen:
            found.append(f"{self.unseen} points have no finite viewpoint; their normals look up")
        return found


def decided(orientation: Orientation, asked: str, used: str, reason: str) -> Decision:
    """Say how signs came about, in the words of `Decision`."""
    count = max(1, len(orientation.open))
    share, confidence = float(orientation.open.sum() / count), float(orientation.confidence.sum() / count)
    return Decision(asked, used, reason, round(share, 4), round(confidence, 4))
