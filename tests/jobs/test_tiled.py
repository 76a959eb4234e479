"""Clouds in tiles are the clouds computed at once: small ones here, with tiles that are smaller still."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections import namedtuple
from pathlib import Path

import numpy as np
import pytest
from filelock import FileLock
from shapes import sphere_cloud

from jetnormal.cloud import Cloud
from jetnormal.errors import InputError, UsageError
from jetnormal.estimators import blocks as estimation
from jetnormal.formats import read, write
from jetnormal.geometry import blocks, cells
from jetnormal.jobs import memory
from jetnormal.jobs.estimate import estimate_file
from jetnormal.jobs.memory import Room
from jetnormal.jobs.options import EstimateOptions, FileOptions, LargeOptions
from jetnormal.jobs.tiled import thinning
from jetnormal.jobs.tiled.run import estimate_in_tiles
from jetnormal.orientation import auto

JET = EstimateOptions("jet:k=20,order=2", confidence=True, curvature=True, sign_confidence=True)
TILE = 1200


def in_tiles(source: Path, target: Path, options: EstimateOptions = JET, **settings):
    return estimate_in_tiles(source, target, options, FileOptions(), **{"room": Room(TILE, 10**6), **settings})


VARYING = ("seconds", "output", "points_per_second", "tiles", "peak_memory_mb", "warnings")


@pytest.mark.parametrize(
    ("name", "encoding"), [("a.ply", None), ("a.ply", "ascii"), ("a.pcd", None), ("a.npy", None), ("a.xyz", None)]
)
def test_tiles_give_what_the_whole_gives(tmp_path, name, encoding):
    """Patches are the same points, and all points are in the thinned cloud: every value is the same."""
    source, whole, tiled = tmp_path / name, tmp_path / f"whole_{name}", tmp_path / f"tiled_{name}"
    write(sphere_cloud(), source, encoding=encoding)
    first, second = estimate_file(source, whole, JET), in_tiles(source, tiled)
    assert second["tiles"]["count"] >= 4
    assert {key: value for key, value in second.items() if key not in VARYING} == {
        key: value for key, value in first.items() if key not in VARYING
    }
    assert [w.replace("tiled_", "whole_") for w in second["warnings"]] == first["warnings"]
    a, b = read(whole), read(tiled)
    np.testing.assert_allclose(b.normals, a.normals, atol=1e-6)
    assert b.points.tobytes() == a.points.tobytes() and list(b.attributes) == list(a.attributes)
    for key, values in a.attributes.items():
        assert b.attributes[key].dtype == values.dtype
        np.testing.assert_allclose(b.attributes[key], values, atol=1e-4)
    assert not (tmp_path / f"tiled_{name}.tiles").exists()


def test_a_replaced_attribute_is_told(tmp_path):
    cloud = sphere_cloud()
    write(Cloud(cloud.points, attributes={"confidence": np.zeros(len(cloud))}), tmp_path / "a.ply")
    summary = in_tiles(tmp_path / "a.ply", tmp_path / "b.ply")
    assert "attribute 'confidence' of the input is replaced" in summary["warnings"]


def test_the_default_model_and_a_las_file(tmp_path):
    """The network sees far, so that halos matter; a viewpoint settles the signs of each tile alone."""
    pytest.importorskip("laspy")
    options = EstimateOptions(viewpoint=(0, 0, 0))
    write(sphere_cloud(6000), tmp_path / "a.las")
    estimate_file(tmp_path / "a.las", tmp_path / "whole.las", options)
    in_tiles(tmp_path / "a.las", tmp_path / "tiled.las", options)
    a, b = read(tmp_path / "whole.las"), read(tmp_path / "tiled.las")
    assert b.points.tobytes() == a.points.tobytes()
    np.testing.assert_array_equal(b.attributes["label"], a.attributes["label"])
    cosine = np.einsum("nd,nd->n", a.normals, b.normals)
    assert (cosine > 0).all() and np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 1.0


def test_tiles_are_the_blocks_of_a_cloud_in_memory(tmp_path, monkeypatch):
    """The same points in the same cells, with the same halos: the same but for rounding."""
    monkeypatch.setattr(estimation, "TOGETHER", 2000)
    monkeypatch.setattr(blocks, "CORE", TILE)
    monkeypatch.setattr(cells, "SAMPLE", 2000)
    options = EstimateOptions(orient="up", confidence=True)
    write(sphere_cloud(6000), tmp_path / "a.ply")
    estimate_file(tmp_path / "a.ply", tmp_path / "whole.ply", options)
    summary = in_tiles(tmp_path / "a.ply", tmp_path / "tiled.ply", options)
    assert summary["tiles"]["count"] >= 4
    a, b = read(tmp_path / "whole.ply"), read(tmp_path / "tiled.ply")
    # Tiles and blocks count coordinates from different places: float32 rounds them otherwise. A coarse level of so
    # small a block has few points. Where the normal of one is ambiguous, it passes more than rounding on.
    for found, expected in ((b.normals, a.normals), (b.attributes["confidence"], a.attributes["confidence"])):
        difference = np.abs(found - expected)
        assert np.nanmedian(difference) < 1e-6 and np.nanmax(difference) < 3e-4


KILLED = """
import os, sys
from pathlib import Path
from jetnormal.jobs import memory
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.jobs.tiled import run, work

