"""What works without the libraries that extras install, and what is said where one is needed."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from shapes import sphere

import jetnormal
from jetnormal.errors import ResourceError
from jetnormal.support.extras import named_extras

WITHOUT = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in ("torch", "open3d", "matplotlib", "laspy", "lazrs", "pye57", "onnx", "tensorboard"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from jetnormal.cli.app import main
for line in sys.stdin.read().splitlines():
    sys.argv = ["jetnormal", *line.split()]
    try:
        main()
    except SystemExit as end:
        print(end.code, flush=True)
"""
COMMANDS = {
    "estimate sphere.xyz -o out.ply --confidence --curvature": None,
    "preview out.ply -o out.png --size 64": None,
    "estimate sphere.xyz -o jet.ply --model jet": "torch",
    "estimate sphere.xyz -o net.ply --model deepfit-small": "torch",
    "estimate sphere.xyz -o gpu.ply --device cuda": "torch",
    "estimate sphere.xyz -o again.ply --mesh out.glb": "mesh",
    "reconstruct out.ply -o out.glb": "mesh",
    "train -o run": "torch",
    "models": "torch",
    "export deepfit-small -o net.onnx": "torch",
}


def test_the_default_model_needs_numpy_scipy_and_numba_only(tmp_path):
    np.savetxt(tmp_path / "sphere.xyz", sphere(300), fmt="%.6f")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT], input="\n".join(COMMANDS), cwd=tmp_path, capture_output=True, text=True
    )
    codes = [int(code) for code in done.stdout.split()]
    assert codes == [0 if extra is None else ResourceError.exit_code for extra in COMMANDS.values()], done.stderr
    errors = [line for line in done.stderr.splitlines() if "error:" in line]
    for error, extra in zip(errors, filter(None, COMMANDS.values()), strict=True):
        assert f"pip install 'jetnormal[{extra}]'" in error
    assert "the model jet needs PyTorch, but" in errors[0] and "the model cloudfit on cuda needs PyTorch" in errors[2]
    assert "this command needs PyTorch" in errors[-1]
    cloud = jetnormal.read(tmp_path / "out.ply")
    assert cloud.normals is not None
    assert np.median((cloud.normals * cloud.points).sum(axis=1)) > 0.95
    assert not (tmp_path / "again.ply").exists()  # the mesh is asked for before the long work


def test_other_missing_modules_stay_what_they_are():
    with pytest.raises(ModuleNotFoundError), named_extras():
        import no_such_module  # type: ignore[import-not-found] # noqa: F401
