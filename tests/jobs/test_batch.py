"""Many files into one folder."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from jetnormal import Cloud, formats
from jetnormal.errors import InputError, UsageError
from jetnormal.jobs import batch as batches
from jetnormal.jobs.batch import estimate_files, target_for
from jetnormal.jobs.options import BatchOptions, EstimateOptions, FileOptions

OPTIONS = EstimateOptions(model="pca:k=8")


@pytest.fixture
def scans(tmp_path):
    """Five spheres, of which the third cannot be read."""
    points = np.random.default_rng(0).normal(size=(5, 80, 3))
    points /= np.linalg.norm(points, axis=2, keepdims=True)
    paths = [tmp_path / f"scan{index}.xyz" for index in range(5)]
    for path, cloud in zip(paths, points, strict=True):
        formats.write(Cloud(cloud), path)
    paths[2].write_text("1 2 x\n")
    return paths


def test_a_failure_leaves_the_others_alone(scans, tmp_path):
    summary = estimate_files(scans, tmp_path / "new" / "out", OPTIONS, batch=BatchOptions(jobs=3, suffix="_n"))
    assert [Path(done["input"]) for done in summary["files"]] == [scans[0], scans[1], scans[3], scans[4]]
    ((failure),) = summary["failed"]
    assert failure["input"] == str(scans[2]) and failure["code"] == 3 and "'x' is not a number" in failure["error"]
    written = sorted((tmp_path / "new" / "out").iterdir())
    assert [path.name for path in written] == ["scan0_n.xyz", "scan1_n.xyz", "scan3_n.xyz", "scan4_n.xyz"]
    for path, source in zip(written, (scans[0], scans[1], scans[3], scans[4]), strict=True):
        assert np.array_equal(formats.read(path).points, formats.read(source).points)
        assert formats.read(path).normals is not None


def test_names_that_no_file_can_have_are_input_errors(scans, tmp_path):
    loop, other = tmp_path / "loop.xyz", tmp_path / "other.xyz"
    loop.symlink_to(other)
    other.symlink_to(loop)
    summary = estimate_files([loop, scans[0]], tmp_path / "out", OPTIONS)
    assert len(summary["files"]) == 1 and summary["failed"][0]["code"] == 3
    for folder, suffix in ((loop, ""), (tmp_path / "new", "n" * 5000)):
        with pytest.raises(InputError):
            estimate_files([scans[0]], folder, OPTIONS, batch=BatchOptions(suffix=suffix, skip_existing=True))


def test_one_model_computes_one_cloud_at_a_time(scans, tmp_path, monkeypatch):
    made, busy = [], threading.Semaphore(1)
    prepare = batches.prepare_estimator

    def prepare_estimator(options):
        estimator = prepare(options)
        made.append(estimator)

        class Watched:
            name, neighbors, min_points, has_curvature = "watched", 8, 3, False

            def __call__(self, points, queries, advance):
                assert busy.acquire(blocking=False)
                try:
                    return estimator(points, queries, advance)
                finally:
                    busy.release()

        return Watched()

    monkeypatch.setattr(batches, "prepare_estimator", prepare_estimator)
    summary = estimate_files(scans, tmp_path / "out", OPTIONS, batch=BatchOptions(jobs=5))
    assert len(made) == 1 and len(summary["files"]) == 4 and len(summary["failed"]) == 1


def test_what_is_there_is_left_out_or_refused(scans, tmp_path):
    estimate_files(scans[:1], tmp_path / "out", OPTIONS)
    before = (tmp_path / "out" / "scan0.xyz").read_bytes()
    with pytest.raises(InputError, match=r"scan0\.xyz: already exists"):
        estimate_files(scans[:2], tmp_path / "out", OPTIONS)
    assert len(list((tmp_path / "out").iterdir())) == 1
    summary = estimate_files(scans[:2], tmp_path / "out", OPTIONS, batch=BatchOptions(skip_existing=True))
    assert summary["skipped"] == [str(tmp_path / "out" / "scan0.xyz")] and len(summary["files"]) == 1
    assert (tmp_path / "out" / "scan0.xyz").read_bytes() == before
    with pytest.raises(UsageError, match="contradicts"):
        estimate_files(scans, tmp_path / "out", OPTIONS, batch=BatchOptions(skip_existing=True), overwrite=True)


def test_results_have_names_of_their_own(scans, tmp_path):
    with pytest.raises(UsageError, match="is an input itself"):
        estimate_files(scans, tmp_path, OPTIONS, overwrite=True)
    other = tmp_path / "b" / "scan0.xyz"
    other.parent.mkdir()
    other.write_bytes(scans[0].read_bytes())
    with pytest.raises(UsageError, match="would both become"):
        estimate_files([scans[0], other], tmp_path / "out", OPTIONS)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file: cannot be created"):
        estimate_files(scans, tmp_path / "file", OPTIONS)
    with pytest.raises(UsageError, match="not a path"):
        BatchOptions(suffix="a/b")


@pytest.mark.parametrize(
    ("source", "format", "target"),
    [
        ("a/tile.laz", None, "tile_n.laz"),
        ("a/tile.LAZ", None, "tile_n.LAZ"),
        ("a/tile.copc.laz", None, "tile_n.laz"),
        ("a/tile.laz", "ply", "tile_n.ply"),
        ("a/project.ptx", None, "project_n.ply"),
        ("a/0001.bin", "kitti", "0001_n.ply"),
    ],
)
def test_names_of_results(source, format, target):
    found = target_for(Path(source), Path("out"), FileOptions(format=format), BatchOptions(suffix="_n"))
    assert found == Path("out") / target
