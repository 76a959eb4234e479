"""What CloudFit learns: the normals of the inner points of crops of clouds, a thread per crop."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from jetnormal.data.sources import DataSource
from jetnormal.geometry.metrics import angles, rmse
from jetnormal.geometry.pyramid import build_pyramid
from jetnormal.networks.cloudfit.config import CloudFitConfig
from jetnormal.networks.cloudfit.network import CloudFit, CloudPrediction
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
        device: where the network is; the pyramids are built on the CPU.
    """

    unit = "crops"
    measures: tuple[str, ...] = ("rmse", "rmse_rough")

    def __init__(
        self, config: CloudFitConfig, options: CloudTraining, pool: ThreadPoolExecutor, device: str = "cpu"
    ) -> None:
        self.network = CloudFit(config).to(device)
        self._options = options
        self._pool = pool

    def sampler(self, source: DataSource) -> CropSampler:
        options = self._options
        return CropSampler(source, options.crop_points, options.crops_per_cloud, options.batch_size, options.seed)

    def samples(self, batch: list[Crop]) -> int:
        return sum(int(crop.learned.sum()) for crop in batch)

    def backward(self, batch: list[Crop]) -> dict[str, float]:
        parameters = list(self.network.parameters())

        def slope(crop: Crop) -> tuple[tuple[Tensor, ...], dict[str, float]]:
            device = self.network.device
            normals, learned = torch.from_numpy(crop.normals).float().to(device), torch.from_numpy(crop.learned)
            terms = cloudfit_loss(_predict(self.network, crop), normals, learned.to(device))
            gradients = torch.autograd.grad(terms["loss"], parameters, allow_unused=True, materialize_grads=True)
            return gradients, {name: value.item() for name, value in terms.items()}

        results = list(self._pool.map(slope, batch))
        for parameter, *gradients in zip(parameters, *(gradients for gradients, _ in results), strict=True):
            parameter.grad = torch.stack(gradients).mean(0)
        return {name: float(np.mean([terms[name] for _, terms in results])) for name in results[0][1]}

    def held_out(self, source: DataSource) -> list[Crop]:
        """Draw two crops from each held-out cloud of a source."""
        seed = self._options.seed
        crops = []
        for number in range(source.clouds_per_epoch):
            cloud = source.cloud(HELD_OUT_EPOCH, number, seed)
            crops += draw_crops(cloud, self._options.crop_points, 2, np.random.default_rng([seed, number]))
        return crops

    def errors(self, network: CloudFit, held_out: list[Crop]) -> tuple[float, ...]:
        """Return means over the crops of the RMSE in degrees of the normals, and of those before the last vote."""

        @torch.inference_mode()
        def measure(crop: Crop) -> list[float]:
            prediction = _predict(network, crop)
            found = (prediction.normals, prediction.rough)
            return [rmse(angles(normals.cpu().numpy()[crop.learned], crop.normals[crop.learned])) for normals in found]

        return tuple(map(float, np.mean(list(self._pool.map(measure, held_out)), axis=0)))


def _predict(network: CloudFit, crop: Crop) -> CloudPrediction:
    prediction: CloudPrediction = network(build_pyramid(crop.points, len(network.config.channels), threads=1))
    return prediction
