"""From the text that a user types, such as "cloudfit" or "pca:k=112", to an estimator."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jetnormal.errors import ModelError, UsageError
from jetnormal.networks.model_file import ARCHITECTURES, read_description
from jetnormal.networks.packaged import packaged_names, resolve
from jetnormal.support.extras import named_extras
from jetnormal.support.options import MAX_THREADS

if TYPE_CHECKING:
    from jetnormal.estimators.base import Estimator
    from jetnormal.networks.checkpoint import Network

    Source = Path | Network | None

CLASSICAL = ("pca", "jet")
SETTINGS = ("k", "order", "iterations")
LARGEST = {"k": 2**31, "order": 2**31, "iterations": 1000, "batch_size": 2**31, "threads": MAX_THREADS}
# The neighborhoods that PCPNet's authors and those after them compare with: "pca:small" and so on.
PRESETS = {
    "pca": {"small": {"k": 18}, "medium": {"k": 112}, "large": {"k": 450}},
    "jet": {
        "small": {"k": 18, "order": 2},
        "medium": {"k": 122, "order": 2},
        "large": {"k": 450, "order": 2},
    },
}
TRADITIONAL = "traditional"  # stands for all of them


@dataclass(frozen=True)
class Resources:
    """What an estimator may use: see `make_estimator`."""

    batch_size: int | None
    device: str
    threads: int | None


@dataclass(frozen=True)
class _Kind:
    """A kind of estimator.

    Attributes:
        settings: names of its settings.
        runs_on_gpu: whether it takes another device than the CPU.
        build: makes an estimator from name, model file or network (None for a classical fit), settings and resources.
    """

    settings: tuple[str, ...]
    runs_on_gpu: bool
    build: Callable[[str, Any, dict[str, int], Resources], Estimator]


def make_estimator(
    model: str,
    *,
    k: int | None = None,
    order: int | None = None,
    iterations: int | None = None,
    batch_size: int | None = None,
    device: str = "auto",
    threads: int | None = None,
) -> Estimator:
    """Build an estimator from its name.

    Args:
        model: "pca", "jet", a packaged network or a model file; settings may follow a colon, as in
            "jet:k=122,order=2" or "deepfit-small:iterations=2", or for classical fits the name of a preset, as in
            "pca:small".
        k: neighbors in a patch.
        order: of the jet; only for "jet".
        iterations: of a network; see `PatchFit.forward`.
        batch_size: patches at a time.
        device: "auto", "cpu", "cuda" or "cuda:N", for networks.
        threads: CPU threads.

    Raises:
        UsageError: a setting is unknown, out of range, or given to a model without it.
        ModelError: there is no such model, or its file is damaged.
        ResourceError: the device is not there, or PyTorch is missing, without which only CloudFit works.
    """
    name, settings = _parse(model)
    given = {"k": k, "order": order, "iterations": iterations} | settings
    chosen = {key: value for key, value in given.items() if value is not None}
    for key, value in (chosen | {"batch_size": batch_size, "threads": threads}).items():
        if value is not None and not 1 <= value <= LARGEST[key]:
            raise UsageError(f"{key} must be 1 to {LARGEST[key]}, not {value}")
    path = None if name in CLASSICAL else resolve(name, CLASSICAL)
    kind = _KINDS[name] if path is None else _kind_of(path)
    if not kind.runs_on_gpu and device not in ("auto", "cpu"):
        raise UsageError(f"the model {name} runs on the CPU: leave out the option device, or choose a network")
    with named_extras(f"the model {name}" if device in ("auto", "cpu") else f"the model {name} on {device}"):
        return kind.build(model, path, _only(chosen, name, kind.settings), Resources(batch_size, device, threads))


def network_estimator(name: str, network: Network, *, device: str = "auto", threads: int | None = None) -> Estimator:
    """Build an estimator of a network that is ready for inference; CloudFit's only comes from a file.

    Raises:
        ResourceError: the device is not there.
    """
    return _KINDS[network.architecture].build(name, network, {}, Resources(None, device, threads))


def runs_on_gpu(architecture: str) -> bool:
    """Tell whether networks of an architecture take another device than the CPU."""
    return _KINDS[architecture].runs_on_gpu


def spelled_out(models: Sequence[str | Estimator]) -> list[str | Estimator]:
    """Return models with the six presets of classical fits in the place of "traditional"."""
    presets = [f"{name}:{preset}" for name in CLASSICAL for preset in PRESETS[name]]
    return [name for model in models for name in (presets if model == TRADITIONAL else [model])]


def model_names() -> list[str]:
    """List the models that have a name: classical fits and packaged networks."""
    return [*packaged_names(), *CLASSICAL]


def model_file(model: str) -> Path | None:
    """Find the file that a model, given as to `make_estimator`, is loaded from; None for "pca" and "jet".

    Raises:
        UsageError, ModelError: as `make_estimator`.
    """
    name, _ = _parse(model)
    return None if name in CLASSICAL else resolve(name, CLASSICAL)


def _kind_of(path: Path) -> _Kind:
    """The kind of estimator that a model file is for."""
    architecture = read_description(path).get("architecture")
    if not isinstance(architecture, str) or architecture not in ARCHITECTURES:
        raise ModelError(f"{path}: holds no network (architecture {architecture!r})")
    return _KINDS[architecture]


def _parse(model: str) -> tuple[str, dict[str, int]]:
    """Split "name:key=value,..." or "name:preset" at its last colon; a path may hold colons of its own."""
    name, colon, text = model.rpartition(":")
    if text in PRESETS.get(name, {}):
        return name, PRESETS[name][text]
    if not colon or "=" not in text or _is_file(model):
        return model, {}
    settings = {}
    for item in text.split(","):
        key, _, value = item.partition("=")
        if key not in SETTINGS or not re.fullmatch("[0-9]{1,18}", value):
            raise UsageError(f"{model}: {item!r} is no setting; write k=, order= or iterations= and a number")
        settings[key] = int(value)
    return name, settings


def _is_file(name: str) -> bool:
    try:
        return Path(name).exists()
    except OSError:  # such as a name too long for a file
        return False


def _only(chosen: dict[str, int], model: str, allowed: tuple[str, ...]) -> dict[str, int]:
    """The chosen settings, all of which the model must have; one iteration is allowed for every model."""
    for key in chosen:
        if key not in allowed and not (key == "iterations" and chosen[key] == 1):
            raise UsageError(f"the model {model} has no option {key}; it takes {' and '.join(allowed) or 'none'}")
    return {key: value for key, value in chosen.items() if key in allowed}


def _pca(_model: str, _path: Path | None, settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.patchwise import pca_estimator

    return pca_estimator(**settings, batch_size=resources.batch_size, threads=resources.threads)


def _jet(_model: str, _path: Path | None, settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.patchwise import jet_estimator

    return jet_estimator(**settings, batch_size=resources.batch_size, threads=resources.threads)


def _patch_network(model: str, network: Source, settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.patchwise import network_estimator
    from jetnormal.support.device import resolve_device

    return network_estimator(
        model,
        _load(network),
        **settings,
        batch_size=resources.batch_size,
        device=resolve_device(resources.device),
        threads=resources.threads,
    )


def _whole_cloud(model: str, path: Path | None, _settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.whole_cloud import cloud_estimator
    from jetnormal.support.device import resolve_device

    assert path is not None
    device = "cpu" if resources.device == "auto" else resolve_device(resources.device)
    return cloud_estimator(model, path, device=device, threads=resources.threads)


def _iterative(model: str, network: Source, settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.iterative import ROWS, IterEstimator

    batch_size = resources.batch_size or ROWS
    return IterEstimator(model, _load(network), **settings, batch_size=batch_size, threads=resources.threads)


def _balls(model: str, network: Source, _settings: dict[str, int], resources: Resources) -> Estimator:
    from jetnormal.estimators.ballwise import BATCH, BallEstimator
    from jetnormal.support.device import resolve_device

    device = resolve_device(resources.device)
    return BallEstimator(model, _load(network).to(device), resources.batch_size or BATCH, device, resources.threads)


def _load(network: Path | Network | None) -> Any:
    """The network of a model file, or one that is loaded already."""
    if not isinstance(network, Path):
        return network
    from jetnormal.networks.checkpoint import load_model  # brings PyTorch along

    return load_model(network)


_KINDS = {
    "pca": _Kind(("k",), False, _pca),
    "jet": _Kind(("k", "order"), False, _jet),
    "patchfit": _Kind(("k", "iterations"), True, _patch_network),
    "cloudfit": _Kind((), True, _whole_cloud),
    "iternet": _Kind(("k", "iterations"), False, _iterative),
    "pcpnet": _Kind((), True, _balls),
    "nestinet": _Kind((), True, _balls),
}
"""By name, and networks by their architecture."""
