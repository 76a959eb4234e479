"""Save and load networks: safetensors files whose metadata holds the configuration of the network.

A file holds tensors and JSON text; loading it runs no code.
"""

from __future__ import annotations

import dataclasses
import json
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from jetnormal.errors import ModelError, UsageError
from jetnormal.formats.atomic import atomic_write
from jetnormal.networks.model_file import ARCHITECTURES, FORMAT, LARGEST_WEIGHT, read_tensors
from jetnormal.networks.packaged import resolve
from jetnormal.support.device import torch_threads
from jetnormal.support.options import build

if TYPE_CHECKING:
    from jetnormal.networks.cloudfit.network import CloudFit
    from jetnormal.networks.iternet import IterNet
    from jetnormal.networks.nestinet import NestiNet
    from jetnormal.networks.patchfit.network import PatchFit
    from jetnormal.networks.pcpnet import PCPNet

    Network = PatchFit | CloudFit | IterNet | PCPNet | NestiNet

LONGEST_LIST = 64  # of a configuration: each item makes at least one module


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Write tensors and a JSON description, atomically; an existing file is replaced.

    Raises:
        InputError: if the file cannot be written.
    """
    from safetensors.torch import save

    text = {"format": FORMAT, "description": json.dumps(metadata, sort_keys=True)}
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata=text)
    with atomic_write(path, overwrite=True) as stream:
        stream.write(_canonical(content))


def _canonical(content: bytes) -> bytes:
    """Sort the metadata of a safetensors file, which the library writes in a random order."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # the tensors stay aligned
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `save_tensors` wrote.

    Raises:
        ModelError: if the file is missing, damaged, or of another program.
    """
    return read_tensors(path, "pt")


def save_model(path: Path, network: Network, training: dict[str, Any]) -> None:
    """Write a network with its configuration and facts about its training.

    Raises:
        InputError: if the file cannot be written.
    """
    metadata = {
        "architecture": network.architecture,
        "config": dataclasses.asdict(network.config),
        "training": training,
    }
    save_tensors(path, network.state_dict(), metadata)


def load_model(name: str | Path) -> Network:
    """Load a packaged network by its name, or a network from a file, ready for inference on the CPU.

    Raises:
        ModelError: there is no such model, the file is damaged, or a weight is NaN, infinite or beyond 10^6.
    """
    path = resolve(name)
    tensors, metadata = load_tensors(path)
    architecture = str(metadata.get("architecture"))
    if architecture not in ARCHITECTURES:
        raise ModelError(f"{path}: holds no network (architecture {architecture!r})")
    with torch_threads(None):
        try:
            # On the meta device nothing is allocated, and nothing drawn at random, before the shapes are compared.
            with torch.device("meta"):
                network = build_network(architecture, dict(metadata["config"]))
            _check_tensors(tensors, network.state_dict())
        except (UsageError, TypeError, KeyError, ValueError, RuntimeError, OverflowError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise ModelError(f"{path}: its configuration and its weights do not fit ({reason[:200]})") from error
        network.load_state_dict(tensors, assign=True)
        return network.for_inference()


def build_network(architecture: str, config: dict[str, Any]) -> Network:
    """Build a network of an architecture from its configuration."""
    if any(isinstance(value, list) and len(value) > LONGEST_LIST for value in config.values()):
        raise ValueError(f"a list of more than {LONGEST_LIST} items")
    module, network, configuration = ARCHITECTURES[architecture]
    found = import_module(f"jetnormal.networks.{module}")
    built: Network = getattr(found, network)(build(getattr(found, configuration), config))
    return built


def _check_tensors(tensors: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    """Check that tensors fit a network.

    Raises:
        ValueError: one is missing, unknown, of another shape or type, or holds NaN, infinite or huge numbers.
    """
    for name in sorted(tensors.keys() ^ expected.keys()):
        raise ValueError(f"{name} is {'not needed' if name in tensors else 'missing'}")
    for name, tensor in tensors.items():
        wanted = expected[name]
        if tensor.shape != wanted.shape or tensor.dtype != wanted.dtype:
            raise ValueError(
                f"{name} is {tensor.dtype} of shape {tuple(tensor.shape)} instead of {tuple(wanted.shape)}"
            )
        if tensor.is_floating_point() and not bool((tensor.abs() <= LARGEST_WEIGHT).all()):  # NaN compares as false
            raise ValueError(f"{name} holds weights that are NaN, infinite or beyond {LARGEST_WEIGHT:g}")
