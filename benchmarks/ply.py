"""How long jetnormal and plyfile take for the same PLY files, in CPU seconds.

python benchmarks/ply.py
python benchmarks/ply.py --points 100000 --triangles 40000
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import plyfile

from jetnormal import Cloud, formats
from jetnormal.cloud import Source


def seconds(work: Callable[[], Any]) -> tuple[float, Any]:
    """Run something; return the CPU seconds it took, and its result."""
    started = time.process_time()
    result = work()
    return time.process_time() - started, result


def read_with_plyfile(path: Path) -> plyfile.PlyData:
    """Read every value: plyfile maps binary files into memory and reads them when they are used."""
    data = plyfile.PlyData.read(str(path))
    for name in data["vertex"].data.dtype.names:
        np.array(data["vertex"][name])
    return data


def compare(path: Path, copy: Path, label: str) -> None:
    """Print a row: the file read and written by both."""
    read, cloud = seconds(lambda: formats.read(path))
    write, _ = seconds(lambda: formats.write(cloud, copy, overwrite=True))
    read_other, data = seconds(lambda: read_with_plyfile(path))
    write_other, _ = seconds(lambda: data.write(str(copy)))
    print(f"| {label} | {read:.2f} | {read_other:.2f} | {write:.2f} | {write_other:.2f} |", flush=True)


def write_mesh(path: Path, triangles: int) -> None:
    rng = np.random.default_rng(0)
    vertices = rng.random((triangles // 2, 3)).astype("<f4")
    faces = np.empty(triangles, [("length", "u1"), ("corners", "<i4", 3)])
    faces["length"], faces["corners"] = 3, rng.integers(0, triangles // 2, (triangles, 3))
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
    header += "".join(f"property float {name}\n" for name in "xyz")
    header += f"element face {triangles}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(header.encode() + vertices.tobytes() + faces.tobytes())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--triangles", type=int, default=400_000)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    points = rng.normal(size=(options.points, 3)).astype(np.float32)
    colors = {name: rng.integers(0, 256, options.points).astype(np.uint8) for name in ("red", "green", "blue")}
    cloud = Cloud(points, points, colors, Source(point_dtype=np.dtype(np.float32)))
    print("| file | jetnormal, read | plyfile, read | jetnormal, write | plyfile, write |\n|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        path, copy = Path(folder) / "a.ply", Path(folder) / "b.ply"
        for encoding in ("binary_little_endian", "ascii"):
            formats.write(cloud, path, encoding=encoding, overwrite=True)
            compare(path, copy, f"{options.points:,} points, {encoding}")
        write_mesh(path, options.triangles)
        compare(path, copy, f"{options.triangles:,} triangles, binary")


if __name__ == "__main__":
    main()
