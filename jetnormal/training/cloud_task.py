"""What CloudFit learns: the normals of the inner points of crops of clouds, a thread per crop."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from jetnormal.data.sources import DataSource
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig, CloudPrediction, Encoding
from jetnormal.training.crops import Crop, CropSampler, draw_crops
from jetnormal.training.losses import cloudfit_loss
from jetnormal.training.options import CloudTraining
from jetnormal.training.trainer import HELD_OUT_EPOCH


class CloudTask:
    """See `trainer.Task`.

    Args:
        config: of the network.
        options: how it is trained.
        pool: threads, on each of which PyTorch runs alone (`support.device.worker_pool`).
    """

    unit = "crops"
    measures: tuple[str, ...] = ("rmse", "rmse_rough", "rmse_z")

    def __init__(self, config: CloudFitConfig, options: CloudTraining, pool: ThreadPoolExecutor) -> None:
        self.network = CloudFit(config)
        self._options = options
        self._pool = pool

    def sampler(self, source: DataSource) -> CropSampler:
        options = self._options
        return CropSampler(source, options.crop_points, options.crops_per_cloud, options.batch_size, options.seed)

    def samples(self, batch: list[Crop]) -> int:
        return sum(crop.inner for crop in batch)

    def backward(self, batch: list[Crop]) -> dict[str, float]:
        parameters = list(self.network.parameters())

        def slope(crop: Crop) -> tuple[tuple[Tensor, ...], dict[str, float]]:
            normals = torch.from_numpy(crop.normals).float()
            terms = cloudfit_loss(*_predict(self.network, crop), normals, crop.inner)
            gradients = torch.autograd.grad(terms["loss"], parameters, allow_unused=True, materialize_grads=True)
            return gradients, {name: value.item() for name, value in terms.items()}

        results = list(self._pool.map(slope, batch))
        for parameter, *gradients in zip(parameters, *(gradients for gradients, _ in results), strict=True):
            parameter.grad = torch.stack(gradients).mean(0)
        return {name: float(np.mean([terms[name] for _, terms in results])) for name in results[0][1]}

    def held_out(self, source: DataSource) -> list[Crop]:
        """Two crops from each held-out cloud of a source."""
        seed = self._options.seed
        crops = []
        for number in range(source.clouds_per_epoch):
            cloud = source.cloud(HELD_OUT_EPOCH, number, seed)
            crops += draw_crops(cloud, self._options.crop_points, 2, np.random.default_rng([seed, number]))
        return crops

    def errors(self, network: CloudFit, held_out: list[Crop]) -> tuple[float, ...]:
        """Means over the crops of the RMSE in degrees of the refined, the rough and the z-direction normals."""

        @torch.inference_mode()
        def measure(crop: Crop) -> list[float]:
            _, prediction = _predict(network, crop)
            directions = (prediction.refined, prediction.rough, prediction.direction)
            return [rmse(angles(normals.numpy(), crop.normals[: crop.inner])) for normals in directions]

        return tuple(map(float, np.mean(list(self._pool.map(measure, held_out)), axis=0)))


def _predict(network: CloudFit, crop: Crop) -> tuple[Encoding, CloudPrediction]:
    encoding = network.encode(build_pyramid(crop.points, len(network.config.channels), threads=1))
    return encoding, network.fit(encoding, torch.arange(crop.inner))
