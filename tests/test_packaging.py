"""The source distribution is complete, and its wheel, installed elsewhere, works far from the source tree."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from importlib.metadata import requires
from pathlib import Path

import numpy as np
import pytest
from shapes import sphere

import jetnormal

ROOT = Path(__file__).parents[1]
MODELS = sorted(path.stem for path in (ROOT / "models").glob("*.safetensors"))


def run(*command: str | Path, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    result = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=240)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def dist(tmp_path_factory) -> Path:
    """A folder with the source distribution, and with the wheel that was built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist) -> Path:
    (path,) = dist.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def programs(wheel, tmp_path_factory) -> Path:
    """Folder of the programs of a fresh environment: the wheel, and this one's packages as dependencies."""
    environment = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", environment, cwd=environment)
    programs = environment / ("Scripts" if os.name == "nt" else "bin")
    where = "import sysconfig; print(sysconfig.get_path('purelib'))"
    packages = Path(run(programs / "python", "-c", where, cwd=environment).strip())
    # .pth files in the folder named here are not read, so the source tree's editable install stays invisible.
    (packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    options = ("--no-deps", "--no-index", "--quiet")
    run(
        sys.executable,
        "-m",
        "pip",
        "--python",
        programs / "python",
        "install",
        *options,
        wheel,
        cwd=environment,
    )
    return programs


@pytest.mark.skipif(shutil.which("git") is None or not (ROOT / ".git").exists(), reason="this is no clone")
def test_source_distribution_holds_what_a_clone_holds(dist):
    (path,) = dist.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = run("git", "-c", f"safe.directory={ROOT}", "ls-files", cwd=ROOT).splitlines()
    assert {name for name in tracked if (ROOT / name).exists()} <= names


def test_wheel_carries_models_types_and_license(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    models = {f"jetnormal/models/{path.name}" for path in (ROOT / "models").iterdir()}
    assert models <= set(names)
    assert "jetnormal/py.typed" in names
    assert any(re.fullmatch(r"jetnormal-[^/]+\.dist-info/licenses/LICENSE", name) for name in names)
    assert not [name for name in names if name.startswith(("tests/", "samples/", "models/"))]


def test_installed_program_runs_the_installed_package(programs, tmp_path):
    assert "jetnormal estimate" in run(programs / "jetnormal", "--help", cwd=tmp_path)
    assert run(programs / "jetnormal", "--version", cwd=tmp_path) == f"jetnormal {jetnormal.__version__}\n"
    where = "import jetnormal.networks.packaged as r; print(r.__file__); print(r.model_directory())"
    module, models = (Path(line) for line in run(programs / "python", "-c", where, cwd=tmp_path).splitlines())
    assert module.is_relative_to(programs.parent)
    assert models == module.parents[1] / "models"
    assert {path.name for path in models.iterdir()} == {path.name for path in (ROOT / "models").iterdir()}


@pytest.mark.parametrize("model", ["jet", *MODELS])
def test_installed_program_estimates_in_another_folder(model, programs, tmp_path):
    points = sphere(600)
    np.savetxt(tmp_path / "sphere.xyz", points, fmt="%.9f")
    run(programs / "jetnormal", "estimate", "sphere.xyz", "-o", "out.xyz", "--model", model, cwd=tmp_path)
    out = np.loadtxt(tmp_path / "out.xyz")
    assert np.allclose(out[:, :3], points, atol=1e-6)
    cosines = np.sum(out[:, 3:6] * points, axis=1)
    assert np.median(cosines) > 0.95  # outwards, a sphere's normals are its points


def test_constraints_pin_every_dependency():
    def names(lines: list[str]) -> set[str]:
        return {re.split(r"[^\w-]", line, maxsplit=1)[0].lower() for line in lines if line[:1].isalpha()}

    constraints = (ROOT / "constraints.txt").read_text().splitlines()
    assert names(requires("jetnormal") or []) - {"jetnormal"} <= names(constraints)


def test_source_checkout_finds_its_models():
    from jetnormal.networks.packaged import model_directory

    assert model_directory() == ROOT / "models"
