from __future__ import annotations

import numpy as np
import pytest

from jetnormal.data import corruption
from jetnormal.data.dataset import Mixture, open_dataset
from jetnormal.data.scanners.draw import FAMILIES
from jetnormal.data.sources import (
    LabeledCloud,
    MeshFolder,
    PcpnetFolder,
    ScannedSurfaces,
    SyntheticSolids,
)
from jetnormal.errors import InputError, UsageError

TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
FACES = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


def write_cloud(folder, name, count=40, queries=None, scale=1.0):
    rng = np.random.default_rng(len(name))
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    np.savetxt(folder / f"{name}.xyz", normals * 2, fmt="%.7g")
    np.savetxt(folder / f"{name}.normals", scale * normals, fmt="%.7g")
    if queries is not None:
        np.savetxt(folder / f"{name}.pidx", queries, fmt="%d")


@pytest.fixture
def pcpnet(tmp_path):
    folder = tmp_path / "pcpnet"
    folder.mkdir()
    write_cloud(folder, "box_noise_white_1.00e-02", queries=[3, 1, 39], scale=7.0)
    write_cloud(folder, "ball")
    (folder / "trainingset_whitenoise.txt").write_text("box_noise_white_1.00e-02\r\nball\n\n")
    return folder


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    for index, name in enumerate("abc"):
        np.savez(folder / f"{name}.npz", vertices=TETRAHEDRON + 10 * index, faces=FACES)
    return folder


def assert_same(first: LabeledCloud, second: LabeledCloud):
    assert first.name == second.name
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.normals, second.normals)


def test_listed_clouds_are_read_as_they_are(pcpnet):
    source = PcpnetFolder(pcpnet)
    assert source.names == ["box_noise_white_1.00e-02", "ball"]
    assert source.clouds_per_epoch == 2
    box, ball = source.cloud(0, 0, 1), source.cloud(0, 1, 1)
    np.testing.assert_array_equal(box.queries, [3, 1, 39])
    assert box.queries.dtype == np.int64
    assert ball.queries is None
    for cloud in (box, ball):
        assert cloud.points.shape == cloud.normals.shape == (40, 3)
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
        np.testing.assert_allclose(cloud.points, 2 * cloud.normals, atol=1e-5)
    assert source.cloud(5, 0, 99) is box  # the same in each epoch, and read once


def test_clouds_without_a_list_are_corrupted_anew(pcpnet, monkeypatch):
    monkeypatch.setattr(corruption, "RIDGES_SHARE", 0)
    write_cloud(pcpnet, "big", count=2_000)
    np.savetxt(pcpnet / "unlabeled.xyz", np.eye(3))
    source = PcpnetFolder(pcpnet, None)
    assert source.names == ["ball", "big", "box_noise_white_1.00e-02"]
    clouds = [source.cloud(epoch, 1, 0) for epoch in range(20)]
    assert_same(clouds[4], PcpnetFolder(pcpnet, None).cloud(4, 1, 0))
    assert len({len(cloud.points) for cloud in clouds}) > 5
    assert len({cloud.name for cloud in clouds}) > 2
    for cloud in clouds:
        assert 250 <= len(cloud.points) <= 2_000
        # No normal is mixed up with another's point, whatever the noise.
        assert ((cloud.points / 2 * cloud.normals).sum(axis=1) > 0.8).all()


def test_missing_pcpnet_files_are_named(pcpnet):
    with pytest.raises(InputError, match=r"absent\.txt: no such list"):
        PcpnetFolder(pcpnet, "absent.txt")
    (pcpnet / "list.txt").write_text("ball\nghost\nspirit\n")
    with pytest.raises(InputError, match=r"list\.txt.*ghost, spirit"):
        PcpnetFolder(pcpnet, "list.txt")
    (pcpnet / "empty.txt").write_text("\n")
    with pytest.raises(InputError, match=r"empty\.txt: holds no clouds"):
        PcpnetFolder(pcpnet, "empty.txt")


