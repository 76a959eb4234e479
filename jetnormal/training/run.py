"""A training run on disk, and what it takes to go on with it.

RUN/config.toml            everything that made the run, as a recipe
RUN/model.safetensors      the network so far, or its average, usable with `jetnormal estimate --model`
RUN/state.safetensors      all that a resumed run needs besides
RUN/metrics.csv            one row an epoch
RUN/events.out.tfevents.*  the same for TensorBoard, where it is asked for
RUN/.lock                  held while a process trains
"""

from __future__ import annotations

import dataclasses
import json
import math
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from filelock import FileLock, Timeout
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.formats.atomic import atomic_write, make_folder
from jetnormal.networks.checkpoint import load_tensors, save_model, save_tensors
from jetnormal.networks.packaged import resolve
from jetnormal.support.report import logger
from jetnormal.training.events import EventLog
from jetnormal.training.metrics import Metrics
from jetnormal.training.options import EXTENDABLE

if TYPE_CHECKING:
    from jetnormal.networks.checkpoint import Network

CONFIG_NAME, METRICS_NAME = "config.toml", "metrics.csv"
SAVE_INTERVAL = 45.0  # seconds: what a killed run loses at most


@dataclass
class Position:
    """Where a run stands.

    Attributes:
        epoch: epochs completed.
        batch: batches of the next epoch that are done.
        samples: normals learned from so far.
        seconds: spent so far.
        totals: sums of the loss terms over the batches of the epoch under way.
    """

    epoch: int = 0
    batch: int = 0
    samples: int = 0
    seconds: float = 0.0
    totals: dict[str, float] = field(default_factory=dict)

    def count(self, terms: dict[str, float], samples: int, seconds: float) -> None:
        """Move on by a batch."""
        for name, value in terms.items():
            self.totals[name] = self.totals.get(name, 0.0) + value
        self.batch += 1
        self.samples += samples
        self.seconds += seconds

    def finish_epoch(self) -> dict[str, float]:
        """Move on to the next epoch; return the means of the loss terms over the one that ends."""
        means = {name: value / self.batch for name, value in self.totals.items()}
        self.epoch, self.batch, self.totals = self.epoch + 1, 0, {}
        return means


