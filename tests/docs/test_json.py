"""docs/json.md names every field that the jobs print."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from shapes import sphere

from jetnormal import Cloud, write
from jetnormal.cli.app import app
from jetnormal.support.open3d_loader import import_open3d

PAGE = (Path(__file__).parents[2] / "docs" / "json.md").read_text()


@pytest.mark.skipif(import_open3d() is None, reason="there is no Open3D")
def test_every_field_is_documented(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write(Cloud(sphere(500)), tmp_path / "scan.ply")
    command = "estimate scan.ply -o out.ply --model jet --mesh mesh.ply --json --quiet"
    app(command.split(), standalone_mode=False)
    summary = json.loads(capsys.readouterr().out)
    named = {*summary, *summary["mesh"]}
    assert {"schema", "points", "watertight"} <= named
    assert [name for name in named if f"`{name}`" not in PAGE] == []
