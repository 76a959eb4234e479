from __future__ import annotations

import io
import re
import subprocess
import sys

import numpy as np
import pytest

from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError, ResourceError, UsageError
from jetnormal.formats import all_formats, check_target, read, suffixes, write
from jetnormal.formats.registry import CONVERSIONS

NORMALS = np.array([[0.0, 0, 1], [0, 0.6, 0.8], [np.nan, np.nan, np.nan]])
TARGETS = [
    ("a.ply", "ascii"),
    ("a.ply", "binary_little_endian"),
    ("a.ply", "binary_big_endian"),
    ("a.pcd", "ascii"),
    ("a.pcd", "binary"),
    ("a.pcd", "binary_compressed"),
    *[(f"a{suffix}", "ascii") for suffix in (".xyz", ".txt", ".asc", ".csv", ".pts")],
]


def colored_cloud() -> Cloud:
    points = np.array([[1 / 3, 5e6 + 0.125, -1e-9], [0, 1, 2], [np.nan, np.nan, np.nan]])
    colors = {name: np.array([low, 100, 255], np.uint8) for low, name in enumerate(("red", "green", "blue"))}
    source = Source(normal_dtype=np.dtype("f8"))
    return Cloud(points, NORMALS, {**colors, "label": np.array([-3, 7, 70000], "i4")}, source)


@pytest.mark.parametrize(("first", "first_encoding"), TARGETS)
@pytest.mark.parametrize(("second", "second_encoding"), TARGETS)
def test_any_format_becomes_any_other(tmp_path, first, first_encoding, second, second_encoding):
    """Points, normals, colors and labels go through both; only the nameless PTS columns change their names."""
    cloud = colored_cloud()
    write(cloud, tmp_path / first, encoding=first_encoding)
    target = tmp_path / f"second_{second}"
    write(read(tmp_path / first), target, encoding=second_encoding)
    again = read(target)
    assert again.source.encoding == second_encoding
    assert again.points.tobytes() == cloud.points.tobytes()
    np.testing.assert_array_equal(again.normals, NORMALS)
    if ".pts" in first + second:
        return
    np.testing.assert_array_equal(again.attributes["label"], [-3, 7, 70000])
    if second == "a.pcd":
        packed = again.attributes["rgb"].view(np.uint32)
        assert packed.tolist() == [0x000102, 0x646464, 0xFFFFFF]
    else:
        for name in ("red", "green", "blue"):
            assert again.attributes[name].dtype == np.uint8
            np.testing.assert_array_equal(again.attributes[name], cloud.attributes[name])


WRITABLE = [suffix for known in all_formats() if known.write for suffix in known.suffixes]


@pytest.mark.parametrize("suffix", WRITABLE)
def test_every_format_holds_a_cloud(tmp_path, suffix):
    """A format that is added is tested here without being named: coordinates, normals, and attributes by name."""
    rng = np.random.default_rng(0)
    points = np.round(rng.uniform(-9, 9, (40, 3)), 4)
    normals = rng.normal(size=(40, 3)).astype(np.float32).astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    attributes = {"label": np.arange(40, dtype=np.int32) - 7, "quality": rng.random(40).astype(np.float32)}
    path = tmp_path / f"a{suffix}"
    warnings = write(Cloud(points, normals, attributes), path)
    assert all(str(path) in warning for warning in warnings)
    again = read(path)
    np.testing.assert_allclose(again.points, points, rtol=0, atol=1e-9)
    np.testing.assert_allclose(again.normals, normals, atol=1e-7)
    if suffix != ".pts":  # which has no place for names
        for name, values in attributes.items():
            if name in again.attributes:
                np.testing.assert_allclose(again.attributes[name], values, rtol=1e-7)
            else:
                assert any(name in warning for warning in warnings)
    write(again, tmp_path / f"b{suffix}")
    np.testing.assert_allclose(read(tmp_path / f"b{suffix}").points, again.points, rtol=1e-15)


@pytest.mark.parametrize("suffix", sorted(CONVERSIONS))
def test_files_that_are_not_read_come_with_advice(tmp_path, suffix):
    with pytest.raises(InputError, match=re.escape(CONVERSIONS[suffix])):
        read(tmp_path / f"scan{suffix}")


@pytest.mark.parametrize(("suffix", "package", "extra"), [(".las", "laspy", "las"), (".e57", "pye57", "e57")])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, suffix, package, extra):
    magic = {".las": b"LASF", ".e57": b"ASTM-E57"}[suffix]
    (tmp_path / f"a{suffix}").write_bytes(magic + bytes(500))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ResourceError, match=rf"a{suffix} needs {package}, but .* pip install 'jetnormal\[{extra}\]'"):
        read(tmp_path / f"a{suffix}")


def test_a_cloud_goes_through_the_standard_streams(tmp_path, monkeypatch):
    for name in ("ply", "laz", "npz"):
        out = io.BytesIO()
        monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(out, write_through=True))
        write(Cloud(np.eye(3)), "-", format=name)
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(out.getvalue())))
        assert np.array_equal(read("-", format=name).points, np.eye(3))
    for action in (read, lambda path: write(Cloud(np.eye(3)), path)):
        with pytest.raises(InputError, match="`format` tells what a stream holds"):
            action("-")
    with pytest.raises(InputError, match="unknown format 'nonesuch'"):
        read("-", format="nonesuch")


