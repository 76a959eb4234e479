"""What PCPNet and Nesti-Net learn: the normal of the query from balls around it."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from jetnormal.data.sources import DataSource, LabeledCloud
from jetnormal.geometry.balls import BallIndex
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.networks.nestinet import NestiNet, NestiNetConfig
from jetnormal.networks.pcpnet import PCPNet, PCPNetConfig
from jetnormal.training.batches import QuerySampler, held_out_queries
from jetnormal.training.losses import nestinet_loss, pcpnet_loss
from jetnormal.training.options import PatchTraining
from jetnormal.training.trainer import HELD_OUT_EPOCH

VALIDATION_BATCH = 32  # queries


@dataclass(frozen=True)
class BallBatch:
    """Balls around B queries with their true normals.

    Attributes:
        points, counts: see `geometry.balls.Balls`.
        normals: (B, 3) float32 true unit normals in the frames of the balls.
    """

    points: Tensor
    counts: Tensor
    normals: Tensor


class BallSampler(QuerySampler[BallIndex, BallBatch]):
    """Draw batches of balls; see `QuerySampler`."""

    def __init__(self, config: PCPNetConfig | NestiNetConfig, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.config = config

    def index(self, cloud: LabeledCloud) -> BallIndex:
        return BallIndex(cloud.points)

    def gather(self, cloud: LabeledCloud, index: BallIndex, queries: NDArray[np.int64]) -> BallBatch:
        return labeled_balls(cloud, index, queries, self.config)

    def join(self, parts: list[BallBatch]) -> BallBatch:
        columns = zip(*((part.points, part.counts, part.normals) for part in parts), strict=True)
        return BallBatch(*map(torch.cat, columns))


class BallTask:
    """See `trainer.Task`.

    Args:
        config: of the network.
        options: how it is trained.
        device: "cpu", "cuda" or "cuda:N".
    """

    unit = "queries"
    measures = ("rmse",)

    def __init__(self, config: PCPNetConfig | NestiNetConfig, options: PatchTraining, device: str = "cpu") -> None:
        network = PCPNet(config) if isinstance(config, PCPNetConfig) else NestiNet(config)
        self.network: PCPNet | NestiNet = network.to(device)
        self._options = options
        self._device = device

    def sampler(self, source: DataSource) -> BallSampler:
        options = self._options
        return BallSampler(self.network.config, source, options.patches_per_cloud, options.batch_size, options.seed)

    def samples(self, batch: BallBatch) -> int:
        return len(batch.points)

    def backward(self, batch: BallBatch) -> dict[str, float]:
        torch.manual_seed(zlib.crc32(batch.normals.numpy().tobytes()))  # of the dropout: a resumed run draws it again
        points, counts, normals = (t.to(self._device) for t in (batch.points, batch.counts, batch.normals))
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self._options.bfloat16):
            found = self.network(points, counts)
        loss = pcpnet_loss(found, normals) if isinstance(self.network, PCPNet) else nestinet_loss(found, normals)
        loss.backward()
        return {"loss": loss.item()}

    def held_out(self, source: DataSource) -> list[BallBatch]:
        """Draw some balls from each held-out cloud of a source."""
        seed = self._options.seed
        batches = []
        for number in range(source.clouds_per_epoch):
            cloud = source.cloud(HELD_OUT_EPOCH, number, seed)
            rng = np.random.default_rng([seed, number])
            queries = held_out_queries(cloud, self._options.validation_patches, rng)
            index = BallIndex(cloud.points)
            for start in range(0, len(queries), VALIDATION_BATCH):
                chosen = queries[start : start + VALIDATION_BATCH]
                batches.append(labeled_balls(cloud, index, chosen, self.network.config))
        return batches

    def errors(self, network: PCPNet | NestiNet, held_out: list[BallBatch]) -> tuple[float, ...]:
        """Measure the RMSE in degrees of the normals over all queries."""
        network.eval()
        found = []
        with torch.inference_mode():
            for batch in held_out:
                normals, _ = network.estimate(batch.points.to(self._device), batch.counts.to(self._device))
                found.append(angles(normals.cpu().numpy(), batch.normals.numpy()))
        return (rmse(np.concatenate(found)),)


def labeled_balls(
    cloud: LabeledCloud, index: BallIndex, queries: NDArray[np.int64], config: PCPNetConfig | NestiNetConfig
) -> BallBatch:
    """Return the balls around (B,) queries of a cloud, with the true normals of these."""
    balls = index.balls(queries, config.radii, config.points, config.principal_axes)
    normals = torch.from_numpy(cloud.normals[queries]).float()
    return BallBatch(balls.points, balls.counts, (normals[:, None] @ balls.frame)[:, 0])
