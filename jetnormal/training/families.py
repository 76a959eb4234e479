"""The kinds of networks that can be trained: of each its configuration, its options and its task."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jetnormal.errors import UsageError
from jetnormal.support.device import resolve_device, torch_threads, worker_pool
from jetnormal.support.options import OptionSet
from jetnormal.support.suggest import did_you_mean
from jetnormal.training.options import CloudTraining, IterTraining, LossWeights, PatchTraining, TrainOptions
from jetnormal.training.trainer import Task

if TYPE_CHECKING:
    from jetnormal.networks.nestinet import NestiNetConfig
    from jetnormal.networks.pcpnet import PCPNetConfig


@dataclass(frozen=True)
class Family:
    """A kind of networks; its name is the architecture in their model files.

    Attributes:
        config: dataclass of the table [network] of a recipe.
        training: dataclass of the table [training].
        losses: dataclass of the table [losses]; None if there is no such table.
        task: makes what is learned, from a configuration, options, losses, a device and a number of threads, and
            ends its threads.
    """

    config: type
    training: type[TrainOptions]
    losses: type[OptionSet] | None
    task: Callable[[Any, Any, Any, str, int | None], AbstractContextManager[Task[Any]]]


def family(name: str) -> Family:
    """Find a kind of networks by its name, such as "patchfit" or "cloudfit".

    Raises:
        UsageError: there is none.
    """
    if name not in _FAMILIES:
        raise UsageError(f"family is one of {', '.join(_FAMILIES)}, not {name!r}{did_you_mean(str(name), _FAMILIES)}")
    return _FAMILIES[name]()


def _patchfit() -> Family:
    from jetnormal.networks.patchfit.network import PatchFitConfig
    from jetnormal.training.patch_task import PatchTask

    @contextmanager
    def task(
        config: PatchFitConfig, options: PatchTraining, losses: LossWeights, device: str, threads: int | None
    ) -> Iterator[Task[Any]]:
        if options.batch_size < 2:
            raise UsageError("the batch size is 2 or more: patch networks normalize over a batch")
        with torch_threads(threads):
            yield PatchTask(config, options, losses, resolve_device(device))

    return Family(PatchFitConfig, PatchTraining, LossWeights, task)


def _cloudfit() -> Family:
    from jetnormal.networks.cloudfit.config import CloudFitConfig
    from jetnormal.training.cloud_task import CloudTask

    @contextmanager
    def task(
        config: CloudFitConfig, options: CloudTraining, _: None, device: str, threads: int | None
    ) -> Iterator[Task[Any]]:
        with worker_pool(threads) as pool:
            yield CloudTask(config, options, pool, resolve_device(device))

    return Family(CloudFitConfig, CloudTraining, None, task)


def _iternet() -> Family:
    from jetnormal.networks.iternet import IterNetConfig
    from jetnormal.training.iter_task import IterTask

    @contextmanager
    def task(
        config: IterNetConfig, options: IterTraining, _: None, device: str, threads: int | None
    ) -> Iterator[Task[Any]]:
        if device not in ("auto", "cpu"):
            raise UsageError(f"iternet trains on the CPU, not on {device}")
        with worker_pool(threads) as pool:
            yield IterTask(config, options, pool)

    return Family(IterNetConfig, IterTraining, None, task)


def _balls(config: type) -> Family:
    from jetnormal.training.ball_task import BallTask

    @contextmanager
    def task(
        config: PCPNetConfig | NestiNetConfig, options: PatchTraining, _: None, device: str, threads: int | None
    ) -> Iterator[Task[Any]]:
        if options.batch_size < 2:
            raise UsageError("the batch size is 2 or more: networks on balls normalize over a batch")
        with torch_threads(threads):
            yield BallTask(config, options, resolve_device(device))

    return Family(config, PatchTraining, None, task)


def _pcpnet() -> Family:
    from jetnormal.networks.pcpnet import PCPNetConfig

    return _balls(PCPNetConfig)


def _nestinet() -> Family:
    from jetnormal.networks.nestinet import NestiNetConfig

    return _balls(NestiNetConfig)


_FAMILIES = {
    "patchfit": _patchfit,
    "cloudfit": _cloudfit,
    "iternet": _iternet,
    "pcpnet": _pcpnet,
    "nestinet": _nestinet,
}
