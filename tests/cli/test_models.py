from __future__ import annotations

import json
import sys

import pytest
import torch

from jetnormal.cli.app import main
from jetnormal.evaluation import cost
from jetnormal.evaluation.cost import of_model
from jetnormal.networks.checkpoint import load_tensors, save_model, save_tensors
from jetnormal.networks.iternet import IterNetConfig
from jetnormal.networks.packaged import packaged_names
from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig, parameter_count
from jetnormal.networks.pcpnet import PCPNetConfig

TINY = PatchFitConfig("graphfit", neighbors=32, width=0.125, light=True, offsets=True)


@pytest.fixture
def trained(tmp_path):
    torch.manual_seed(0)
    save_model(tmp_path / "own.safetensors", PatchFit(TINY), {"patches": 7, "rmse": 12.5})
    return tmp_path / "own.safetensors"


def run(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["jetnormal", "models", *map(str, arguments)])
    with pytest.raises(SystemExit) as leaving:
        main()
    return leaving.value.code or 0


def test_packaged_models_are_listed(monkeypatch, capsys):
    assert run(monkeypatch, "--no-measure") == 0
    shown = capsys.readouterr().out
    assert all(f"{name}: " in shown for name in packaged_names())
    assert "ms/point" not in shown


def test_every_packaged_model_says_its_error_and_what_it_is(monkeypatch, capsys):
    assert run(monkeypatch, "--no-measure", "--json") == 0
    for row in json.loads(capsys.readouterr().out)["models"]:
        assert 5 < row["rmse"] < 15
        assert "neighbors" in row["architecture"]


def test_a_model_file_tells_what_it_costs(trained, monkeypatch, capsys):
    assert run(monkeypatch, trained, "--device", "cpu", "--threads", "1", "--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["models"]
    assert found["name"] == str(trained)
    assert found["architecture"] == "GraphFit + z-transform + correction, 32 neighbors, order 3, 0.125 of the channels"
    assert found["parameters"] == parameter_count(PatchFit(TINY))
    assert found["megabytes"] == pytest.approx(trained.stat().st_size / 1e6, rel=1e-5)
    assert found["rmse"] == 12.5
    assert 0 < found["ms_per_point"] < 1000
    assert run(monkeypatch, trained, "--no-measure") == 0
    assert "12.50" in capsys.readouterr().out


def test_files_without_an_error_have_none(trained, monkeypatch, capsys):
    tensors, description = load_tensors(trained)
    del description["training"]
    save_tensors(trained, tensors, description)
    assert run(monkeypatch, trained, "--no-measure", "--json") == 0
    (found,) = json.loads(capsys.readouterr().out)["models"]
    assert found["rmse"] is None and found["ms_per_point"] is None


def test_the_papers_networks_are_listed(monkeypatch, capsys):
    assert run(monkeypatch, "--complexity", "--no-measure", "--json") == 0
    found = {one["name"]: one for one in json.loads(capsys.readouterr().out)["models"]}
    assert {name: one["parameters"] for name, one in found.items()} == {
        "PCPNet": 22_362_055, "Nesti-Net": 178_382_710, "IterNet": 7_981,
        "DeepFit": 3_530_245, "AdaFit": 4_174_024, "GraphFit": 4_259_336,
        "DeepFit + both": 3_734_468, "AdaFit + both": 4_378_247, "GraphFit + both": 4_463_559,
        "CloudFit": of_model("cloudfit").parameters,
    }  # fmt: skip
    sizes = [85.41, 13.53, 16.14, 16.38, 14.26, 16.85, 17.09]  # the paper's MB are 2^20 bytes
    fits = [name for name in found if "Fit" in name and name != "CloudFit"]
    assert [found[name]["megabytes"] / 1.048576 for name in ["PCPNet", *fits]] == pytest.approx(sizes, rel=0.01)
    operations = {name: one["gflop_per_point"] for name, one in found.items()}
    assert operations["GraphFit"] > 3 * operations["AdaFit"] > 3 * operations["DeepFit"]
    assert operations["GraphFit + both"] > 3 * operations["DeepFit + both"]
    assert operations["Nesti-Net"] > operations["PCPNet"] > operations["DeepFit"] > 10 * operations["IterNet"]


def test_the_papers_table_tells_names_and_settings(monkeypatch, capsys):
    rows = [("IterNet", "iternet", IterNetConfig()), ("PCPNet", "pcpnet", PCPNetConfig(width=0.125))]
    monkeypatch.setattr(cost, "paper_configurations", lambda: rows)
    assert run(monkeypatch, "--complexity", "--threads", "1") == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "IterNet: IterNet, 64 neighbors, 4 iterations" in shown
    assert "PCPNet: PCPNet, 3 balls of 500 points, 0.125 of the channels" in shown
    assert "ms/point" in shown


@pytest.mark.parametrize(
    ("arguments", "code"), [(["--complexity", "x"], 2), (["absent"], 4), (["deepfit-small", "--device", "tpu"], 2)]
)
def test_failures_have_their_exit_codes(arguments, code, monkeypatch, capsys):
    assert run(monkeypatch, *arguments) == code
    assert capsys.readouterr().out == ""