def test_opaque_pcl_colors_become_channels(tmp_path):
    rgba = np.array([0xFF102030, 0x80FF0001], "u4")
    cloud = Cloud(np.zeros((2, 3)), None, {"rgba": rgba}, Source(format="pcd"))
    write(cloud, tmp_path / "a.ply")
    again = read(tmp_path / "a.ply")
    channels = {name: values.tolist() for name, values in again.attributes.items()}
    assert channels == {"red": [16, 255], "green": [32, 0], "blue": [48, 1], "alpha": [255, 128]}
    write(again, tmp_path / "b.pcd")
    assert read(tmp_path / "b.pcd").attributes["rgba"].tolist() == rgba.tolist()


def test_what_a_format_cannot_hold_is_reported(tmp_path):
    ragged = np.array([np.array([1, 2]), np.array([3])], object)
    attributes = {"ragged": ragged, "text": np.array(["a", "b"]), "big": np.array([1, 2**63 - 1])}
    source = Source("pcd", "binary", viewpoint=(1, 0, 0, 1, 0, 0, 0), width=1, height=2)
    warnings = write(Cloud(np.zeros((2, 3)), None, attributes, source), tmp_path / "a.xyz")
    assert all(warning.startswith(f"{tmp_path / 'a.xyz'}: ") for warning in warnings)
    for word in ("2 rows of 1 points", "viewpoint", "'ragged'", "'text'"):
        assert sum(word in warning for warning in warnings) == 1, word
    assert len(warnings) == 4
    (again,) = read(tmp_path / "a.xyz").attributes.values()
    assert again.tolist() == [1, 2**63 - 1]


@pytest.mark.parametrize(
    "suffix", sorted({suffix for known in all_formats() if known.write for suffix in known.suffixes})
)
def test_a_latin_1_name_and_a_column_without_values_go_into_any_format(tmp_path, suffix):
    header = "ply\nformat ascii 1.0\nelement vertex 3\n"
    header += "".join(f"property float {name}\n" for name in ("x", "y", "z", "höhe")) + "end_header\n"
    (tmp_path / "a.ply").write_bytes(f"{header}0 0 0 5\n1 0 0 6\n0 1 0 7\n".encode("latin-1"))
    cloud = read(tmp_path / "a.ply")
    cloud.attributes["empty"] = np.empty((3, 0))
    warnings = write(cloud, tmp_path / f"b{suffix}")
    assert any("'empty'" in warning for warning in warnings)
    assert [5, 6, 7] in [values.tolist() for values in read(tmp_path / f"b{suffix}").attributes.values()]


def test_faces_are_missed_in_other_formats(tmp_path):
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment c\nelement vertex 1\nproperty int x\nproperty int y\nproperty int z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n1 2 3\n3 0 0 0\n"
    )
    cloud = read(tmp_path / "a.ply")
    (warning,) = write(cloud, tmp_path / "a.pcd")
    assert "'face' (1 rows)" in warning
    assert read(tmp_path / "a.pcd").source.encoding == "ascii"
    assert len(write(cloud, tmp_path / "a.xyz")) == 2  # the comment too


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".csv"])
def test_attributes_that_bear_the_name_of_a_normal_are_renamed(tmp_path, suffix):
    name = "normal_x" if suffix == ".pcd" else "nx"
    cloud = Cloud(np.zeros((3, 3)), NORMALS, {name: np.arange(3), "a b": np.arange(3) + 0.5})
    warnings = write(cloud, tmp_path / f"a{suffix}")
    assert any(f"{name}_2" in warning for warning in warnings)
    again = read(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(again.normals, NORMALS, atol=1e-7)
    np.testing.assert_array_equal(again.attributes[f"{name}_2"], [0, 1, 2])
    np.testing.assert_array_equal(again.attributes["a_b"], [0.5, 1.5, 2.5])


def test_the_same_cloud_gives_the_same_bytes(tmp_path):
    for name, encoding in TARGETS:
        write(colored_cloud(), tmp_path / f"1{name}", encoding=encoding, overwrite=True)
        write(colored_cloud(), tmp_path / f"2{name}", encoding=encoding, overwrite=True)
        assert (tmp_path / f"1{name}").read_bytes() == (tmp_path / f"2{name}").read_bytes()


def test_binary_stands_for_the_plain_binary_encoding(tmp_path):
    write(Cloud(np.zeros((1, 3))), tmp_path / "a.ply", encoding="binary")
    assert read(tmp_path / "a.ply").source.encoding == "binary_little_endian"


@pytest.mark.parametrize(("name", "encoding"), [("a.ply", "binary_compressed"), ("a.pcd", "zip"), ("a.xyz", "binary")])
def test_an_encoding_that_the_format_does_not_have(tmp_path, name, encoding):
    with pytest.raises(UsageError, match=f"no encoding '{encoding}'"):
        write(Cloud(np.zeros((1, 3))), tmp_path / name, encoding=encoding)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", suffixes())
def test_missing_files_and_folders(tmp_path, suffix):
    with pytest.raises(InputError, match="No such file"):
        read(tmp_path / f"missing{suffix}")
    folder = tmp_path / f"folder{suffix}"
    folder.mkdir()
    with pytest.raises(InputError, match="Is a directory"):
        read(folder)


@pytest.mark.parametrize("name", ["scan.abc", "scan"])
def test_an_unknown_suffix_lists_the_known_ones(tmp_path, name):
    for action in (read, check_target, lambda path: write(Cloud(np.zeros((1, 3))), path)):
        with pytest.raises(InputError, match=r"supported are \.asc \.csv "):
            action(tmp_path / name)


def test_nothing_heavy_is_imported():
    code = "import sys, jetnormal.formats; print({'torch', 'open3d', 'scipy', 'plyfile'} & set(sys.modules))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "set()"
