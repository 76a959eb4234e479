"""What networks cost: parameters, bytes, operations, time; of model files and of the configurations of the paper."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.flop_counter import FlopCounterMode

from jetnormal.estimators.base import Estimator
from jetnormal.estimators.patchwise import make_estimator, network_estimator
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.checkpoint import load_model, load_tensors, packaged_names, resolve
from jetnormal.networks.cloudfit.network import CloudFit
from jetnormal.networks.patchfit.network import CONFIGS, PatchFit, PatchFitConfig, parameter_count
from jetnormal.support.device import resolve_device, torch_threads

CLOUD_POINTS = 20_000  # of the procedural solid that speed is measured on
TIMED_PATCHES = 512
TITLES = {"deepfit": "DeepFit", "adafit": "AdaFit", "graphfit": "GraphFit"}
_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")  # tensors of a file that are no parameters


@dataclass(frozen=True)
class Complexity:
    """What a network costs.

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
    """The complexity of a packaged model or a model file.

    Raises:
        ModelError: there is no such model, or its file is damaged.
        ResourceError: the device is not there.
    """
    path = resolve(name)
    network = load_model(path)
    tensors, metadata = load_tensors(path)
    timed = TIMED_PATCHES if isinstance(network, PatchFit) else None  # any other looks at the whole cloud at once
    estimator = make_estimator(str(path), device=device, threads=threads)
    return Complexity(
        name=name,
        architecture=describe(network.config) if isinstance(network, PatchFit) else metadata["architecture"],
        parameters=sum(t.numel() for key, t in tensors.items() if not key.endswith(_STATISTICS)),
        megabytes=path.stat().st_size / 1e6,
        gflop_per_point=gflop_per_patch(network) if isinstance(network, PatchFit) else gflop_of_cloud(network),
        ms_per_point=ms_per_point(estimator, timed) if measure else None,
        rmse=metadata.get("training", {}).get("rmse"),
    )


def of_packaged(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """The complexity of every packaged model."""
    return [of_model(name, measure=measure, device=device, threads=threads) for name in packaged_names()]


def of_paper(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """The paper's table of complexities: three baselines, and the same with its two additions, with random weights.

    Raises:
        ResourceError: the device is not there.
    """
    device = resolve_device(device)
    return [_of_config(name, config, measure, device, threads) for name, config in paper_configurations()]


def paper_configurations() -> Iterator[tuple[str, PatchFitConfig]]:
    """Names and configurations of the paper's six networks, baselines first."""
    for weights, config in CONFIGS["paper"].items():
        yield TITLES[weights], replace(config, transform="qstn", correction=False)
    for weights, config in CONFIGS["paper"].items():
        yield f"{TITLES[weights]} + both", config


def _of_config(name: str, config: PatchFitConfig, measure: bool, device: str, threads: int | None) -> Complexity:
    torch.manual_seed(1)
    network = PatchFit(config)
    parameters = parameter_count(network)
    size = sum(t.numel() * t.element_size() for t in network.state_dict().values())
    network.for_inference()
    gflop = gflop_per_patch(network)
    milliseconds = None
    if measure:
        milliseconds = ms_per_point(network_estimator(name, network, device=device, threads=threads), TIMED_PATCHES)
    return Complexity(name, describe(config), parameters, size / 1e6, gflop, milliseconds)


def describe(config: PatchFitConfig) -> str:
    """A configuration in words."""
    parts = [TITLES[config.weights]]
    parts += ["z-transform"] if config.transform == "ztransform" else []
    parts += ["correction"] if config.correction else []
    width = f", {config.width:g} of the channels" if config.width != 1 else ""
    return f"{' + '.join(parts)}, {config.neighbors} neighbors, order {config.order}{width}"


def gflop_per_patch(network: PatchFit) -> float:
    """10^9 floating point operations in the matrix products of one patch, as they are executed."""
    points = torch.rand(1, network.config.neighbors, 3, generator=torch.Generator().manual_seed(1)) - 0.5
    return _products(lambda: network(points.to(next(network.parameters()).device)))


def gflop_of_cloud(network: CloudFit) -> float:
    """10^9 floating point operations a point in the matrix products of a whole cloud, as they are executed.

    The compiled loops over edges are not counted.
    """
    points = _solid(np.random.default_rng(1))
    pyramid = build_pyramid(points - points.mean(axis=0), len(network.config.channels))
    return _products(lambda: network.fit(network.encode(pyramid), torch.arange(len(points)))) / len(points)


def _products(work: Callable[[], object]) -> float:
    """10^9 operations in the matrix products of some work, on one thread, since the counter sees no other."""
    with torch.inference_mode(), torch_threads(1), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() / 1e9


def ms_per_point(estimator: Estimator, queries: int | None) -> float:
    """Milliseconds a point takes on a procedural solid with a little noise.

    Args:
        estimator: to be measured.
        queries: points to estimate; None for the whole cloud.
    """
    rng = np.random.default_rng(1)
    points = _solid(rng)
    chosen = rng.permutation(CLOUD_POINTS)[: queries or CLOUD_POINTS]
    estimator(points, chosen[:16])  # imports and warm-up
    start = time.perf_counter()
    estimator(points, None if queries is None else chosen)
    return 1e3 * (time.perf_counter() - start) / len(chosen)


def _solid(rng: np.random.Generator) -> NDArray[np.float64]:
    """Points of a procedural solid with a little noise."""
    from jetnormal.data.corruption import add_noise
    from jetnormal.data.solids.recipes import random_solid

    return add_noise(random_solid(rng).sample(CLOUD_POINTS, rng)[0], 2.5e-3, rng)
