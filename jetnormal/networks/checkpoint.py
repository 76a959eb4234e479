"""Networks on disk: safetensors files that carry the configuration which rebuilds the network.

Loading runs no code from the file: tensors and JSON text are all it holds.
"""

from __future__ import annotations

import dataclasses
import json
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError, safe_open
from torch import Tensor

from jetnormal.errors import ModelError
from jetnormal.formats.atomic import atomic_write
from jetnormal.networks.packaged import resolve

if TYPE_CHECKING:
    from jetnormal.networks.cloudfit.network import CloudFit
    from jetnormal.networks.iternet import IterNet
    from jetnormal.networks.nestinet import NestiNet
    from jetnormal.networks.patchfit.network import PatchFit
    from jetnormal.networks.pcpnet import PCPNet

    Network = PatchFit | CloudFit | IterNet | PCPNet | NestiNet

FORMAT = "jetnormal-1"
# Modules, networks and configurations; imported when needed, for some bring compiled loops along.
ARCHITECTURES = {
    "patchfit": ("patchfit.network", "PatchFit", "PatchFitConfig"),
    "cloudfit": ("cloudfit.network", "CloudFit", "CloudFitConfig"),
    "iternet": ("iternet", "IterNet", "IterNetConfig"),
    "pcpnet": ("pcpnet", "PCPNet", "PCPNetConfig"),
    "nestinet": ("nestinet", "NestiNet", "NestiNetConfig"),
}


def save_tensors(path: Path, tensors: dict[str, Tensor], metadata: dict[str, Any]) -> None:
    """Writes tensors and a JSON description, atomically; an existing file is replaced.

    Raises:
        InputError: if the file cannot be written.
    """
    from safetensors.torch import save

    text = {"format": FORMAT, "description": json.dumps(metadata, sort_keys=True)}
    content = save({name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}, metadata=text)
    with atomic_write(path, overwrite=True) as stream:
        stream.write(_canonical(content))


def _canonical(content: bytes) -> bytes:
    """A safetensors file with the entries of its metadata sorted: the library writes them in a random order."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # the tensors stay aligned
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Reads what `save_tensors` wrote.

    Raises:
        ModelError: if the file is missing, damaged, or of another program.
    """
    if not path.is_file():
        raise ModelError(f"{path}: no such model file")
    try:
        with safe_open(path, framework="pt") as file:
            text = file.metadata() or {}
            if text.get("format") != FORMAT:
                raise ModelError(f"{path}: not a model of jetnormal; train one with `jetnormal train`")
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return tensors, dict(json.loads(text["description"]))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise ModelError(f"{path}: damaged or not a safetensors file ({error})") from error


def save_model(path: Path, network: Network, training: dict[str, Any]) -> None:
    """Writes a network with its configuration and facts about its training.

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
    """Loads a packaged network by its name, or a network from a file, ready for inference on the CPU.

    Raises:
        ModelError: if there is no such model, or the file is damaged.
    """
    path = resolve(name)
    tensors, metadata = load_tensors(path)
    architecture = metadata.get("architecture")
    if architecture not in ARCHITECTURES:
        raise ModelError(f"{path}: holds no network (architecture {architecture!r})")
    try:
        network = _build(architecture, metadata["config"])
        network.load_state_dict(tensors)
    except (TypeError, KeyError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise ModelError(f"{path}: its configuration and its weights do not fit ({reason})") from error
    return network.for_inference()


def _build(architecture: str, config: dict[str, Any]) -> Network:
    """A network by its architecture and its configuration."""
    module, network, configuration = ARCHITECTURES[architecture]
    found = import_module(f"jetnormal.networks.{module}")
    built: Network = getattr(found, network)(getattr(found, configuration)(**config))
    return built
