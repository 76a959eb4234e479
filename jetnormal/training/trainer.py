"""The training of any network: steps of the optimizer, epochs, validation, resumable at any step.

What differs between kinds of networks is the task: how samples are drawn, what the loss is, how the network is
validated (`training.patch_task`, `training.cloud_task`).
"""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

import torch

from jetnormal.data.sources import DataSource
from jetnormal.errors import ModelError, UsageError
from jetnormal.support.report import logger, progress
from jetnormal.training.options import TrainOptions
from jetnormal.training.run import Run

if TYPE_CHECKING:
    from jetnormal.networks.checkpoint import Network

HELD_OUT_EPOCH = 1_000_000  # no training reaches it, so its clouds are new
MAX_GRADIENT = 1.0  # norm; a fit that is nearly singular may ask for far more
DROPS = (300 / 700, 550 / 700)  # the paper's schedule: a tenth of the rate after these shares of the epochs
WARM_UP = 0.02  # share of the training in which the rate rises

_Batch = TypeVar("_Batch")
_Drawn = TypeVar("_Drawn", covariant=True)


class Sampler(Protocol, Generic[_Drawn]):
    """Draw the batches of an epoch."""

    @property
    def batches_per_epoch(self) -> int: ...

    def epoch(self, epoch: int, first: int = 0) -> Iterator[_Drawn]:
        """Return the batches of an epoch from number `first` on."""
        ...


class Task(Protocol[_Batch]):
    """What a kind of network learns."""

    @property
    def network(self) -> Network:
        """The network to be trained."""
        ...

    @property
    def unit(self) -> str:
        """What a batch holds, in plural, for the progress."""
        ...

    @property
    def measures(self) -> tuple[str, ...]:
        """Names of the validation errors; the first is "rmse"."""
        ...

    def sampler(self, source: DataSource) -> Sampler[_Batch]:
        """Return what draws the batches from the training clouds."""
        ...

    def samples(self, batch: _Batch) -> int:
        """Count the normals that are learned from in a batch."""
        ...

    def backward(self, batch: _Batch) -> dict[str, float]:
        """Leave the gradient of the loss in the parameters; return the terms of the loss, and their sum "loss"."""
        ...

    def held_out(self, source: DataSource) -> list[Any]:
        """Draw what to validate on from the clouds of the epoch HELD_OUT_EPOCH."""
        ...

    def errors(self, network: Any, held_out: list[Any]) -> tuple[float, ...]:
        """Measure a network, which is this one or its average; one number for each of `measures`."""
        ...


