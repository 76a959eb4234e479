from __future__ import annotations

import dataclasses
import errno
import json
import pickle
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import jetnormal
from jetnormal.errors import InputError, ModelError
from jetnormal.networks.checkpoint import load_model, load_tensors, save_model, save_tensors
from jetnormal.networks.model_file import read_description
from jetnormal.networks.packaged import packaged_names, resolve
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig

CONFIG = PatchFitConfig(neighbors=16, width=0.125, order=2, light=True)


@pytest.fixture
def network():
    torch.manual_seed(0)
    network = PatchFit(CONFIG)
    with torch.no_grad():
        for value in network.state_dict().values():
            if value.is_floating_point():
                value.add_(0.05 * torch.rand_like(value))
    return network


@pytest.fixture
def saved(tmp_path, network):
    path = tmp_path / "model.safetensors"
    save_model(path, network, {"patches": 7})
    return path


def rewritten(path, change):
    """The file with its tensors and description changed by a function."""
    tensors, description = load_tensors(path)
    change(tensors, description)
    save_tensors(path, tensors, description)
    return path


def test_a_loaded_network_predicts_the_same_to_the_bit(saved, network):
    points = torch.randn(3, 16, 3)
    loaded = load_model(saved)
    assert loaded.config == CONFIG
    assert not loaded.training
    expected = network.for_inference()(points)
    assert torch.equal(loaded(points).refined, expected.refined)
    assert torch.equal(loaded(points).weights, expected.weights)


@pytest.mark.parametrize("weights", ["deepfit", "adafit", "graphfit"])
def test_every_weight_predictor_is_saved_and_loaded(tmp_path, weights):
    torch.manual_seed(0)
    network = PatchFit(dataclasses.replace(CONFIG, weights=weights, neighbors=48, offsets=True))
    torch.nn.init.normal_(network.weights.offset.weight)
    save_model(tmp_path / "a.safetensors", network, {})
    points = torch.randn(3, 48, 3)
    assert torch.equal(load_model(tmp_path / "a.safetensors")(points).refined, network.for_inference()(points).refined)


def test_a_file_from_before_a_setting_existed_is_loaded(saved, network):
    points = torch.randn(3, 16, 3)
    older = rewritten(saved, lambda tensors, about: about["config"].pop("offsets"))
    assert torch.equal(load_model(older)(points).refined, network.for_inference()(points).refined)


def test_a_file_holds_its_configuration_as_json(saved):
    tensors, description = load_tensors(saved)
    assert description["architecture"] == "patchfit"
    assert description["config"] == dataclasses.asdict(CONFIG)
    assert description["training"] == {"patches": 7}
    assert tensors["weights.weight.bias"].dtype == torch.float32
    header = json.loads(saved.read_bytes()[8 : 8 + int.from_bytes(saved.read_bytes()[:8], "little")])
    assert json.loads(header["__metadata__"]["description"]) == description


def test_every_setting_survives(tmp_path):
    config = PatchFitConfig(
        weights="graphfit",
        neighbors=20,
        order=4,
        transform="qstn",
        correction=False,
        width=0.125,
        transform_width=0.25,
        feature_transform=False,
        light=True,
        offsets=True,
    )
    assert [f.name for f in dataclasses.fields(config) if getattr(config, f.name) == f.default] == []
    save_model(tmp_path / "a.safetensors", PatchFit(config), {})
    assert load_model(tmp_path / "a.safetensors").config == config


def test_saving_replaces_a_file_and_leaves_nothing_beside_it(saved, network):
    save_model(saved, network, {"patches": 8})
    assert load_tensors(saved)[1]["training"] == {"patches": 8}
    assert [path.name for path in saved.parent.iterdir()] == [saved.name]


def test_a_target_that_cannot_be_written(tmp_path, network):
    with pytest.raises(InputError):
        save_model(tmp_path / "missing" / "model.safetensors", network, {})


def test_missing_files_are_named(tmp_path):
    for name in (tmp_path / "no.safetensors", "no-such-model"):
        with pytest.raises(ModelError, match=f"{name}: neither a packaged model"):
            load_model(name)
    with pytest.raises(ModelError, match="no such model file"):
        load_tensors(tmp_path / "no.safetensors")
    with pytest.raises(ModelError, match="neither a packaged model"):
        load_model(tmp_path)  # a folder
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(ModelError, match=r"is the folder of a run; its network is .*model\.safetensors"):
        load_model(tmp_path)


def test_a_file_without_permission_is_not_called_damaged(saved, monkeypatch):
    def refuse(path, mode):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(Path, "open", refuse)  # root may read every file
    with pytest.raises(ModelError, match=r"model\.safetensors: cannot be read \(Permission denied\)"):
        read_description(saved)


@pytest.mark.parametrize("size", [0, 4, 100, -1])
def test_truncated_files_are_refused(saved, size):
    content = saved.read_bytes()
    saved.write_bytes(content[:size])
    with pytest.raises(ModelError, match=r"model\.safetensors: damaged"):
        load_model(saved)


def test_damaged_headers_are_refused(saved):
    content = bytearray(saved.read_bytes())
    content[20:40] = b"\xff" * 20
    saved.write_bytes(content)
    with pytest.raises(ModelError, match="damaged"):
        load_model(saved)


