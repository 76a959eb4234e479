"""Tiles on a real cluster of two nodes, started on this machine."""

from __future__ import annotations

import pytest
from shapes import sphere_cloud

from jetnormal.errors import ResourceError
from jetnormal.formats import write
from jetnormal.jobs.memory import Room
from jetnormal.jobs.options import EstimateOptions, FileOptions
from jetnormal.jobs.tiled import cluster as tiles_on
from jetnormal.jobs.tiled import run

ROOM = Room(500, 10**6)
OPTIONS = EstimateOptions("jet:k=20,order=2", confidence=True)


@pytest.fixture
def nodes(monkeypatch):
    """A cluster of two nodes with a core each, and the second node."""
    ray = pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    second = cluster.add_node(num_cpus=1)
    ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
    yield cluster, second
    ray.shutdown()
    cluster.shutdown()


def test_a_lost_node_changes_no_byte(tmp_path, monkeypatch, nodes):
    cluster, second = nodes
    write(sphere_cloud(), tmp_path / "a.ply")
    here, there = tmp_path / "here.ply", tmp_path / "there.ply"
    run.estimate_in_tiles(tmp_path / "a.ply", here, OPTIONS, FileOptions(), room=ROOM)
    lost = []

    def with_a_loss(*arguments):
        for done in tiles_on.run_on_cluster(*arguments):
            yield done
            if not lost:
                lost.append(second)
                cluster.remove_node(second, allow_graceful=False)

    monkeypatch.setattr(run, "run_on_cluster", with_a_loss)
    run.estimate_in_tiles(tmp_path / "a.ply", there, OPTIONS, FileOptions(), room=ROOM, cluster="auto")
    assert lost and there.read_bytes() == here.read_bytes()


def test_a_cluster_that_is_not_there_is_an_error(tmp_path):
    pytest.importorskip("ray")
    write(sphere_cloud(), tmp_path / "a.ply")
    with pytest.raises(ResourceError, match="no cluster at auto"):
        run.estimate_in_tiles(tmp_path / "a.ply", tmp_path / "b.ply", OPTIONS, FileOptions(), room=ROOM, cluster="auto")
