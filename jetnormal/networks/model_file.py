"""Model files: safetensors whose metadata holds the configuration that rebuilds the network, read without PyTorch."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from jetnormal.errors import ModelError

FORMAT = "jetnormal-1"
# Of each architecture the module, the network and its configuration: imported when needed, for some are heavy.
ARCHITECTURES = {
    "patchfit": ("patchfit.network", "PatchFit", "PatchFitConfig"),
    "cloudfit": ("cloudfit.network", "CloudFit", "CloudFitConfig"),
    "iternet": ("iternet", "IterNet", "IterNetConfig"),
    "pcpnet": ("pcpnet", "PCPNet", "PCPNetConfig"),
    "nestinet": ("nestinet", "NestiNet", "NestiNetConfig"),
}
LARGEST_WEIGHT = 1e6  # no layer of use has a larger one, and products of a few would not be finite in float32


def read_description(path: Path) -> dict[str, Any]:
    """Read what a model file says of itself: architecture, config, training.

    Raises:
        ModelError: the file is missing, damaged, or of another program.
    """
    return read_tensors(path, "np", only_description=True)[1]


def read_model_file(path: Path) -> tuple[dict[str, NDArray[np.float32]], dict[str, Any]]:
    """Read the weights of a model file and what it says of itself.

    Raises:
        ModelError: the file is missing, damaged, of another program, or holds weights that are no usable numbers.
    """
    arrays, description = read_tensors(path, "np")
    for name, values in arrays.items():
        if values.dtype != np.float32:
            raise ModelError(f"{path}: {name} is of type {values.dtype}, not float32; train the model again")
        if not (np.abs(values) <= LARGEST_WEIGHT).all():  # NaN compares as false
            raise ModelError(f"{path}: {name} is NaN, infinite or beyond {LARGEST_WEIGHT:g}; train the model again")
    return arrays, description


def read_tensors(
    path: Path, framework: Literal["np", "pt"], *, only_description: bool = False
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read the tensors of a file that jetnormal wrote, and what it says of itself.

    Args:
        path: the file.
        framework: whose arrays to make: NumPy's or PyTorch's.
        only_description: whether to leave the tensors on the disk.

    Raises:
        ModelError: the file is missing, not readable, damaged, or of another program.
    """
    _check_readable(path)
    try:
        with safe_open(path, framework=framework) as file:
            text = file.metadata() or {}
            if text.get("format") != FORMAT:
                raise ModelError(f"{path}: not a model of jetnormal; train one with `jetnormal train`")
            names = () if only_description else file.keys()
            return {name: file.get_tensor(name) for name in names}, dict(json.loads(text["description"]))
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise ModelError(f"{path}: damaged or not a safetensors file ({error})") from error


def _check_readable(path: Path) -> None:
    """Refuse a file that cannot be opened; safetensors calls all of them missing."""
    try:
        if not path.is_file():
            raise ModelError(f"{path}: no such model file")
        path.open("rb").close()
    except OSError as error:
        raise ModelError(f"{path}: cannot be read ({error.strerror or error}); check the path") from error