@pytest.mark.parametrize("writer", ["pickle", "torch"])
def test_a_renamed_pickle_is_refused_and_not_run(tmp_path, writer):
    path = tmp_path / "model.safetensors"
    marker = tmp_path / "ran"

    class Payload:
        def __reduce__(self):
            return (marker.touch, ())

    if writer == "pickle":
        path.write_bytes(pickle.dumps(Payload()))
    else:
        torch.save({"a": Payload()}, path)
    with pytest.raises(ModelError, match="not a safetensors file"):
        load_model(path)
    assert not marker.exists()


def test_files_of_other_programs_are_refused(tmp_path, saved):
    foreign = tmp_path / "foreign.safetensors"
    save_file(load_file(saved), foreign)
    with pytest.raises(ModelError, match="not a model of jetnormal"):
        load_model(foreign)
    save_file(load_file(saved), foreign, metadata={"format": "pt"})
    with pytest.raises(ModelError, match="not a model of jetnormal"):
        load_model(foreign)


def test_files_without_a_network_are_refused(tmp_path):
    path = tmp_path / "state.safetensors"
    save_tensors(path, {"a": torch.zeros(3)}, {"position": {}})
    with pytest.raises(ModelError, match="holds no network"):
        load_model(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda tensors, about: tensors.update({"weights.weight.bias": torch.zeros(2)}),
        lambda tensors, about: tensors.pop("weights.weight.bias"),
        lambda tensors, about: tensors.update({"unknown": torch.zeros(2)}),
        lambda tensors, about: about["config"].update(width=0.25),
        lambda tensors, about: about["config"].update(transform="spline"),
        lambda tensors, about: about["config"].update(depth=3),
        lambda tensors, about: about["config"].update(width=None),
        lambda tensors, about: about["config"].update(width=float("inf")),
        lambda tensors, about: about["config"].update(order=7),
        lambda tensors, about: about["config"].update(neighbors=0),
        lambda tensors, about: about["config"].update(neighbors=16.5),
        lambda tensors, about: about["config"].update(correction="yes"),
        lambda tensors, about: about["config"].update(width=1000),
        lambda tensors, about: about["config"].update(weights=[["deepfit"]]),
        lambda tensors, about: tensors.update({"weights.weight.bias": tensors["weights.weight.bias"].double()}),
        lambda tensors, about: tensors["weights.weight.bias"].fill_(float("nan")),
        lambda tensors, about: tensors["weights.weight.bias"].fill_(float("-inf")),
        lambda tensors, about: tensors["weights.weight.bias"].fill_(1e30),
        lambda tensors, about: about.update(config=None),
        lambda tensors, about: about.pop("config"),
    ],
    ids=[
        "shape", "missing", "unknown", "width", "transform", "setting", "no width", "infinite width", "order",
        "neighbors", "half a neighbor", "words", "wide", "list", "float64", "NaN", "infinite", "huge", "no settings",
        "no configuration",
    ],
)  # fmt: skip
def test_weights_and_configurations_that_do_not_fit_are_refused(saved, change):
    with pytest.raises(ModelError, match=r"model\.safetensors: its configuration and its weights do not fit"):
        load_model(rewritten(saved, change))


@pytest.mark.parametrize(
    "config",
    [
        {"up_layers": [10**7] * 3, "channels": [2, 2, 2], "down_layers": [1, 1, 1]},
        {"channels": [10**9, 2, 2], "up_layers": [1, 1, 1], "down_layers": [1, 1, 1]},
        {"channels": [2] * 10**5, "up_layers": [1] * 10**5, "down_layers": [1] * 10**5},
        {"hidden": 10**9},
        {"hidden": 10**30},
        {"channels": 64},
    ],
)
def test_a_small_file_with_a_huge_configuration_is_refused_before_anything_is_allocated(tmp_path, config):
    path = tmp_path / "model.safetensors"
    save_tensors(path, {"a": torch.zeros(1)}, {"architecture": "cloudfit", "config": config, "training": {}})
    start = time.process_time()
    with pytest.raises(ModelError, match="do not fit"):
        load_model(path)
    assert time.process_time() - start < 5


def test_deep_json_is_refused(saved):
    text = {"format": "jetnormal-1", "description": "[" * 200_000}
    save_file(load_file(saved), saved, metadata=text)
    with pytest.raises(ModelError, match="damaged"):
        load_model(saved)


def test_weights_that_lead_nowhere_are_the_models_fault(tmp_path):
    """All are numbers in range, but their products are not."""
    network = PatchFit(CONFIG)
    with torch.no_grad():
        for value in network.state_dict().values():
            if value.is_floating_point():
                value.fill_(9e5)
    save_model(tmp_path / "a.safetensors", network, {})
    with pytest.raises(ModelError, match="no finite normals"):
        jetnormal.estimate(np.random.default_rng(0).normal(size=(100, 3)), model=str(tmp_path / "a.safetensors"))


def test_a_description_that_is_no_table_is_refused(saved):
    save_tensors(saved, load_file(saved), ["patchfit"])
    with pytest.raises(ModelError):
        load_model(saved)


def test_a_packaged_name_goes_before_a_path(tmp_path, monkeypatch, saved):
    (tmp_path / "models").mkdir()
    packaged = tmp_path / "models" / "tiny.safetensors"
    saved.rename(packaged)
    monkeypatch.setattr("jetnormal.networks.packaged.model_directory", lambda: tmp_path / "models")
    assert packaged_names() == ["tiny"]
    assert resolve("tiny") == packaged
    assert resolve(packaged) == packaged
    assert load_model("tiny").config == CONFIG
    with pytest.raises(ModelError, match=r"other: neither a packaged model \(tiny\) nor a model file"):
        resolve("other")
