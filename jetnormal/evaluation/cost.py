"""The cost of networks (parameters, bytes, operations, time): of model files and of the paper's configurations."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from jetnormal.estimators.base import Estimator
from jetnormal.estimators.factory import make_estimator, network_estimator, runs_on_gpu
from jetnormal.geometry.pyramid import NEIGHBORS
from jetnormal.networks.checkpoint import build_network, load_tensors
from jetnormal.networks.iternet import IterNetConfig
from jetnormal.networks.nestinet import NestiNetConfig
from jetnormal.networks.packaged import packaged_names, resolve
from jetnormal.networks.patchfit.network import CONFIGS, PatchFitConfig, parameter_count
from jetnormal.networks.pcpnet import PCPNetConfig

CLOUD_POINTS = 20_000  # of the procedural solid that speed is measured on
TIMED_POINTS = (32, 512)  # at least and at most, by networks that look at points one by one
TIMED_GFLOP = 1000.0  # about
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
    gflop = estimator.cost(_solid(np.random.default_rng(1)))
    return Complexity(
        name=name,
        architecture=describe(metadata["architecture"], metadata["config"]),
        parameters=sum(t.numel() for key, t in tensors.items() if not key.endswith(_STATISTICS)),
        megabytes=path.stat().st_size / 1e6,
        gflop_per_point=gflop,
        ms_per_point=ms_per_point(estimator, gflop) if measure else None,
        rmse=metadata.get("training", {}).get("rmse"),
    )


def of_packaged(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """Measure the complexity of every packaged model."""
    return [of_model(name, measure=measure, device=device, threads=threads) for name in packaged_names()]


def of_paper(*, measure: bool = False, device: str = "auto", threads: int | None = None) -> list[Complexity]:
    """Measure the paper's table of complexities, what else it compares with, and CloudFit; random weights.

    Raises:
        ResourceError: the device is not there.
    """
    rows = [_of_config(*row, measure, device, threads) for row in paper_configurations()]
    return [*rows, replace(of_model("cloudfit", measure=measure, threads=threads), name="CloudFit", rmse=None)]


def paper_configurations() -> Iterator[tuple[str, str, Any]]:
    """List names, architectures and configurations of the networks that the paper compares, its own last."""
    yield "PCPNet", "pcpnet", PCPNetConfig()
    yield "Nesti-Net", "nestinet", NestiNetConfig()
    yield "IterNet", "iternet", IterNetConfig()
    for weights, config in CONFIGS["paper"].items():
        yield TITLES[weights], "patchfit", replace(config, transform="qstn", correction=False)
    for weights, config in CONFIGS["paper"].items():
        yield f"{TITLES[weights]} + both", "patchfit", config


def _of_config(
    name: str, architecture: str, config: Any, measure: bool, device: str, threads: int | None
) -> Complexity:
    torch.manual_seed(1)
    network = build_network(architecture, asdict(config))
    parameters = parameter_count(network)
    size = sum(t.numel() * t.element_size() for t in network.state_dict().values())
    chosen = device if runs_on_gpu(architecture) else "cpu"
    estimator = network_estimator(name, network.for_inference(), device=chosen, threads=threads)
    gflop = estimator.cost(_solid(np.random.default_rng(1)))
    milliseconds = ms_per_point(estimator, gflop) if measure else None
    return Complexity(name, describe(architecture, asdict(config)), parameters, size / 1e6, gflop, milliseconds)


def describe(architecture: str, config: dict[str, Any]) -> str:
    """Describe a network in words."""
    if architecture == "patchfit":
        return _describe_patchfit(PatchFitConfig(**config))
    if architecture == "cloudfit":
        return f"CloudFit, {len(config['channels'])} levels of {NEIGHBORS} neighbors"
    if architecture == "iternet":
        return f"IterNet, {config['neighbors']} neighbors, {config['iterations']} iterations"
    if architecture in ("pcpnet", "nestinet"):
        balls = len(config["radii"])
        width = f", {config['width']:g} of the channels" if config["width"] != 1 else ""
        name = {"pcpnet": "PCPNet", "nestinet": "Nesti-Net"}[architecture]
        return f"{name}, {balls} ball{'s' if balls > 1 else ''} of {config['points']} points{width}"
    return architecture


def _describe_patchfit(config: PatchFitConfig) -> str:
    parts = [TITLES[config.weights]]
    parts += ["z-transform"] if config.transform == "ztransform" else []
    parts += ["correction"] if config.correction else []
    width = f", {config.width:g} of the channels" if config.width != 1 else ""
    return f"{' + '.join(parts)}, {config.neighbors} neighbors, order {config.order}{width}"


def ms_per_point(estimator: Estimator, gflop_per_point: float) -> float:
    """Measure the milliseconds a point takes on a procedural solid with a little noise.

    Args:
        estimator: to measure, on all points if it looks at whole clouds, else on as many as take some seconds.
        gflop_per_point: its cost.
    """
    rng = np.random.default_rng(1)
    points = _solid(rng)
    few = int(np.clip(TIMED_GFLOP / gflop_per_point, *TIMED_POINTS)) if gflop_per_point else TIMED_POINTS[1]
    chosen = rng.permutation(CLOUD_POINTS)[: CLOUD_POINTS if estimator.whole_cloud else few]
    estimator(points, chosen[:16])  # imports and warm-up
    start = time.perf_counter()
    estimator(points, chosen)
    return 1e3 * (time.perf_counter() - start) / len(chosen)


def _solid(rng: np.random.Generator) -> NDArray[np.float64]:
    """Sample a procedural solid with a little noise."""
    from jetnormal.data.corruption import add_noise
    from jetnormal.data.solids.draw import random_solid

    return add_noise(random_solid(rng).sample(CLOUD_POINTS, rng)[0], 2.5e-3, rng)
