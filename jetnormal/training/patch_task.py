"""What patch networks learn: the normal of the query of a patch, and what the paper's losses add."""

from __future__ import annotations

import numpy as np
import torch

from jetnormal.data.sources import DataSource
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.neighbors import NeighborIndex
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig
from jetnormal.training.batches import Batch, PatchSampler, held_out_queries, labeled_patches
from jetnormal.training.losses import total_loss
from jetnormal.training.options import LossWeights, PatchTraining
from jetnormal.training.trainer import HELD_OUT_EPOCH


class PatchTask:
    """See `trainer.Task`.

    Args:
        config: of the network.
        options: how it is trained.
        losses: factors of the loss terms.
        device: "cpu", "cuda" or "cuda:N".
    """

    unit = "patches"
    measures: tuple[str, ...] = ("rmse", "rmse_rough", "rmse_z")

    def __init__(
        self, config: PatchFitConfig, options: PatchTraining, losses: LossWeights, device: str = "cpu"
    ) -> None:
        self.network = PatchFit(config).to(device)
        self._options = options
        self._losses = losses
        self._device = device

    def sampler(self, source: DataSource) -> PatchSampler:
        options = self._options
        neighbors = self.network.config.neighbors
        return PatchSampler(source, neighbors, options.patches_per_cloud, options.batch_size, options.seed)

    def samples(self, batch: Batch) -> int:
        return len(batch.points)

    def backward(self, batch: Batch) -> dict[str, float]:
        points, normals = batch.points.to(self._device), batch.normals.to(self._device)
        with torch.autocast(points.device.type, torch.bfloat16, enabled=self._options.bfloat16):
            prediction = self.network(points, neighbors=True)
        terms = total_loss(prediction, normals, self._losses)
        terms["loss"].backward()
        return {name: value.item() for name, value in terms.items()}

    def held_out(self, source: DataSource) -> list[Batch]:
        """Draw a batch of patches from each held-out cloud of a source."""
        seed = self._options.seed
        batches = []
        for number in range(source.clouds_per_epoch):
            cloud = source.cloud(HELD_OUT_EPOCH, number, seed)
            rng = np.random.default_rng([seed, number])
            queries = held_out_queries(cloud, self._options.validation_patches, rng)
            index = NeighborIndex(cloud.points)
            batches.append(labeled_patches(cloud, index, queries, self.network.config.neighbors))
        return batches

    def errors(self, network: PatchFit, held_out: list[Batch]) -> tuple[float, ...]:
        """Measure the RMSE in degrees of the refined, the rough and the z-direction normals over all patches."""
        found: list[list[np.ndarray]] = [[], [], []]
        network.eval()
        with torch.inference_mode():
            for batch in held_out:
                prediction = network(batch.points.to(self._device))
                true = batch.normals[:, 0].numpy()
                directions = (prediction.refined, prediction.rough, prediction.rotation[:, :, 2])
                for errors, normals in zip(found, directions, strict=True):
                    errors.append(angles(normals.cpu().numpy(), true))
        return tuple(rmse(np.concatenate(errors)) for errors in found)
