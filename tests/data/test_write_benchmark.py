from __future__ import annotations

import numpy as np
import pytest

from jetnormal.data import write_benchmark as generation
from jetnormal.data.options import DatasetOptions
from jetnormal.data.sources import PcpnetFolder
from jetnormal.data.write_benchmark import write_dataset
from jetnormal.errors import InputError, UsageError
from jetnormal.formats.pcpnet import CATEGORIES, cloud_names, read_cloud

SMALL = DatasetOptions(points=600, queries=40)


def write_box(path, size):
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float) * size
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in sides for triangle in ((a, b, c), (a, c, d))]
    np.savez(path, vertices=corners, faces=np.array(faces))


@pytest.fixture
def meshes(tmp_path):
    folder = tmp_path / "meshes"
    folder.mkdir()
    write_box(folder / "wide box.npz", [4, 2, 1])
    write_box(folder / "cube.npz", [1, 1, 1])
    return folder


def content(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_every_shape_has_the_six_categories(meshes, tmp_path):
    names = write_dataset(tmp_path / "out", SMALL, meshes=meshes)
    shapes = ["cube", "wide_box"]
    assert sorted(names) == sorted(shape + one.ending for shape in shapes for one in CATEGORIES.values())
    assert cloud_names(tmp_path / "out", None) == sorted(names)
    assert cloud_names(tmp_path / "out", "testset_all.txt") == names
    for category in CATEGORIES.values():
        assert cloud_names(tmp_path / "out", category.list_file) == [shape + category.ending for shape in shapes]
    for name in names:
        points, normals, queries = read_cloud(tmp_path / "out", name)
        assert points.shape == normals.shape == (600, 3)
        assert len(np.unique(queries)) == 40
        assert (np.diff(queries) > 0).all()


def test_noise_displaces_the_clean_points_and_keeps_their_normals(meshes, tmp_path):
    write_dataset(tmp_path / "out", DatasetOptions(points=4000), meshes=meshes)
    clean, normals, _ = read_cloud(tmp_path / "out", "wide_box")
    assert np.isclose(normals, np.round(normals)).all()  # a box's
    for category, sigma in (("low", 0.00125), ("medium", 0.006), ("high", 0.012)):
        noisy, same, _ = read_cloud(tmp_path / "out", "wide_box" + CATEGORIES[category].ending)
        np.testing.assert_array_equal(same, normals)
        assert (noisy - clean).std() == pytest.approx(sigma * np.linalg.norm([4, 2, 1]), rel=0.05)


def test_density_varies_in_the_last_two(tmp_path):
    write_dataset(tmp_path / "out", DatasetOptions(points=4000), solids=1)
    for ending in ("_ddist_minmax", "_ddist_minmax_layers"):
        points, normals, _ = read_cloud(tmp_path / "out", f"solid_001{ending}")
        assert points.shape == (4000, 3)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
        clean, *_ = read_cloud(tmp_path / "out", "solid_001")
        kept = []  # against the clean cloud, in the emptiest tenth along each axis
        for axis in range(3):
            edges = np.linspace(clean[:, axis].min(), clean[:, axis].max(), 11)
            before, after = (np.histogram(cloud[:, axis], edges)[0] for cloud in (clean, points))
            kept.append((after[before > 100] / before[before > 100]).min())
        assert min(kept) < 0.35


def test_the_same_seed_gives_the_same_bytes(meshes, tmp_path):
    folders = [tmp_path / name for name in "abc"]
    for folder, seed in zip(folders, (1, 1, 2), strict=True):
        write_dataset(folder, DatasetOptions(points=50, queries=5, seed=seed), meshes=meshes, solids=1)
    first, same, other = (content(folder) for folder in folders)
    assert first == same
    assert first.keys() == other.keys()
    different = {name for name in first if first[name] != other[name]}
    assert different == {name for name in first if not name.endswith((".txt", "dataset"))}


def test_training_lists_are_those_that_training_knows(tmp_path):
    write_dataset(tmp_path / "out", DatasetOptions(points=50, split="training"), solids=2)
    source = PcpnetFolder(tmp_path / "out")
    assert len(source.names) == 2 * 4
    assert not any("ddist" in name for name in source.names)
    assert len(cloud_names(tmp_path / "out", "trainingset_vardensity_whitenoise.txt")) == 2 * 6
    assert cloud_names(tmp_path / "out", "trainingset_no_noise.txt") == ["solid_001", "solid_002"]
    assert source.cloud(0, 3, 1).points.shape == (50, 3)


def test_an_existing_folder_is_replaced_only_if_asked_and_only_if_it_is_such_a_set(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    write_dataset(folder, SMALL, solids=2)  # an empty one is taken
    before = content(folder)
    with pytest.raises(InputError, match="out: already exists; use `overwrite`"):
        write_dataset(folder, SMALL, solids=1)
    assert content(folder) == before
    write_dataset(folder, SMALL, solids=1, overwrite=True)
    assert len(content(folder)) == 6 * 3 + 7 + 1
    (folder / "scan.xyz").write_text("0 0 0")
    with pytest.raises(InputError, match=r"holds what jetnormal did not write \(scan\.xyz\)"):
        write_dataset(folder, SMALL, solids=1, overwrite=True)
    assert (folder / "scan.xyz").read_text() == "0 0 0"


@pytest.mark.parametrize("title", [None, "", "precious.txt\n"])
def test_only_what_was_written_here_is_replaced(tmp_path, title):
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "precious.txt").write_text("mine")
    if title is not None:
        (folder / generation.MARKER).write_text(title)
    with pytest.raises(InputError, match="did not write"):
        write_dataset(folder, SMALL, solids=1, overwrite=True)
    assert (folder / "precious.txt").read_text() == "mine"


def test_what_appears_in_a_folder_meanwhile_is_not_lost(tmp_path, monkeypatch):
    folder = tmp_path / "out"
    write_dataset(folder, SMALL, solids=1)

    def write_beside(*arguments):
        (folder / "precious.txt").write_text("mine")
        return write_cloud(*arguments)

    write_cloud = generation.write_cloud
    monkeypatch.setattr(generation, "write_cloud", write_beside)
    with pytest.raises(InputError, match=r"precious\.txt"):
        write_dataset(folder, SMALL, solids=1, overwrite=True)
    assert (folder / "precious.txt").read_text() == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("problem", [KeyboardInterrupt, InputError("bad")])
def test_nothing_is_left_half_written(tmp_path, monkeypatch, problem):
    written = []

    def fail_at_the_eighth(*arguments):
        written.append(write_cloud(*arguments))
        if len(written) == 8:
            raise problem

    write_cloud = generation.write_cloud
    monkeypatch.setattr(generation, "write_cloud", fail_at_the_eighth)
    with pytest.raises(problem if isinstance(problem, type) else InputError):
        write_dataset(tmp_path / "out", SMALL, solids=2)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_drawn_from_is_named(meshes, tmp_path):
    with pytest.raises(UsageError, match="nothing to draw"):
        write_dataset(tmp_path / "out", SMALL)
    with pytest.raises(UsageError, match="points is 3 or more, not 2"):
        DatasetOptions(points=2)
    with pytest.raises(InputError, match="absent: no such folder"):
        write_dataset(tmp_path / "out", SMALL, meshes=tmp_path / "absent")
    with pytest.raises(InputError, match="no meshes"):
        write_dataset(tmp_path / "out", SMALL, meshes=tmp_path)
    with pytest.raises(InputError, match="create it first"):
        write_dataset(tmp_path / "absent" / "out", SMALL, solids=1)
    (meshes / "wide_box.npz").write_bytes(b"")
    with pytest.raises(InputError, match=r"would become the shape wide_box, as wide box\.npz"):
        write_dataset(tmp_path / "out", SMALL, meshes=meshes)
    (meshes / "wide box.npz").unlink()
    with pytest.raises(InputError, match=r"wide_box\.npz: not a readable"):
        write_dataset(tmp_path / "out", SMALL, meshes=meshes)
    assert not (tmp_path / "out").exists()
