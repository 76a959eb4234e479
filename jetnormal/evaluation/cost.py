"""The cost of networks (parameters, bytes, operations, time): of model files and of the paper's configurations."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from jetnormal.estimators.base import Estimator
from jetnormal.estimators.factory import make_estimator
from jetnormal.estimators.patchwise import network_estimator
from jetnormal.networks.checkpoint import load_tensors
from jetnormal.networks.packaged import packaged_names, resolve
from jetnormal.networks.patchfit.network import CONFIGS, PatchFit, PatchFitConfig, parameter_count
from jetnormal.support.device import resolve_device

CLOUD_POINTS = 20_000  # of the procedural solid that speed is measured on
TIMED_PATCHES = 512
TITLES = {"deepfit": "DeepFit", "adafit": "AdaFit", "graphfit": "GraphFit"}
_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # tensors of a file that are no parameters


@dataclass(frozen=True)
class Complexity:
    """The cost of a network.

    Attributes:
        name: of the model, or of the configuration.
        architecture: in words.
        parameters: trained values.
        megabytes: of its file, 10^6 bytes.
        gflop_per_point: matrix products of one patch at inference, or of a cloud over its points, 10^9 operations, a
            multiply-add being two.
        ms_per_point: milliseconds of the whole estimation, neighbor search included; None unless measured.
        rmse: degrees, on the clouds that its training was validated on; None where the file does not say.
    """

    name: str
    architecture: str
    parameters: int
    megabytes: float
    gflop_per_point: float
    ms_per_point: float | None = None
    rmse: float | None = None


def of_model(name: str, *, measure: bool = False, device: str = "auto", threads: int | None = None) -> Complexity:
    """Measure the complexity of a packaged model or a model file.

    Raises:
        ModelError: there is no such model, or its file is damaged.
        ResourceError: the device is not there.
    """
    path = resolve(name)
    tensors, metadata = load_tensors(path)
    estimator = make_estimator(str(path), device=device, threads=threads)
    return Complexity(
        name=name,
        architecture=_in_words(metadata["architecture"], metadata["config"]),
        parameters=sum(t.numel() for key, t in tensors.items() if not key.endswith(_STATISTICS)),
        megabytes=path.stat().st_size / 1e6,
        gflop_per_point=estimator.cost(_solid(np.random.default_rng(1))),
        ms_per_point=ms_per_point(estimator) if measure else None,
        rmse=metadata.get("training", {}).get("rmse"),
    )


def of_packaged(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """Measure the complexity of every packaged model."""
    return [of_model(name, measure=measure, device=device, threads=threads) for name in packaged_names()]


def of_paper(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """Measure the paper's table of complexities: three baselines, and the same with both additions; random weights.

    Raises:
        ResourceError: the device is not there.
    """
    device = resolve_device(device)
    return [_of_config(name, config, measure, device, threads) for name, config in paper_configurations()]


def paper_configurations() -> Iterator[tuple[str, PatchFitConfig]]:
    """List names and configurations of the paper's six networks, baselines first."""
    for weights, config in CONFIGS["paper"].items():
        yield TITLES[weights], replace(config, transform="qstn", correction=False)
    for weights, config in CONFIGS["paper"].items():
        yield f"{TITLES[weights]} + both", config


def _of_config(name: str, config: PatchFitConfig, measure: bool, device: str, threads: int | None) -> Complexity:
    torch.manual_seed(1)
    network = PatchFit(config)
    parameters = parameter_count(network)
    size = sum(t.numel() * t.element_size() for t in network.state_dict().values())
    estimator = network_estimator(name, network.for_inference(), device=device, threads=threads)
    gflop = estimator.cost(_solid(np.random.default_rng(1)))
    milliseconds = ms_per_point(estimator) if measure else None
    return Complexity(name, describe(config), parameters, size / 1e6, gflop, milliseconds)


def _in_words(architecture: str, config: dict[str, Any]) -> str:
    return describe(PatchFitConfig(**config)) if architecture == PatchFit.architecture else architecture


def describe(config: PatchFitConfig) -> str:
    """Describe a configuration in words."""
    parts = [TITLES[config.weights]]
    parts += ["z-transform"] if config.transform == "ztransform" else []
    parts += ["correction"] if config.correction else []
    width = f", {config.width:g} of the channels" if config.width != 1 else ""
    return f"{' + '.join(parts)}, {config.neighbors} neighbors, order {config.order}{width}"


def ms_per_point(estimator: Estimator) -> float:
    """Measure the milliseconds a point takes on a procedural solid with a little noise."""
    rng = np.random.default_rng(1)
    points = _solid(rng)
    chosen = rng.permutation(CLOUD_POINTS)[: CLOUD_POINTS if estimator.whole_cloud else TIMED_PATCHES]
    estimator(points, chosen[:16])  # imports and warm-up
    start = time.perf_counter()
    estimator(points, chosen)
    return 1e3 * (time.perf_counter() - start) / len(chosen)


def _solid(rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample a procedural solid with a little noise."""
    from jetnormal.data.corruption import add_noise
    from jetnormal.data.solids.recipes import random_solid

    return add_noise(random_solid(rng).sample(CLOUD_POINTS, rng)[0], 2.5e-3, rng)
