"""A training run on disk, and what it takes to go on with it.

RUN/model.safetensors      the network so far, usable with `jetnormal estimate --model`
RUN/state.safetensors      all that a resumed run needs
RUN/metrics.csv            one row an epoch
RUN/events.out.tfevents.*  the same for TensorBoard, where it is asked for
"""

from __future__ import annotations

import csv
import dataclasses
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.formats.atomic import atomic_write
from jetnormal.networks.checkpoint import load_tensors, save_model, save_tensors
from jetnormal.networks.packaged import resolve
from jetnormal.support.report import logger
from jetnormal.training.events import EventLog

if TYPE_CHECKING:
    from jetnormal.networks.checkpoint import Network

SAVE_INTERVAL = 45.0  # seconds: what a killed run loses at most


@dataclass
class Position:
    """Where a run stands.

    Attributes:
        epoch: epochs completed.
        batch: batches of the next epoch that are done.
        patches: trained on so far.
        seconds: spent so far.
        totals: sums of the loss terms over the batches of the epoch under way.
    """

    epoch: int = 0
    batch: int = 0
    patches: int = 0
    seconds: float = 0.0
    totals: dict[str, float] = field(default_factory=dict)


class Run:
    """A network, its optimizer and its position, tied to a folder.

    Args:
        folder: of the run, created if need be.
        facts: the network's configuration and the options that decide the result; a run is only resumed with the
            same facts.
        network: to be trained.
        optimizer: of the network's parameters.
        tensorboard: whether to write TensorBoard events.

    Raises:
        UsageError: if TensorBoard is asked for and not installed.
    """

    def __init__(
        self,
        folder: Path,
        facts: dict[str, Any],
        network: Network,
        optimizer: torch.optim.Optimizer,
        tensorboard: bool = False,
    ) -> None:
        self.folder = folder
        self.facts = facts
        self.network = network
        self.optimizer = optimizer
        self.position = Position()
        self._saved = time.monotonic()
        self._events = EventLog(folder) if tensorboard else None

    @property
    def model_path(self) -> Path:
        return self.folder / "model.safetensors"

    @property
    def _state_path(self) -> Path:
        return self.folder / "state.safetensors"

    @property
    def _metrics_path(self) -> Path:
        return self.folder / "metrics.csv"

    def begin(self, initial: str = "") -> None:
        """Prepares the folder for a new run, which may start from another model's weights.

        Args:
            initial: name or file of that model: what both networks have by the same name and shape is taken over.

        Raises:
            InputError: if the folder holds a run already or cannot be created.
            ModelError: if there is no such model, or it shares nothing with this network.
        """
        if self._state_path.exists():
            raise InputError(f"{self.folder}: holds a run already; go on with --resume or choose another --out")
        if initial:
            self._take_over(resolve(initial))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be created ({error.strerror}); choose another --out") from error
        self._metrics_path.unlink(missing_ok=True)

    def resume(self) -> None:
        """Goes back to the last saved state.

        Raises:
            InputError: if there is none.
            ModelError: if it is damaged.
            UsageError: if the run began with other options.
        """
        if not self._state_path.is_file():
            raise InputError(f"{self.folder}: there is no run to resume; leave --resume out to start one")
        tensors, description = load_tensors(self._state_path)
        if "facts" not in description:
            raise ModelError(f"{self._state_path}: is not the state of a run; start one without --resume")
        changed = _differences(description["facts"], self.facts)
        if changed:
            raise UsageError(f"{self.folder}: the run began with other options ({', '.join(changed)})")
        try:
            self.position = Position(**description["position"])
            self.network.load_state_dict(_part(tensors, "network."))
            self._restore_optimizer(tensors)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0]
            raise ModelError(f"{self._state_path}: damaged ({reason}); start the run anew in another folder") from error
        self._drop_metrics_after(self.position.epoch)

    def save_if_due(self) -> None:
        """Saves if the last save is more than SAVE_INTERVAL ago."""
        if time.monotonic() - self._saved > SAVE_INTERVAL:
            self.save()

    def save(self) -> None:
        """Writes the network on its own and the state, each atomically; the state last, for a resumed run trusts it."""
        training = self.facts | {"patches": self.position.patches, "seconds": round(self.position.seconds)}
        if "rmse" in (last := self.last_record()):
            training["rmse"] = last["rmse"]
        save_model(self.model_path, self.network, training)
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        for index, values in self.optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer.{index}.{name}": value for name, value in values.items()}
        description = {"facts": self.facts, "position": dataclasses.asdict(self.position)}
        save_tensors(self._state_path, tensors, description)
        self._saved = time.monotonic()

    def record(self, row: dict[str, float]) -> None:
        """Appends an epoch's metrics to the table."""
        columns = list(self.last_record() or row)  # a resumed run has its terms in another order
        with self._metrics_path.open("a", newline="") as stream:
            writer = csv.DictWriter(stream, columns, lineterminator="\n")
            if stream.tell() == 0:
                writer.writeheader()
            writer.writerow({name: value if isinstance(value, int) else f"{value:.6g}" for name, value in row.items()})
        if self._events:
            self._events.record(row)

    def last_record(self) -> dict[str, float]:
        """The metrics of the last epoch; empty before the first."""
        if not self._metrics_path.exists():
            return {}
        with self._metrics_path.open(newline="") as stream:
            *_, last = [{}, *csv.DictReader(stream)]
        return {name: int(value) if value.isdigit() else float(value) for name, value in last.items()}

    def _take_over(self, path: Path) -> None:
        """Copies the weights of a model file that fit into this network."""
        own = self.network.state_dict()
        found = load_tensors(path)[0]
        fitting = {name: value for name, value in found.items() if name in own and own[name].shape == value.shape}
        if not fitting:
            raise ModelError(f"{path}: shares no weights with this network; start from a model of its kind")
        self.network.load_state_dict(own | fitting)
        logger.info("starting from %s: %d of %d tensors fit", path, len(fitting), len(own))

    def _restore_optimizer(self, tensors: dict[str, Tensor]) -> None:
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in _part(tensors, "optimizer.").items():
            index, key = name.split(".", 1)
            state.setdefault(int(index), {})[key] = value
        groups = self.optimizer.state_dict()["param_groups"]
        self.optimizer.load_state_dict({"state": state, "param_groups": groups})

    def _drop_metrics_after(self, epoch: int) -> None:
        """Removes the rows of epochs that the resumed run will do again."""
        if self._metrics_path.exists():
            lines = self._metrics_path.read_text().splitlines(keepends=True)
            with atomic_write(self._metrics_path, overwrite=True) as stream:
                stream.write("".join(lines[: epoch + 1]).encode())  # a header and a row an epoch


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """The tensors whose names start with the prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def _differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Names of the entries, at any depth, that differ; those that one version of the program lacks do not."""
    names = []
    for key in before.keys() & now.keys():
        old, new = before[key], now[key]
        if isinstance(old, dict) and isinstance(new, dict):
            names += _differences(old, new)
        elif old != new:
            names.append(f"{key} was {old}")
    return sorted(names)
