"""What all trainings do around their steps: epochs with progress, records and saved states."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Generic, Protocol, TypeVar

from jetnormal.support.report import logger, progress
from jetnormal.training.run import Run

_Batch = TypeVar("_Batch")
_Drawn = TypeVar("_Drawn", covariant=True)
HELD_OUT_EPOCH = 1_000_000  # no training reaches it, so its clouds are new
MAX_GRADIENT = 1.0  # norm; a fit that is nearly singular may ask for far more


class Sampler(Protocol, Generic[_Drawn]):
    """Draws the batches of an epoch."""

    @property
    def batches_per_epoch(self) -> int: ...

    def epoch(self, epoch: int, first: int = 0) -> Iterator[_Drawn]:
        """The batches of an epoch from number `first` on."""
        ...


def train_epochs(
    run: Run,
    sampler: Sampler[_Batch],
    epochs: int,
    step: Callable[[_Batch, float], dict[str, float]],
    validate: Callable[[], dict[str, float]],
    *,
    samples: Callable[[_Batch], int],
    unit: str,
    units: int,
) -> dict[str, float]:
    """Trains from where a run stands to its end.

    Args:
        run: what is trained, and its folder.
        sampler: of the batches.
        epochs: in all.
        step: learns from a batch after a share, in [0, 1), of the training; gives the loss terms before it.
        validate: gives the validation errors after an epoch, among them "rmse".
        samples: how many samples a batch holds, for the record.
        unit: what the progress counts, in plural.
        units: how many of them are in a batch.

    Returns:
        The record of the last epoch: epoch, patches, seconds, loss terms and validation errors.
    """
    row = run.last_record()
    while run.position.epoch < epochs:
        terms = _train_epoch(run, sampler, epochs, step, samples, unit, units)
        row = {"epoch": run.position.epoch, "patches": run.position.patches, "seconds": run.position.seconds}
        row |= terms | validate()
        run.record(row)
        run.save()
        logger.info("epoch %d of %d: loss %.4f, validation RMSE %.2f degrees", row["epoch"], epochs,
                    row["loss"], row["rmse"])  # fmt: skip
    return row


def _train_epoch(
    run: Run,
    sampler: Sampler[_Batch],
    epochs: int,
    step: Callable[[_Batch, float], dict[str, float]],
    samples: Callable[[_Batch], int],
    unit: str,
    units: int,
) -> dict[str, float]:
    """One epoch, or what is left of it; the means of its loss terms."""
    run.network.train()
    position = run.position
    total = sampler.batches_per_epoch
    with progress(f"epoch {position.epoch + 1} of {epochs}", (total - position.batch) * units, unit=unit) as advance:
        start = time.monotonic()
        for batch in sampler.epoch(position.epoch, first=position.batch):
            terms = step(batch, (position.epoch + position.batch / total) / epochs)
            for name, value in terms.items():
                position.totals[name] = position.totals.get(name, 0.0) + value
            position.batch += 1
            position.patches += samples(batch)
            position.seconds += time.monotonic() - start
            start = time.monotonic()
            advance(units, f"loss {terms['loss']:.4f}")
            run.save_if_due()
    means = {name: value / position.batch for name, value in position.totals.items()}
    position.epoch, position.batch, position.totals = position.epoch + 1, 0, {}
    return means