@pytest.mark.parametrize(
    ("suffix", "content", "message"),
    [
        ("normals", "0 0 1\n1 0 0\n", "2 normals for 40 points"),
        ("normals", "0 0 1\n0 0 0\n" + "1 0 0\n" * 38, "row 2 has no direction"),
        ("xyz", "0 0 1\n1 2\n", "columns changed"),
        ("xyz", "0 0 1\n1 2 nan\n", "3 finite numbers per row"),
        ("xyz", "0 0\n1 2\n", "3 finite numbers per row"),
        ("xyz", "a b c\n", "could not convert"),
        ("pidx", "0\n40\n", "index is not among the 40 points"),
    ],
)
def test_mismatched_pcpnet_files_are_named(pcpnet, suffix, content, message):
    (pcpnet / f"ball.{suffix}").write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        PcpnetFolder(pcpnet).cloud(0, 1, 0)
    assert f"ball.{suffix}" in str(caught.value)


def test_mesh_clouds_depend_on_seed_epoch_and_index_alone(meshes):
    source = MeshFolder(meshes, clouds_per_epoch=4, points=500)
    cloud = source.cloud(2, 3, 7)
    source.cloud(0, 0, 7)
    assert_same(cloud, source.cloud(2, 3, 7))
    assert_same(cloud, MeshFolder(meshes, clouds_per_epoch=4, points=500).cloud(2, 3, 7))
    for other in (source.cloud(3, 3, 7), source.cloud(2, 2, 7), source.cloud(2, 3, 8)):
        assert not np.array_equal(cloud.points[:10], other.points[:10])


def test_mesh_clouds_are_labeled_outward_and_vary_in_size(meshes, monkeypatch):
    monkeypatch.setattr(corruption, "RIDGES_SHARE", 0)
    source = MeshFolder(meshes, clouds_per_epoch=4, points=500)
    sizes = set()
    for index in range(40):
        cloud = source.cloud(*divmod(index, 4), 0)
        center = 10 * "abc".index(cloud.name[0])
        assert 250 // 2 <= len(cloud.points) <= 500
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1)
        distance = ((cloud.points - center) * cloud.normals).sum(axis=1)  # of a face from the center: 1 / sqrt(3)
        np.testing.assert_allclose(distance, 1 / np.sqrt(3), atol=6 * 1.3 * 0.012 * np.sqrt(12))
        sizes.add(len(cloud.points))
    assert len(sizes) > 20


def test_each_mesh_is_drawn_equally_often(meshes):
    source = MeshFolder(meshes, clouds_per_epoch=4, points=50)
    names = [source.cloud(*divmod(index, 4), 0).name[0] for index in range(12)]
    assert sorted(names) == sorted("abc" * 4)
    assert all(set(names[tour : tour + 3]) == set("abc") for tour in range(0, 12, 3))


def test_bad_mesh_is_named(meshes):
    np.savez(meshes / "d.npz", vertices=TETRAHEDRON, faces=FACES + 9)
    source = MeshFolder(meshes, clouds_per_epoch=4, points=50)
    with pytest.raises(InputError, match=r"d\.npz"):
        for index in range(4):
            source.cloud(0, index, 0)


def test_solids_are_drawn_anew_and_repeatably():
    source = SyntheticSolids(clouds_per_epoch=3, points=300)
    clouds = [source.cloud(0, index, 5) for index in range(3)]
    assert_same(clouds[1], SyntheticSolids(clouds_per_epoch=3, points=300).cloud(0, 1, 5))
    assert not np.array_equal(clouds[0].points[:5], clouds[1].points[:5])
    assert all(np.isfinite(cloud.points).all() for cloud in clouds)


class Counting:
    """A source whose clouds say which they are."""

    def __init__(self, name, clouds_per_epoch):
        self.name, self.clouds_per_epoch = name, clouds_per_epoch

    def cloud(self, epoch, index, seed):
        assert 0 <= index < self.clouds_per_epoch
        return LabeledCloud(f"{self.name}{epoch}.{index}", np.full((1, 3), float(seed)), np.zeros((1, 3)))


def names(mixture, epoch):
    return [mixture.cloud(epoch, index, 0).name for index in range(mixture.clouds_per_epoch)]


def test_mixture_interleaves_whole_epochs():
    mixture = Mixture([Counting("a", 4), Counting("b", 2)])
    assert mixture.clouds_per_epoch == 6
    drawn = names(mixture, 3)
    assert sorted(drawn) == ["a3.0", "a3.1", "a3.2", "a3.3", "b3.0", "b3.1"]
    assert [name for name in drawn if name[0] == "a"] == ["a3.0", "a3.1", "a3.2", "a3.3"]
    assert {name[0] for name in drawn[:3]} == {name[0] for name in drawn[3:]} == {"a", "b"}


