"""Configuration of a CloudFit network, and the shapes of the parameters that it implies."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any

from jetnormal.errors import UsageError
from jetnormal.support.options import Option, build

NODE_FEATURES = 5  # of a neighborhood: three variances, the tilt and the length of the offset to its centroid
FEATURES = 12  # invariants of an edge
MAX_CHANNELS = 4096
MAX_LAYERS = 32
BALLOTS = 3  # weights of a neighbor's votes: its offset, its normal, its normal mirrored


@dataclass(frozen=True)
class CloudFitConfig:
    """Configuration of a CloudFit network.

    Raises:
        ValueError: if the levels disagree or a number is out of range.
    """

    channels: Annotated[
        tuple[int, ...], Option("Channels of each level of the pyramid, the finest first; even numbers.")
    ] = (64, 128, 192, 256, 256, 256)
    hidden: Annotated[int, Option("Channels of the small networks that weigh edges.")] = 32
    up_layers: Annotated[
        tuple[int, ...], Option("Edge convolutions of each level on the way up, from fine to coarse.")
    ] = (1, 1, 2, 2, 2, 2)
    down_layers: Annotated[
        tuple[int, ...],
        Option("Edge convolutions of each level on the way down, from coarse to fine; a vote follows each of them."),
    ] = (2, 2, 2, 2, 2, 0)

    def __post_init__(self) -> None:
        if not 1 <= len(self.channels) == len(self.up_layers) == len(self.down_layers):
            raise ValueError("channels and layers must tell of the same levels, one or more")
        if any(not 2 <= width <= MAX_CHANNELS or width % 2 for width in self.channels):
            raise ValueError(f"channels are even numbers from 2 to {MAX_CHANNELS}")
        if not 1 <= self.hidden <= MAX_CHANNELS:
            raise ValueError(f"hidden is 1 to {MAX_CHANNELS}, not {self.hidden}")
        counts = (len(self.channels), *self.up_layers, *self.down_layers)
        if not all(0 <= count <= MAX_LAYERS for count in counts):
            raise ValueError(f"there are at most {MAX_LAYERS} levels, and layers in each")

    def votes(self, level: int) -> int:
        """Find how often the points of a level vote."""
        return max(self.down_layers[level], 1)

    @classmethod
    def from_description(cls, fields: dict[str, Any]) -> CloudFitConfig:
        """Make a configuration from the JSON of a model file.

        Raises:
            TypeError, ValueError: a field is unknown, missing or out of range.
        """
        try:
            return build(cls, dict(fields))
        except UsageError as error:
            raise ValueError(str(error)) from error


def check_shapes(config: CloudFitConfig, shapes: dict[str, tuple[int, ...]]) -> None:
    """Compare the shapes of parameters with those of a configuration, before any of them is used.

    Raises:
        ValueError: a parameter is missing, unknown, or of another shape.
    """
    expected = parameter_shapes(config)
    if missing := expected.keys() - shapes.keys():
        raise ValueError(f"without {min(missing)}")
    if unknown := shapes.keys() - expected.keys():
        raise ValueError(f"with the unknown {min(unknown)}")
    for name, shape in expected.items():
        if tuple(shapes[name]) != shape:
            raise ValueError(f"{name} has the shape {tuple(shapes[name])}, not {shape}")


def parameter_shapes(config: CloudFitConfig) -> dict[str, tuple[int, ...]]:
    """Return the shape of each parameter of the network, by its name there."""
    c, hidden = config.channels, config.hidden
    shapes: dict[str, tuple[int, ...]] = {}
    for number, width in enumerate(c):
        shapes |= _linear(f"embed.{number}", NODE_FEATURES, width)
        for direction, counts in (("up", config.up_layers), ("down", config.down_layers)):
            for layer in range(counts[number]):
                shapes |= _edge_conv(f"{direction}.{number}.{layer}", width, width)
        for vote in range(config.votes(number)):
            shapes |= _z_direction(f"direction.{number}.{vote}", width, c[number : number + 2], hidden)
    for number, (fine, coarse) in enumerate(pairwise(c)):
        shapes |= _edge_conv(f"pool.{number}", coarse, fine) | _edge_conv(f"unpool.{number}", fine, coarse)
        shapes |= _z_direction(f"interpolate.{number}", fine, (coarse,), hidden)
    shapes |= _edge_conv("carry", c[0], c[0]) | _z_direction("carried_direction", c[0], c[:1], hidden)
    return shapes | _linear("confidence.0", c[0] + 1, hidden) | _linear("confidence.2", hidden, 1)


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _edge_conv(name: str, width: int, sender: int) -> dict[str, tuple[int, ...]]:
    shapes = _linear(f"{name}.own", width, width) | _linear(f"{name}.out", width, width)
    shapes |= {f"{name}.norm.weight": (width,), f"{name}.norm.bias": (width,)}
    return shapes | {f"{name}.sender.weight": (width, sender), f"{name}.edge": (FEATURES, width)}


def _z_direction(name: str, width: int, senders: tuple[int, ...], hidden: int) -> dict[str, tuple[int, ...]]:
    shapes = _linear(f"{name}.own", width, 1)
    for number, sender in enumerate(senders):
        part = f"{name}.weights.{number}"
        shapes |= _linear(f"{part}.own", width, hidden) | _linear(f"{part}.out", hidden, BALLOTS)
        shapes |= {f"{part}.sender.weight": (hidden, sender), f"{part}.edge": (FEATURES, hidden)}
    return shapes
