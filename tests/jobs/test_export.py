from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import torch

from jetnormal.cli.app import main
from jetnormal.errors import InputError, ModelError, UsageError
from jetnormal.jobs.export import export_model
from jetnormal.networks.checkpoint import load_model, save_model
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig

pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

CONFIGS = {
    "deepfit": PatchFitConfig(neighbors=160, width=0.0625, order=1),
    "adafit": PatchFitConfig("adafit", neighbors=64, width=0.0625, light=True, offsets=True, order=2),
    "graphfit": PatchFitConfig("graphfit", neighbors=64, width=0.0625, light=True, offsets=True, order=1),
    "baseline": PatchFitConfig(neighbors=32, width=0.0625, transform="qstn", correction=False),
}


def patches(count: int, neighbors: int) -> np.ndarray:
    points = np.random.default_rng(count).normal(size=(count, neighbors, 3)) * [1, 1, 0.2]
    points -= points[:, :1]
    distances = np.linalg.norm(points, axis=2)
    points /= distances.max(1)[:, None, None]
    return np.take_along_axis(points, distances.argsort(1)[:, :, None], 1).astype(np.float32)


@pytest.mark.parametrize("name", CONFIGS)
def test_the_exported_graph_gives_the_normals_of_the_network(name, tmp_path):
    torch.manual_seed(0)
    network = PatchFit(CONFIGS[name])
    with torch.no_grad():
        for parameter in network.parameters():  # so that no transform is the identity, and no offset zero
            parameter += 0.02 * torch.randn_like(parameter)
    save_model(tmp_path / "model.safetensors", network, {})
    summary = export_model(str(tmp_path / "model.safetensors"), tmp_path / "model.onnx")
    assert summary["neighbors"] == network.config.neighbors
    session = onnxruntime.InferenceSession(summary["output"], providers=["CPUExecutionProvider"])
    loaded = load_model(tmp_path / "model.safetensors")
    for count in (1, 7):  # not the number that was traced
        given = patches(count, network.config.neighbors)
        normals, rough = session.run(None, {"patches": given})
        with torch.inference_mode():
            expected = loaded(torch.from_numpy(given))
        np.testing.assert_allclose(normals, expected.refined.numpy(), atol=1e-5)
        np.testing.assert_allclose(rough, expected.rough.numpy(), atol=1e-5)


def test_what_cannot_be_exported_is_refused(tmp_path):
    with pytest.raises(ModelError, match="cloudfit: its architecture is cloudfit; only patch networks"):
        export_model("cloudfit", tmp_path / "a.onnx")
    with pytest.raises(UsageError, match=r"name the file \.onnx"):
        export_model("deepfit-small", tmp_path / "a.pb")
    (tmp_path / "there.onnx").write_text("")
    with pytest.raises(InputError, match="exists"):
        export_model("deepfit-small", tmp_path / "there.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["there.onnx"]


def test_the_command_exports(tmp_path, monkeypatch, capsys):
    save_model(tmp_path / "model.safetensors", PatchFit(CONFIGS["baseline"]), {})
    arguments = ["export", tmp_path / "model.safetensors", "-o", tmp_path / "a.onnx", "--json"]
    monkeypatch.setattr(sys, "argv", ["jetnormal", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    assert not leaving.value.code
    assert json.loads(capsys.readouterr().out)["bytes"] == (tmp_path / "a.onnx").stat().st_size
