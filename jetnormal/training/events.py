"""Metrics of a training run as TensorBoard events."""

from __future__ import annotations

from pathlib import Path

from jetnormal.support.extras import require


class EventLog:
    """Write scalars beside the other files of a run; Weights & Biases reads the files, too (`wandb sync RUN`).

    Args:
        folder: of the run; nothing is written to it before the first record.

    Raises:
        ResourceError: TensorBoard is not installed.
    """

    def __init__(self, folder: Path) -> None:
        require("tensorboard", "`tensorboard`")
        from torch.utils.tensorboard import SummaryWriter

        self._open = SummaryWriter
        self._folder = folder
        self._writer: SummaryWriter | None = None

    def record(self, row: dict[str, float]) -> None:
        """Append the metrics of the epoch that `row` names; they replace later ones of an interrupted run."""
        epoch = int(row["epoch"])
        if self._writer is None:
            self._writer = self._open(str(self._folder), purge_step=epoch)
        for name, value in row.items():
            self._writer.add_scalar(name, value, epoch)
        self._writer.flush()