class Run:
    """A network, its optimizer, its average and its position, tied to a folder; a context that unlocks the folder.

    Args:
        folder: of the run, created if need be.
        facts: all that decides on the result; a run is only resumed with the same facts.
        network: to be trained.
        optimizer: of the network's parameters.
        average: decay, per step, of the exponential moving average of the weights; 0 for none.
        tensorboard: whether to write TensorBoard events.
        save_interval: seconds from one save to the next within an epoch.

    Raises:
        ResourceError: TensorBoard is asked for and not installed.
    """

    def __init__(
        self,
        folder: Path,
        facts: dict[str, Any],
        network: Network,
        optimizer: torch.optim.Optimizer,
        average: float = 0.0,
        tensorboard: bool = False,
        save_interval: float = SAVE_INTERVAL,
    ) -> None:
        self.folder = folder
        self.facts = json.loads(json.dumps(facts))  # as they come back from a file
        self.network = network
        self.optimizer = optimizer
        self.position = Position()
        self.metrics = Metrics(folder / METRICS_NAME)
        self._average = _averaged(network, average) if average else None
        self._saved = time.monotonic()
        self._save_interval = save_interval
        self._events = EventLog(folder) if tensorboard else None
        self._lock = FileLock(folder / ".lock", timeout=0)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        self._lock.release()

    @property
    def result(self) -> Network:
        """The network that is validated and saved: the average of the weights, if there is one."""
        return self.network if self._average is None else cast("Network", self._average.module)

    def update_average(self) -> None:
        """Move the average, if there is one, towards the weights; the first update copies them."""
        if self._average is not None:
            self._average.update_parameters(self.network)

    @property
    def model_path(self) -> Path:
        return self.folder / "model.safetensors"

    @property
    def _state_path(self) -> Path:
        return self.folder / "state.safetensors"

    def begin(self, config: str, initial: str = "") -> None:
        """Prepare the folder for a new run, which may start from another model's weights.

        Args:
            config: the text of config.toml.
            initial: name or file of that model: what both networks have by the same name and shape is taken over.

        Raises:
            InputError: the folder holds a run already, or files that this one would overwrite, another process trains
                in it, or it cannot be created.
            ModelError: there is no such model, or it shares nothing with this network.
        """
        self._check_free(config)
        if initial:
            self._take_over(resolve(initial))
        make_folder(self.folder)
        self._acquire()
        self._check_free(config)  # once more: another process may have trained here in the meantime
        self.metrics.clear()
        with atomic_write(self.folder / CONFIG_NAME, overwrite=True) as stream:
            stream.write(config.encode())

    def _check_free(self, config: str) -> None:
        """Refuse a folder with files that the run would overwrite, but for what it left itself before its first save.

        Raises:
            InputError: there are such files, or there is a run.
        """
        if self._state_path.exists():
            raise InputError(
                f"{self.folder}: holds a run already; `resume` goes on with it, another folder starts a new one"
            )
        recipe = self.folder / CONFIG_NAME
        if recipe.is_file() and recipe.read_bytes() == config.encode():
            return
        for path in (recipe, self.model_path, self.folder / METRICS_NAME):
            if path.exists():
                raise InputError(f"{path}: would be overwritten; choose another folder for the run")

    def resume(self, config: str, epochs: int) -> None:
        """Go back to the last saved state.

        Args:
            config: the text of config.toml from now on.
            epochs: that the run shall have.

        Raises:
            InputError: there is none, or another process trains in the folder.
            ModelError: it is damaged.
            UsageError: the run began with other options, or has more epochs already.
        """
        if not self._state_path.is_file():
            raise InputError(f"{self.folder}: there is no run to resume; start one")
        self._acquire()
        tensors, description = load_tensors(self._state_path)
        if "facts" not in description:
            raise ModelError(f"{self._state_path}: is not the state of a run; start a new one")
        changed = _differences(description["facts"], self.facts)
        if changed:
            raise UsageError(f"{self.folder}: the run began with other options ({', '.join(changed)})")
        try:
            self._restore(tensors, description["position"])
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ModelError(f"{self._state_path}: damaged ({reason}); start the run anew in another folder") from error
        if self.position.epoch > epochs:
            raise UsageError(
                f"{self.folder}: the run has {self.position.epoch} epochs already, more than `epochs={epochs}`; "
                "ask for more, or leave `epochs` out"
            )
        self.metrics.keep(self.position.epoch)
        with atomic_write(self.folder / CONFIG_NAME, overwrite=True) as stream:
            stream.write(config.encode())

    def _acquire(self) -> None:
        """Keep other processes out of the folder; the system lets them in again whichever way this one ends."""
        try:
            self._lock.acquire()
        except Timeout:
            raise InputError(f"{self.folder}: another process trains here; wait for it or end it") from None

    def _restore(self, tensors: dict[str, Tensor], position: dict[str, Any]) -> None:
        self.position = Position(**position)
        self.network.load_state_dict(_part(tensors, "network."))
        if self._average is not None:
            self._average.load_state_dict(_part(tensors, "average."))
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in _part(tensors, "optimizer.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": state, "param_groups": groups})

    def save_if_due(self) -> None:
        """Save if the last save is longer ago than the interval."""
        if time.monotonic() - self._saved >= self._save_interval:
            self.save()

    def save(self) -> None:
        """Write the network on its own and the state, each atomically; the state last, for a resumed run trusts it."""
        training = self.facts | {"samples": self.position.samples}  # nothing else: the same run gives the same bytes
        if "rmse" in (last := self.metrics.last()):
            training["rmse"] = last["rmse"]
        save_model(self.model_path, self.result, training)
        tensors = _named("network.", self.network.state_dict())
        for index, values in self.optimizer.state_dict()["state"].items():
            tensors |= _named(f"optimizer.{index}.", values)
        if self._average is not None:
            tensors |= _named("average.", self._average.state_dict())
        description = {"facts": self.facts, "position": dataclasses.asdict(self.position)}
        save_tensors(self._state_path, tensors, description)
        self._saved = time.monotonic()

    def record(self, row: dict[str, float]) -> None:
        """Append an epoch's metrics to the table and to the events; what is not a number is left out."""
        self.metrics.append(row)
        if self._events:
            self._events.record({name: value for name, value in row.items() if not math.isnan(value)})

    def _take_over(self, path: Path) -> None:
        """Copy the weights of a model file that fit into this network."""
        own = self.network.state_dict()
        found = load_tensors(path)[0]
        fitting = {name: value for name, value in found.items() if name in own and own[name].shape == value.shape}
        if not fitting:
            raise ModelError(f"{path}: shares no weights with this network; start from a model of its kind")
        self.network.load_state_dict(own | fitting)
        logger.info("starting from %s: %d of %d tensors fit", path, len(fitting), len(own))


def _averaged(network: Network, decay: float) -> AveragedModel:
    """A copy of a network, statistics of its normalizations included, that follows it."""
    return AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(decay), use_buffers=True)


def _named(prefix: str, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Tensors with a prefix before their names."""
    return {f"{prefix}{name}": value for name, value in tensors.items()}


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names start with the prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names of the entries, at any depth, that differ; those that one version of the program lacks do not."""
    names = []
    for key in (before.keys() & now.keys()) - set(EXTENDABLE):
        old, new = before[key], now[key]
        if isinstance(old, dict) and isinstance(new, dict):
            names += _differences(old, new)
        elif old != new:
            names.append(f"{key} was {old}")
    return sorted(names)
