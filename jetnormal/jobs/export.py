"""Export of a patch network as ONNX, for programs without PyTorch."""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from jetnormal.errors import ModelError, UsageError
from jetnormal.formats import atomic
from jetnormal.networks.checkpoint import load_model
from jetnormal.networks.patchfit.network import PatchFit
from jetnormal.support.extras import require

SUFFIX = ".onnx"
OPSET = 17
TRACED = 4  # patches in the batch that is traced; the graph takes any number


class _Normals(nn.Module):
    """A patch network that returns its normals alone: refined and rough, (B, 3) each."""

    def __init__(self, network: PatchFit) -> None:
        super().__init__()
        self.network = network

    def forward(self, patches: Tensor) -> tuple[Tensor, Tensor]:
        prediction = self.network(patches)
        return prediction.refined, prediction.rough


def export_model(name: str, target: Path, *, overwrite: bool = False) -> dict[str, Any]:
    """Write a patch network as an ONNX file.

    The graph has the input `patches`, (B, k, 3) float32: each the k nearest points of a query, by ascending distance
    and the query first, in the frame of `geometry.patches.build_patches`. The outputs `normals` and `rough`, (B, 3),
    are the unit normals with and without the learned correction, in the same frame and with arbitrary signs.

    Args:
        name: a packaged patch network, or a model file.
        target: the file to write, .onnx.
        overwrite: whether an existing file is replaced.

    Returns:
        A summary: model, output, neighbors (k), opset, bytes.

    Raises:
        UsageError: the suffix is not .onnx.
        ModelError: there is no such model, or it is not a patch network.
        InputError: the file cannot be written.
        ResourceError: the package onnx is not installed.
    """
    if target.suffix.lower() != SUFFIX:
        raise UsageError(f"{target}: name the file {SUFFIX}")
    atomic.check_target(target, overwrite)
    network = load_model(name)
    if not isinstance(network, PatchFit):
        raise ModelError(f"{name}: its architecture is {network.architecture}; only patch networks can be exported")
    graph = _traced(network)
    with atomic.atomic_write(target, overwrite=overwrite) as stream:
        stream.write(graph)
    facts = {"neighbors": network.config.neighbors, "opset": OPSET, "bytes": len(graph)}
    return {"model": str(name), "output": str(target), **facts}


def _traced(network: PatchFit) -> bytes:
    require("onnx", "an ONNX file")  # the exporter needs it, but says so less clearly
    patches = torch.randn(TRACED, network.config.neighbors, 3, generator=torch.Generator().manual_seed(0))
    names = ["patches", "normals", "rough"]
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        path = Path(folder, "model.onnx")
        warnings.simplefilter("ignore")  # constants that are meant, and the age of this exporter
        torch.onnx.export(
            _Normals(network),
            (patches,),
            path,
            dynamo=False,  # the newer one needs a package more
            opset_version=OPSET,
            input_names=names[:1],
            output_names=names[1:],
            dynamic_axes={name: {0: "patches_in_batch"} for name in names},
        )
        return path.read_bytes()