class Trainer(Generic[_Batch]):
    """Train the network of a task from where its run stands to the end.

    Args:
        task: what is learned.
        run: the network on disk, begun or resumed.
        options: how.
        source: of the training clouds.
        validation: clouds to validate on; None takes held-out ones of `source`.

    Raises:
        UsageError: an epoch has less than one batch.
    """

    def __init__(
        self, task: Task[_Batch], run: Run, options: TrainOptions, source: DataSource, validation: DataSource | None
    ) -> None:
        self.task = task
        self.run = run
        self.options = options
        self.sampler = task.sampler(source)
        if self.sampler.batches_per_epoch == 0:
            raise UsageError(f"an epoch has fewer {task.unit} than a batch: lower the batch size or add clouds")
        self._validation = validation or source

    def train(self) -> dict[str, float]:
        """Train, validate and save, epoch by epoch; an interrupt (Ctrl-C) saves first.

        Returns:
            The record of the last epoch: epoch, samples, seconds, loss terms and validation errors.

        Raises:
            InputError: a cloud cannot be used, or the run cannot be written.
            ModelError: the loss, its gradient or the weights are no longer finite.
        """
        if self.run.position.epoch == self.options.epochs:
            logger.info("all %d epochs of the run are done; a larger number of epochs extends it", self.options.epochs)
            return self.run.metrics.last()
        held_out = self.task.held_out(self._validation)
        try:
            while self.run.position.epoch < self.options.epochs:
                self._steps()
                self._finish_epoch(held_out)
        except (KeyboardInterrupt, SystemExit):
            self.run.save()
            logger.warning("interrupted; saved in %s, where the run can be resumed", self.run.folder)
            raise
        return self.run.metrics.last()

    def _steps(self) -> None:
        """What is left of the steps of an epoch."""
        run, position, total = self.run, self.run.position, self.sampler.batches_per_epoch
        name, size = f"epoch {position.epoch + 1} of {self.options.epochs}", self.options.batch_size
        run.network.train()
        with progress(name, (total - position.batch) * size, unit=self.task.unit) as advance:
            start = time.monotonic()
            for batch in self.sampler.epoch(position.epoch, first=position.batch):
                with uninterrupted():  # the weights and the position change together
                    terms = self.step(batch, (position.epoch + position.batch / total) / self.options.epochs)
                    position.count(terms, self.task.samples(batch), time.monotonic() - start)
                start = time.monotonic()
                advance(size, f"loss {terms['loss']:.4f}")
                run.save_if_due()

    def step(self, batch: _Batch, share: float) -> dict[str, float]:
        """Take a step of the optimizer after a share, in [0, 1), of the training; return the loss terms before it."""
        run = self.run
        run.optimizer.zero_grad(set_to_none=True)
        terms = self.task.backward(batch)
        norm = torch.nn.utils.clip_grad_norm_(run.network.parameters(), MAX_GRADIENT).item()
        if not math.isfinite(terms["loss"] + norm):
            self._fail(f"the loss is {terms['loss']} and its gradient {norm}")
        for group in run.optimizer.param_groups:
            group["lr"] = learning_rate(share, self.options)
        run.optimizer.step()
        if not all_finite(run.network):
            self._fail("a step made weights that are not finite")
        run.update_average()
        return terms

    def _fail(self, reason: str) -> None:
        raise ModelError(
            f"{reason} after {self.run.position.samples:,} samples; lower the learning rate "
            f"(what is saved in {self.run.folder} is sound)"
        )

    def _finish_epoch(self, held_out: list[Any]) -> None:
        """Validate, and record and save the epoch, whose steps are done."""
        run, position = self.run, self.run.position
        epoch = position.epoch + 1
        due = epoch % self.options.validate_every == 0 or epoch == self.options.epochs
        errors = self.task.errors(run.result, held_out) if due else (math.nan,) * len(self.task.measures)
        with uninterrupted():
            terms = position.finish_epoch()
            row = {"epoch": epoch, "samples": position.samples, "seconds": position.seconds} | terms
            run.record(row | dict(zip(self.task.measures, errors, strict=True)))
            run.save()
        validated = f", validation RMSE {errors[0]:.2f} degrees" if due else ""
        logger.info("epoch %d of %d: loss %.4f%s", epoch, self.options.epochs, terms["loss"], validated)


def learning_rate(share: float, options: TrainOptions) -> float:
    """Return the rate after a share, in [0, 1), of the training."""
    if options.schedule == "step":
        return options.learning_rate * 0.1 ** sum(share >= drop for drop in DROPS)
    if options.schedule == "constant":
        return options.learning_rate
    rise = min(1.0, share / WARM_UP + 0.01) if options.schedule == "warm-cosine" else 1.0
    return options.learning_rate * rise * (1 + math.cos(math.pi * share)) / 2


def all_finite(network: torch.nn.Module) -> bool:
    """Tell whether all weights and statistics of a network are finite numbers."""
    tensors = [value for value in network.state_dict().values() if value.is_floating_point()]
    return bool(torch.stack([torch.isfinite(value).all() for value in tensors]).all())


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C, and a request to end the process, back until the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals go to the main thread
        return
    caught: list[int] = []
    numbers = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
    handled = {number: handler for number in numbers if callable(handler := signal.getsignal(number))}
    for number in handled:
        signal.signal(number, lambda number, _: caught.append(number))
    try:
        yield
    finally:
        for number, handler in handled.items():
            signal.signal(number, handler)
    if caught:
        signal.raise_signal(caught[0])
