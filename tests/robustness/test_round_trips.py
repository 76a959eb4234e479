"""Any cloud, written in any format and encoding and read again, is the same cloud, or a warning named the loss."""

from __future__ import annotations

from pathlib import Path

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jetnormal import formats
from jetnormal.cloud import Cloud, Source
from jetnormal.formats.meshes import read_mesh, write_mesh
from jetnormal.mesh import Mesh

SUFFIXES = (".ply", ".pcd", ".xyz", ".txt", ".asc", ".csv", ".pts", ".npy", ".npz")
CASES = [(suffix, encoding) for suffix in SUFFIXES for encoding in formats.find_format(Path(f"a{suffix}")).encodings]
TYPES = ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "f4", "f8"]
NAMES = st.one_of(
    st.sampled_from(["red", "intensity", "label", "curvature", "scalar_A", "time", "a,b", "7", "x_2", "ü"]),
    st.text("abcXYZ019_ ,;\"'#%", min_size=1, max_size=6),
).filter(lambda name: name.strip().lower() not in RESERVED)
# What means coordinates, normals or packed colors is not a free name.
RESERVED = {"x", "y", "z", "nx", "ny", "nz", "rgb", "rgba", "id", "file", "points", "normals"}


DIRECTIONS = np.random.default_rng(0).normal(size=(5, 3))
DIRECTIONS = (DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)).astype(np.float32)


@st.composite
def clouds(draw: st.DrawFn) -> Cloud:
    count = draw(st.integers(1, 5))
    kind = draw(st.sampled_from(["f4", "f8"]))
    finite = {"allow_nan": draw(st.booleans()), "allow_infinity": False, "width": 8 * int(kind[1])}
    points = draw(hnp.arrays(kind, (count, 3), elements=st.floats(**finite)))
    normals = draw(st.none() | st.just(DIRECTIONS[:count]))  # without a header, unit vectors tell what they are
    names = draw(st.lists(NAMES, max_size=3, unique_by=lambda name: "_".join(name.split()).lower()))
    attributes = {name: draw(hnp.arrays(draw(st.sampled_from(TYPES)), count)) for name in names}
    source = Source(point_dtype=np.dtype(kind))
    return Cloud(points, normals, attributes, source)


# The same examples in every run, so that a change is told from chance; `make fuzz` looks for new ones.
SAME_EXAMPLES = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.mark.parametrize(("suffix", "encoding"), CASES)
@SAME_EXAMPLES
@given(cloud=clouds())
def test_a_cloud_comes_back(tmp_path_factory, suffix, encoding, cloud):
    path = tmp_path_factory.mktemp("round") / f"a{suffix}"
    warnings = formats.write(cloud, path, encoding=encoding)
    back = formats.read(path)
    assert len(back) == len(cloud)
    kind = cloud.source.point_dtype  # text has the shortest number that is the same in this type
    assert np.array_equal(back.points.astype(kind), cloud.points.astype(kind), equal_nan=True)
    if cloud.normals is not None:
        assert np.array_equal(back.normals.astype(np.float32), cloud.normals.astype(np.float32), equal_nan=True)
    for name, values in cloud.attributes.items():
        told = [warning for warning in warnings if repr(name) in warning or "names are not kept" in warning]
        if not told:
            assert name in back.attributes, (list(back.attributes), warnings)
            found = back.attributes[name].astype(values.dtype)
            assert np.array_equal(found, values, equal_nan=values.dtype.kind == "f"), warnings


@pytest.mark.parametrize("suffix", [".las", ".laz", ".e57"])
@SAME_EXAMPLES
@given(cloud=clouds())
def test_a_cloud_comes_back_from_what_libraries_write(tmp_path_factory, suffix, cloud):
    """These formats leave out points that are not finite; LAS rounds coordinates to steps of its own."""
    pytest.importorskip("pye57" if suffix == ".e57" else "laspy")
    path = tmp_path_factory.mktemp("round") / f"a{suffix}"
    told = formats.write(cloud, path)
    back, kept = formats.read(path), cloud.valid
    assert len(back) == kept.sum() and (kept.all() or any("are left out" in warning for warning in told))
    for axis, name in enumerate("xyz"):
        there, here = back.points[:, axis], cloud.points[kept, axis]
        largest = np.abs(here).max(initial=0)
        step = 4 * float(np.spacing(largest.astype(cloud.source.point_dtype)))  # as exactly as the type holds it
        if any(f"{name} is rounded" in warning for warning in told):
            step += 1.2e-7 * (1 + largest)  # from the whole number below
        assert np.abs(there - here).max(initial=0) <= step, told
    if cloud.normals is not None:
        assert np.array_equal(back.normals.astype(np.float32), cloud.normals[kept].astype(np.float32))
    for name, values in cloud.attributes.items():
        if not any(repr(name) in warning for warning in told):
            found = back.attributes[name].astype(values.dtype)
            assert np.array_equal(found, values[kept], equal_nan=values.dtype.kind == "f"), told


@st.composite
def meshes(draw: st.DrawFn) -> Mesh:
    count = draw(st.integers(3, 6))
    coordinates = st.floats(-1e6, 1e6, width=32, allow_subnormal=False)
    vertices = draw(hnp.arrays("f8", (count, 3), elements=coordinates, unique=True))
    corners = st.permutations(range(count)).map(lambda order: order[:3])
    faces = draw(st.lists(corners, min_size=1, max_size=6))
    colors = draw(st.none() | hnp.arrays("u1", (count, 3)))
    return Mesh(vertices, np.array(faces), None if colors is None else colors / 255)


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".off", ".glb", ".stl"])
@SAME_EXAMPLES
@given(mesh=meshes())
def test_a_mesh_comes_back(tmp_path_factory, suffix, mesh):
    path = tmp_path_factory.mktemp("round") / f"a{suffix}"
    warnings = write_mesh(mesh, path)
    back = read_mesh(path)
    size = np.ptp(mesh.vertices, axis=0).max()
    assert np.abs(back.vertices[back.faces] - mesh.vertices[mesh.faces]).max() <= 1e-6 * size
    if mesh.colors is not None:
        assert (back.colors is None) == any("no colors" in warning for warning in warnings)
        if back.colors is not None:
            assert np.abs(back.colors[back.faces] - mesh.colors[mesh.faces]).max() < 0.003
