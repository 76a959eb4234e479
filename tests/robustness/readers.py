"""What reads files that others wrote, each with some valid files to damage."""

from __future__ import annotations

import base64
import importlib
import json
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jetnormal import formats
from jetnormal.cloud import Cloud, Source
from jetnormal.errors import InputError
from jetnormal.formats.meshes import read_mesh, write_mesh
from jetnormal.mesh import Mesh

POINTS = np.random.default_rng(0).normal(size=(9, 3)).round(3)
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes:
        suffix: of its files.
        seeds: makes valid files in an empty folder, and returns their contents.
        read: reads a file; whatever else than a JetnormalError it raises is a fault.
        needs: library without which it cannot work.
        bound: MB that it may take for a file of a few kB.
    """

    suffix: str
    seeds: Callable[[Path], list[bytes]]
    read: Callable[[Path], Any]
    needs: str = "numpy"
    bound: int = 200

    @property
    def available(self) -> bool:
        try:
            importlib.import_module(self.needs)
        except ImportError:
            return False
        return True


def cloud(normals: bool, colors: bool) -> Cloud:
    attributes: dict[str, Any] = {}
    if colors:
        attributes |= {name: np.arange(9, dtype=np.uint8) for name in ("red", "green", "blue")}
        attributes |= {"intensity": np.linspace(0, 1, 9, dtype=np.float32), "label": np.arange(9, dtype=np.int32)}
    source = Source(point_dtype=np.dtype(np.float32))
    return Cloud(POINTS.astype(np.float32), POINTS if normals else None, attributes, source)


def cloud_seeds(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        contents = [content.encode() for content in EXTRA.get(suffix, ())]
        for normals, colors in ((False, False), (True, True)):
            for encoding in formats.find_format(Path(f"a{suffix}")).encodings:
                path = folder / f"{len(contents)}{suffix}"
                formats.write(cloud(normals, colors), path, encoding=encoding)
                contents.append(path.read_bytes())
        return contents

    return make


def read_and_write(path: Path) -> None:
    """Whatever can be read can be written again; in pieces, if it can be read so, it has as many points."""
    found = formats.read(path)
    formats.write(found, path.with_name(f"again{path.suffix}"), overwrite=True)
    with suppress(InputError):  # not every file can
        pieces = list(formats.open_stream(path).pieces(4))
        assert len(found) == sum(map(len, pieces))


def mesh_seeds(suffix: str) -> Callable[[Path], list[bytes]]:
    def make(folder: Path) -> list[bytes]:
        contents = [content.encode() for content in EXTRA.get(suffix, ())]
        for colors in (None, np.linspace(0, 1, 12).reshape(4, 3)):
            path = folder / f"{len(contents)}{suffix}"
            if suffix == ".npz":
                np.savez(path, vertices=POINTS[:4], faces=FACES)
            elif suffix != ".gltf":
                write_mesh(Mesh(POINTS[:4], FACES, colors), path)
            if path.exists():
                contents.append(path.read_bytes())
        return contents

    return make


def gltf() -> str:
    content = POINTS[:4].astype("<f4").tobytes() + FACES.astype("<u4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(content).decode()
    return json.dumps({
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"children": [1], "rotation": [0, 0, 0, 1]}, {"mesh": 0, "translation": [1, 2, 3]}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(content), "uri": uri}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 48}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 12, "type": "SCALAR"},
        ],
    })  # fmt: skip


EXTRA = {
    ".ply": (
        "ply\nformat ascii 1.0\ncomment made\nobj_info hi\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property double z\nproperty uchar red\nproperty list uchar int idx\nelement face 2\n"
        "property list uchar int vertex_indices\nproperty uchar flag\nend_header\n"
        "0 0 0 1 0\n1 0 0 2 1 0\n1 1 0 3 2 0 1\n0 1 0 4 0\n3 0 1 2 7\n4 0 1 2 3 8\n",
    ),
    ".obj": (
        "# a square\nmtllib none.mtl\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nvt 0 0\ng b\n"
        "f 1/1/1 2/1/1 3/1/1\nf 1//1 3//1 4//1\nf -4 -3 -2 -1\n",
    ),
    ".stl": (
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 1 1 0\nendloop\nendfacet\n"
        "endsolid a\n",
    ),
    ".off": ("OFF # square\n4 1 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3 255 0 0\n",),
    ".gltf": (gltf(),),
    ".csv": ("x;y;z;Intensity\n1,5;2,5;3,5;7\n4,5;5,5;6,5;8\n7,5;8,5;9,5;9\n",),
    ".txt": ("# comment\n//X Y Z R G B\n3\n1.0 2.0 3.0 255 0 0\n4 5 6 0 255 0\n7 8 9 0 0 255\n",),
}  # fmt: skip


def pcpnet_seeds(_: Path) -> list[bytes]:
    return [b"\n".join(b"%g %g %g" % tuple(row) for row in POINTS.tolist()) + b"\n", b"0\n3\n8\n"]


def read_pcpnet(path: Path) -> None:
    from jetnormal.formats.pcpnet import read_cloud

    content = path.read_bytes()
    valid = pcpnet_seeds(path.parent)[0]
    damaged = "normals" if b" " in content.partition(b"\n")[0] else "pidx"
    for suffix in ("xyz", "normals", "pidx"):
        if suffix == damaged or suffix != "pidx":
            path.with_name(f"cloud.{suffix}").write_bytes(content if suffix == damaged else valid)
        else:
            path.with_name("cloud.pidx").unlink(missing_ok=True)
    read_cloud(path.parent, "cloud")


def ptx_seeds(_: Path) -> list[bytes]:
    poses = ("0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1",
             "5 6 7\n0 1 0\n-1 0 0\n0 0 1\n0 1 0 0\n-1 0 0 0\n0 0 1 0\n5 6 7 1")  # fmt: skip
    grid = "\n".join(f"{x:g} {y:g} {z:g} 0.5" for x, y, z in POINTS)
    colors = "\n".join(f"{x:g} {y:g} {z:g} 0.5 255 0 9" for x, y, z in POINTS)
    return [f"3\n3\n{poses[0]}\n{colors}\n".encode(), f"3\n3\n{poses[0]}\n{grid}\n9\n1\n{poses[1]}\n{grid}\n".encode()]


def kitti_seeds(_: Path) -> list[bytes]:
    return [np.pad(POINTS, ((0, 0), (0, 1))).astype("<f4").tobytes()]


def read_kitti(path: Path) -> None:
    formats.read(path, format="kitti")


def kept_seeds(folder: Path) -> list[bytes]:
    from jetnormal.evaluation.store import Estimate, ResultStore

    path = folder / "kept.npz"
    ResultStore(folder).save(path, Estimate(POINTS.astype(np.float32), 9, 0.5))
    return [path.read_bytes()]


def read_kept(path: Path) -> None:
    from jetnormal.evaluation.store import ResultStore

    ResultStore(path.parent).load(path, 9)


def model_seeds(folder: Path) -> list[bytes]:
    import torch

    from jetnormal.networks.checkpoint import save_model
    from jetnormal.networks.cloudfit.network import CloudFit, CloudFitConfig
    from jetnormal.networks.patchfit.network import PatchFit, PatchFitConfig

    torch.manual_seed(0)
    small = CloudFitConfig(channels=(2, 2, 2), hidden=2, up_layers=(1, 1, 1), down_layers=(1, 1, 1))
    for number, network in enumerate((CloudFit(small), PatchFit(PatchFitConfig(neighbors=16, width=0.02, light=True)))):
        save_model(folder / f"{number}.safetensors", network, {"rmse": 9.5})
    return [path.read_bytes() for path in sorted(folder.glob("*.safetensors"))]


def read_model(path: Path) -> None:
    from jetnormal.networks.checkpoint import load_model

    load_model(path)


NEEDED = {"las": "laspy", "laz": "lazrs", "e57": "pye57"}  # their compiled code may end the process
WRITTEN = [suffix for known in formats.all_formats() if known.write for suffix in known.suffixes]
CLOUDS = {
    suffix[1:]: Reader(suffix, cloud_seeds(suffix), read_and_write) for suffix in WRITTEN if suffix[1:] not in NEEDED
}
LIBRARIES = {
    name: Reader(f".{name}", cloud_seeds(f".{name}"), read_and_write, library) for name, library in NEEDED.items()
}
MESHES = {f"mesh {suffix[1:]}": Reader(suffix, mesh_seeds(suffix), read_mesh) for suffix in (
    ".ply", ".obj", ".stl", ".off", ".glb", ".gltf", ".npz",
)}  # fmt: skip
OTHERS = {
    "ptx": Reader(".ptx", ptx_seeds, formats.read),
    "kitti": Reader(".bin", kitti_seeds, read_kitti),
    "pcpnet": Reader(".txt", pcpnet_seeds, read_pcpnet),
    "kept result": Reader(".npz", kept_seeds, read_kept),
    "model": Reader(".safetensors", model_seeds, read_model),
}
READERS: dict[str, Reader] = CLOUDS | MESHES | OTHERS | LIBRARIES