done = 0
def task(*arguments):
    global done
    done += 1
    if done > int(sys.argv[3]):
        os.kill(os.getpid(), 9)
    return work.run_task(*arguments)

run.run_task = task
options = EstimateOptions("jet:k=20,order=2", confidence=True, curvature=True, sign_confidence=True)
run.estimate_in_tiles(Path(sys.argv[1]), Path(sys.argv[2]), options, FileOptions(), room=memory.Room(1200, 10**6))
"""


@pytest.mark.parametrize("tasks", [2, 9])
def test_a_killed_run_goes_on_and_ends_with_the_same_bytes(tmp_path, tasks):
    """Killed while directions are estimated, and while signs are chosen."""
    source, whole, resumed = (tmp_path / name for name in ("a.ply", "whole.ply", "resumed.ply"))
    write(sphere_cloud(), source)
    in_tiles(source, whole)
    command = [sys.executable, "-c", KILLED, source, resumed, str(tasks)]
    assert subprocess.run(command, timeout=300).returncode == -9
    assert not resumed.exists()
    with pytest.raises(UsageError, match="go on with `resume`"):
        in_tiles(source, resumed)
    with pytest.raises(UsageError, match="tiles of other options"):
        in_tiles(source, resumed, EstimateOptions("jet:k=30"), resume=True)
    in_tiles(source, resumed, resume=True)
    assert resumed.read_bytes() == whole.read_bytes()
    assert not (tmp_path / "resumed.ply.tiles").exists()


def test_what_is_resumed_must_be_there_and_of_this_input(tmp_path, monkeypatch, caplog):
    source, target = tmp_path / "a.ply", tmp_path / "b.ply"
    write(sphere_cloud(), source)
    with pytest.raises(UsageError, match="nothing to go on with"):
        in_tiles(source, target, resume=True)

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("jetnormal.jobs.tiled.run.run_task", interrupted)
    with pytest.raises(KeyboardInterrupt):
        in_tiles(source, target)
    assert "is kept" in caplog.text
    folder = tmp_path / "b.ply.tiles"
    left = sorted(path.name for path in folder.iterdir())
    with FileLock(folder / ".lock"), pytest.raises(InputError, match="another process computes these tiles"):
        in_tiles(source, target, resume=True)
    assert sorted(path.name for path in folder.iterdir()) == left
    write(sphere_cloud(4000), source, overwrite=True)
    with pytest.raises(UsageError, match="tiles of other input"):
        in_tiles(source, target, resume=True)
    (folder / "job.json").write_text("{")
    with pytest.raises(InputError, match=r"job\.json: damaged .* start anew"):
        in_tiles(source, target, resume=True)


def test_a_full_disk_is_told_before_the_work(tmp_path, monkeypatch):
    write(sphere_cloud(), tmp_path / "a.ply")
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(0, 0, 100_000))
    with pytest.raises(InputError, match=r"need 0\.0\d+ GB, but 0\.0001 GB are free; free some space"):
        in_tiles(tmp_path / "a.ply", tmp_path / "b.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]


def test_a_cloud_beyond_the_memory_goes_in_tiles(tmp_path, monkeypatch):
    write(sphere_cloud(), tmp_path / "a.ply")
    monkeypatch.setattr(memory, "PROGRAM", 0)
    monkeypatch.setattr(memory, "LEAST_TILE", 100)
    monkeypatch.setattr(memory, "machine_memory", lambda: 6_500_000)
    assert "tiles" in estimate_file(tmp_path / "a.ply", tmp_path / "b.ply", JET)
    write(sphere_cloud(), tmp_path / "a.npz")
    assert "tiles" in estimate_file(tmp_path / "a.npz", tmp_path / "d.ply", JET)
    assert (tmp_path / "d.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    rows = np.c_[sphere_cloud().points, np.zeros(5000)].astype("<f4")
    (tmp_path / "a.bin").write_bytes(rows.tobytes())
    with pytest.raises(InputError, match=r"more than 0\.0039 GB \(`max_memory`\), and kitti files .*; .*\.ply"):
        estimate_file(tmp_path / "a.bin", tmp_path / "e.ply", JET, FileOptions(format="kitti"))
    large = LargeOptions(max_memory=100_000_000)
    assert "tiles" not in estimate_file(tmp_path / "a.ply", tmp_path / "c.ply", JET, large=large)


@pytest.mark.parametrize("name", ["a.ply", "a.xyz", "a.npz", "a.pcd"])
def test_memory_is_estimated_without_reading(tmp_path, name):
    """By the header, or the size and the first lines: right within a factor of two."""
    write(sphere_cloud(), tmp_path / name)
    needed = memory.at_once(tmp_path / name, FileOptions(), limit=0) - memory.PROGRAM
    assert 0.8 < needed / (memory.peak(5000) - memory.PROGRAM) < 2.5


def test_signs_that_are_chosen_together_take_more_memory():
    """`auto` chooses those of a million points together, and carries them to the others."""
    millions = [memory.peak(n * 10**6, orient) for n in (10, 11) for orient in ("auto", "global", "viewpoint")]
    assert millions[0] == millions[2] < millions[1]
    assert millions[3] - millions[0] == memory.HELD * 10**6
    assert millions[4] - millions[1] == memory.PER_POINT * 10**6


def test_an_output_that_is_written_again_gets_the_signs_of_its_own_cloud(tmp_path):
    target = tmp_path / "out.ply"
    for name, shift in (("a.ply", 0.0), ("b.ply", 1.0)):
        cloud = sphere_cloud()
        write(Cloud(cloud.points + shift), tmp_path / name)
        in_tiles(tmp_path / name, target, overwrite=True)
        estimate_file(tmp_path / name, tmp_path / "whole.ply", JET, overwrite=True)
        np.testing.assert_allclose(read(target).normals, read(tmp_path / "whole.ply").normals, atol=1e-6)


def test_signs_of_many_points_are_decided_by_the_same_part(tmp_path, monkeypatch):
    """A shallow bowl, whose openness and borders depend on how dense it is: tiles and the whole are thinned alike."""
    for module in (auto, thinning):
        monkeypatch.setattr(module, "ENOUGH", 1500)
    points = sphere_cloud(12_000).points
    points = points[points[:, 2] < -0.3]
    write(Cloud(points), tmp_path / "a.ply")
    first = estimate_file(tmp_path / "a.ply", tmp_path / "whole.ply", JET)
    second = in_tiles(tmp_path / "a.ply", tmp_path / "tiled.ply")
    assert second["tiles"]["count"] >= 4
    assert {**second["orient"], "confidence": 0} == {**first["orient"], "confidence": 0}
    a, b = read(tmp_path / "whole.ply").normals, read(tmp_path / "tiled.ply").normals
    assert (np.einsum("nd,nd->n", a, b) > 0).all()
