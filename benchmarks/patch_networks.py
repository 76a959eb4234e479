"""The forward pass of each patch network beside the time of its matrix products alone, and points per second.

    python benchmarks/patch_networks.py [--config paper] [--model deepfit ...] [--points 2000] [--repeats 7]

The floor is the sum, over all matrix products of one forward pass, of the fastest of several runs of each product on
its own, with its operands in the cache. Forward pass and floor run on one core, in CPU seconds, with a batch of the
size that estimation uses. The last column is the whole estimation of --points points of a cloud, on all cores,
neighbor search included. Weights are random, as the time does not depend on them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from jetnormal.estimators.patchwise import network_estimator
from jetnormal.networks.patchfit.network import CONFIGS, PatchFit

PRODUCTS = {"aten::addmm", "aten::baddbmm", "aten::bmm", "aten::linear", "aten::matmul", "aten::mm"}


class Recorder(TorchDispatchMode):
    """The matrix products of a forward pass, ready to run again."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[Callable[[], Any]] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if function.name() in PRODUCTS:
            self.products.append(lambda: function(*args, **kwargs))
        return function(*args, **kwargs)


def fastest(function: Callable[[], Any], repeats: int, clock: Callable[[], float] = time.thread_time) -> float:
    """Seconds of the fastest of several runs, by `clock`."""
    seconds = []
    for _ in range(repeats):
        start = clock()
        function()
        seconds.append(clock() - start)
    return min(seconds)


def forward_and_floor(network: PatchFit, batch: int, repeats: int) -> tuple[float, float]:
    """Seconds a patch on one core: of the forward pass, and of its matrix products."""
    points = patches(batch, network.config.neighbors)
    network(points)
    with Recorder() as recorder:
        network(points)
    floor = sum(fastest(product, repeats) for product in recorder.products)
    return fastest(lambda: network(points), repeats) / batch, floor / batch


def patches(batch: int, count: int) -> torch.Tensor:
    """(batch, count, 3) bent sheets with a little noise, ordered by distance from the first point."""
    rng = np.random.default_rng(1)
    xy = rng.uniform(-0.7, 0.7, (batch, count, 2))
    xy[:, 0] = 0
    z = 0.2 * xy[..., :1] ** 2 - 0.3 * xy[..., 1:] ** 2 + 0.01 * rng.normal(size=(batch, count, 1))
    points = np.concatenate([xy, z], axis=2)
    order = np.linalg.norm(points - points[:, :1], axis=2).argsort(1)
    return torch.from_numpy(np.take_along_axis(points, order[..., None], 1)).float()


def points_per_second(network: PatchFit, points: int) -> float:
    """Of the whole estimation, on all cores."""
    estimator = network_estimator("network", network)
    cloud = patches(1, 20_000)[0].double().numpy()
    queries = np.random.default_rng(1).permutation(len(cloud))[:points]
    estimator(cloud, queries[:64])
    return points / fastest(lambda: estimator(cloud, queries), 1, time.perf_counter)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", choices=CONFIGS, default="paper")
    parser.add_argument("--model", action="append", choices=CONFIGS["paper"], help="repeatable; the default is all")
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--batch", type=int, help="patches at a time instead of what estimation takes")
    parser.add_argument("--bfloat16", action="store_true", help="forward pass and floor in bfloat16")
    arguments = parser.parse_args()
    print("| model | batch | ms/point | floor | ratio | points/s, all cores |\n|---|---|---|---|---|---|")
    for model in arguments.model or CONFIGS[arguments.config]:
        torch.manual_seed(1)
        network = PatchFit(CONFIGS[arguments.config][model]).for_inference()
        batch = arguments.batch or network_estimator(model, network).batch_size
        cores = torch.get_num_threads()
        torch.set_num_threads(1)
        with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16, enabled=arguments.bfloat16):
            forward, floor = forward_and_floor(network, batch, arguments.repeats)
        torch.set_num_threads(cores)
        rate = points_per_second(network, arguments.points)
        print(
            f"| {model} | {batch} | {1e3 * forward:.2f} | {1e3 * floor:.2f} | {forward / floor:.2f} | {rate:,.0f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