def test_mixture_follows_weights_and_walks_through_its_sources():
    mixture = Mixture([Counting("a", 4), Counting("b", 4)], weights=[3, 1])
    drawn = names(mixture, 0) + names(mixture, 1)
    assert [name for name in drawn if name[0] == "a"] == [f"a{i // 4}.{i % 4}" for i in range(12)]
    assert [name for name in drawn if name[0] == "b"] == [f"b0.{i}" for i in range(4)]


def test_sources_of_a_mixture_have_their_own_seeds():
    mixture = Mixture([Counting("a", 2), Counting("b", 2)])
    seeds = {(cloud := mixture.cloud(0, index, 0)).name[0]: cloud.points[0, 0] for index in range(4)}
    assert seeds["a"] != seeds["b"]


@pytest.mark.parametrize("weights", [[1], [1, 0], [1, 2, 3], [1, 1e-6]])
def test_unusable_weights_are_refused(weights):
    with pytest.raises(UsageError):
        Mixture([Counting("a", 2), Counting("b", 2)], weights)


def test_folders_are_opened_by_what_lies_in_them(pcpnet, meshes):
    assert isinstance(open_dataset([meshes]), MeshFolder)
    assert isinstance(open_dataset([], synthetic=True), SyntheticSolids)
    assert open_dataset([pcpnet]).names == ["box_noise_white_1.00e-02", "ball"]
    (pcpnet / "one.txt").write_text("ball\n")
    assert open_dataset([pcpnet], list_file="one.txt").names == ["ball"]
    (pcpnet / "trainingset_whitenoise.txt").unlink()
    assert open_dataset([pcpnet]).names == ["ball", "box_noise_white_1.00e-02"]
    mixture = open_dataset([pcpnet, meshes], synthetic=True, clouds_per_epoch=5, points=60)
    assert mixture.clouds_per_epoch == 2 + 5 + 5


def test_unusable_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        open_dataset([tmp_path / "absent"])
    with pytest.raises(InputError, match="neither PCPNet clouds"):
        open_dataset([tmp_path])
    with pytest.raises(InputError, match="holds no meshes"):
        MeshFolder(tmp_path)
    with pytest.raises(UsageError, match="no training data"):
        open_dataset([])


def test_scanned_surfaces_are_a_pure_function(tmp_path):
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    np.savez(tmp_path / "wedge.npz", vertices=vertices, faces=np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
    source = ScannedSurfaces([tmp_path], clouds_per_epoch=3, points=2000)
    assert {source.cloud(0, index, 1).name.split("_")[0] for index in range(20)} > {"wedge", "solid"}
    cloud = source.cloud(2, 1, seed=5)
    again = ScannedSurfaces([tmp_path], clouds_per_epoch=3, points=2000).cloud(2, 1, seed=5)
    np.testing.assert_array_equal(cloud.points, again.points)
    assert cloud.name == again.name and cloud.name.split("_")[1] in FAMILIES
    assert cloud.sensors.shape == cloud.points.shape and cloud.labeled.shape == (len(cloud.points),)
    other = source.cloud(2, 2, seed=5)
    assert other.points.shape != cloud.points.shape or not np.array_equal(other.points, cloud.points)


def test_scanned_surfaces_need_meshes(tmp_path):
    with pytest.raises(InputError, match="holds no meshes"):
        ScannedSurfaces([tmp_path])


def test_scans_of_the_mesh_folders_are_one_more_source(tmp_path):
    np.savez(tmp_path / "wedge.npz", vertices=TETRAHEDRON, faces=FACES)
    source = open_dataset([tmp_path], synthetic=True, scans=True, weights=[1, 1, 2], clouds_per_epoch=4, points=1000)
    clouds = [source.cloud(0, index, 1) for index in range(source.clouds_per_epoch)]
    assert [cloud.sensors is not None for cloud in clouds].count(True) == 6
    assert any(cloud.name.startswith("wedge_") for cloud in clouds if cloud.sensors is not None)
