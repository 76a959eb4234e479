"""`jetnormal estimate` as a user runs it: a process, a real scan, exit codes, one line on stderr."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from jetnormal import Cloud, formats

MILK = Path(__file__).parents[2] / "samples" / "milk.pcd"
PROGRAM = (sys.executable, "-c", "from jetnormal.cli.app import main; main()", "estimate")


def estimate(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PROGRAM, *map(str, arguments)], capture_output=True, text=True, timeout=120)


def test_a_real_scan_gets_normals_and_keeps_its_colors(tmp_path):
    result = estimate(MILK, "-o", tmp_path / "milk.ply", "--model", "pca", "--json")
    assert result.returncode == 0, result.stderr
    summary = json.loads(result.stdout)
    assert summary["points"] == summary["valid"] == 13704
    assert summary["points_per_second"] > 0 and summary["peak_memory_mb"] > 0
    before, after = formats.read(MILK), formats.read(tmp_path / "milk.ply")
    assert np.array_equal(after.points, before.points)
    assert np.allclose(np.linalg.norm(after.normals, axis=1), 1, atol=1e-6)
    assert {"red", "green", "blue"} <= set(after.attributes)
    # one view of a carton from the sensor at the origin: its extreme points, and so all of it, look back
    assert ((after.normals * -after.points).sum(axis=1) > 0).mean() > 0.97


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["missing.ply", "-o", "out.ply"], 3, "missing.ply"),
        (["milk.pcd", "-o", "milk.pcd"], 3, "--force"),
        (["milk.pcd", "-o", "out.stl"], 3, ".stl"),
        (["milk.pcd", "-o", "nowhere/out.ply"], 3, "nowhere"),
        (["two.xyz", "-o", "out.ply"], 3, "at least 3"),
        (["milk.pcd", "-o", "out.ply", "--model", "nonesuch"], 4, "nonesuch"),
        (["grid.xyz", "-o", "out.ply", "--orient", "viewpoint"], 2, "--viewpoint"),
        (["milk.pcd", "-o", "out.ply", "--k", "2"], 2, "k must be at least 3"),
        (["milk.pcd", "-o", "out.ply", "--encoding", "morse"], 2, "morse"),
        (["milk.pcd", "-o", "out.ply", "--model", "cloudfit", "--device", "cuda:99"], 5, "no device cuda:99"),
        (["milk.pcd", "-o", "out.ply", "--model", "deepfit-small", "--device", "cuda:99"], 5, "cuda:99"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line_and_leaves_nothing(tmp_path, program, arguments, code, words):
    (tmp_path / "milk.pcd").write_bytes(MILK.read_bytes())
    formats.write(Cloud(np.eye(3)[:2]), tmp_path / "two.xyz")
    formats.write(Cloud(np.stack(np.meshgrid(*[range(3)] * 3), -1).reshape(-1, 3)), tmp_path / "grid.xyz")
    before = sorted(tmp_path.iterdir())
    paths = [str(tmp_path / text) if "." in text and not text.startswith("-") else text for text in arguments]
    paths = [str(tmp_path / text) if text.startswith("nowhere") else text for text in paths]
    model = [] if "--model" in arguments or code == 5 else ["--model", "pca"]
    result = program("estimate", *paths, *model)
    assert result.returncode == code, result.stderr
    assert words in result.stderr and "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


def test_an_interrupt_exits_with_130_and_leaves_nothing(tmp_path):
    command = [*PROGRAM, str(MILK), "-o", str(tmp_path / "out.ply"), "--model", "jet:k=600,order=4", "-v"]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's & lets children ignore it
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed) as process:
        assert process.stderr is not None
        while not process.stderr.readline().startswith("jetnormal: clean:"):
            assert process.poll() is None
        process.send_signal(signal.SIGINT)  # in the middle of the fits, which take some seconds
        process.stderr.read()
        assert process.wait(timeout=60) == 130
    assert list(tmp_path.iterdir()) == []


def test_a_cloud_goes_through_the_standard_streams(tmp_path):
    rows = b"".join(b"%d %d 0\n" % (index % 7, index // 7) for index in range(49))
    command = [*PROGRAM, "-", "-o", "-", "--format", "xyz", "--model", "pca:k=6", "--orient", "up"]
    result = subprocess.run(command, input=rows, capture_output=True, timeout=120)
    assert result.returncode == 0, result.stderr
    written = result.stdout.splitlines()
    assert len(written) == 49 and written[8] == b"1 1 0 0 0 1"
    result = subprocess.run(command, input=b"1 2\n", capture_output=True, timeout=120)
    assert result.returncode == 3 and b"standard input: line 1: 2 values" in result.stderr


def test_files_that_fail_do_not_stop_the_others(tmp_path):
    (tmp_path / "bad.ply").write_text("no cloud")
    formats.write(Cloud(np.random.default_rng(0).random((60, 3))), tmp_path / "good.xyz")
    arguments = (tmp_path / "bad.ply", tmp_path / "good.xyz", "--out-dir", tmp_path / "out", "--model", "pca", "--json")
    result = estimate(*arguments)
    assert result.returncode == 3 and "Traceback" not in result.stderr
    summary = json.loads(result.stdout)
    assert [done["output"] for done in summary["files"]] == [str(tmp_path / "out" / "good.xyz")]
    (failure,) = summary["failed"]
    assert failure["code"] == 3 and failure["error"].startswith(failure["input"]) and failure["error"] in result.stderr
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good.xyz"]
