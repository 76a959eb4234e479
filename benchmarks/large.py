"""Clouds larger than memory: a synthetic terrestrial scan of N points, in tiles and at once.

    python benchmarks/large.py [--points 3000000 10000000] [--at-once 3000000] [--max-memory 2GB] [--folder DIR]
        [--options "--model pca --cluster local"]
    python benchmarks/large.py --scan scan.laz --points 100000000     # writes the scan alone

Four stations stand in a yard with walls, houses, columns and balls; noise is 2 mm; distances between neighbors go from
millimeters to meters. The scan is written piece by piece. Each run is a command of its own. Memory is the sum over the
process and its children, without what is only mapped from files; CPU seconds are user and system. Clouds of up to
--at-once points are also computed at once, and both results are compared point by point.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

CHUNK = 250_000  # rays
NOISE = 0.002  # meters, of the range
HEIGHT = 1.7  # meters, of the scanner above the ground
EXTENT = 60.0  # meters, from the middle of the site to its walls
STATIONS = ((0.0, 0.0), (22.0, -14.0), (-25.0, 12.0), (10.0, 30.0))
LOWEST, HIGHEST = -1.2, 1.2  # elevations that the scanner sees


class Site:
    """A yard: ground with some relief, walls around it, houses, columns and balls, from a seed."""

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        count = 14
        middle = rng.uniform(-45, 45, (count, 2))
        free = np.all([np.linalg.norm(middle - station, axis=1) > 9 for station in STATIONS], axis=0)
        middle = middle[free]
        half = rng.uniform(0.5, 5, (len(middle), 3))
        self.boxes = np.concatenate([middle, half[:, 2:]], axis=1), half
        place = rng.uniform(-50, 50, (16, 2))
        self.columns = place, rng.uniform(0.15, 1.0, 16), rng.uniform(3, 12, 16)
        middle = np.column_stack([rng.uniform(-50, 50, (12, 2)), rng.uniform(0.5, 4, 12)])
        self.balls = middle, rng.uniform(0.4, 1.5, 12)

    def hit(self, eye: Floats, rays: Floats) -> Floats:
        """The range (R,) to the first surface along unit rays (R, 3); infinite where there is none."""
        ranges = self._ground(eye, rays)
        with np.errstate(divide="ignore", invalid="ignore"):
            walls = np.min((np.sign(rays[:, :2]) * EXTENT - eye[:2]) / rays[:, :2], axis=1)
            ranges = np.minimum(ranges, np.where(eye[2] + walls * rays[:, 2] < 14, walls, np.inf))
            for middle, half in zip(*self.boxes, strict=True):
                a, b = (middle - half - eye) / rays, (middle + half - eye) / rays
                near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
                ranges = np.where((near < far) & (near > 0), np.minimum(ranges, near), ranges)
        for place, radius, top in zip(*self.columns, strict=True):
            flat = rays[:, :2]
            near = _sphere(eye[:2] - place, flat, np.einsum("ij,ij->i", flat, flat), radius)
            ranges = np.where(eye[2] + near * rays[:, 2] < top, np.minimum(ranges, near), ranges)
        for middle, radius in zip(*self.balls, strict=True):
            ranges = np.minimum(ranges, _sphere(eye - middle, rays, np.ones(len(rays)), radius))
        return ranges

    def _ground(self, eye: Floats, rays: Floats) -> Floats:
        """Newton's steps on a ground of gentle waves."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            ranges = np.where(rays[:, 2] < -1e-3, -eye[2] / rays[:, 2], np.inf)
            for _ in range(4):
                place = eye + np.where(np.isfinite(ranges), ranges, 0)[:, None] * rays
                ranges = ranges - (place[:, 2] - height(place[:, 0], place[:, 1])) / rays[:, 2]
        return np.where((rays[:, 2] < -1e-3) & (ranges > 0), ranges, np.inf)


def height(x: Floats, y: Floats) -> Floats:
    """The ground at places (N,)."""
    return 0.1 * np.sin(0.4 * x) * np.cos(0.3 * y) + 0.01 * np.sin(5 * x + y)


def _sphere(offset: Floats, rays: Floats, square: Floats, radius: float) -> Floats:
    """The nearer range (R,) where rays enter a ball, or in two dimensions a cylinder; infinite where they do not."""
    along, apart = rays @ offset, float(offset @ offset) - radius**2
    with np.errstate(invalid="ignore", divide="ignore"):
        near = (-along - np.sqrt(along**2 - square * apart)) / square
    return np.where(near > 0, near, np.inf)


def scan(points: int, seed: int = 1) -> Iterator[Floats]:
    """Yield chunks (n, 3) of a scan of a site from four stations, column by column, `points` in all."""
    site, left = Site(seed), points
    for number, (x, y) in enumerate(STATIONS):
        eye = np.array([x, y, float(height(np.float64(x), np.float64(y))) + HEIGHT])
        wanted = left // (len(STATIONS) - number)
        left -= wanted
        yield from _station(site, eye, wanted, np.random.default_rng((seed, number)))


def _station(site: Site, eye: Floats, wanted: int, rng: np.random.Generator) -> Iterator[Floats]:
    """A full turn of the scanner, at a step of angles that gives at least as many points; what is over is left out."""
    tried = _rays(rng.uniform(0, 2 * np.pi, 20_000), rng.uniform(LOWEST, HIGHEST, 20_000))
    share = np.isfinite(site.hit(eye, tried)).mean()
    step = np.sqrt(2 * np.pi * (HIGHEST - LOWEST) * share / (1.02 * wanted))
    rows = int((HIGHEST - LOWEST) / step)
    columns, chunk = int(2 * np.pi / step) + 1, max(1, CHUNK // rows)
    done = 0
    for start in range(0, columns, chunk):
        azimuth, elevation = np.meshgrid(
            step * (0.5 + np.arange(start, min(start + chunk, columns))), LOWEST + step * np.arange(rows), indexing="ij"
        )
        rays = _rays(azimuth.ravel(), elevation.ravel())
        ranges = site.hit(eye, rays)
        seen = np.isfinite(ranges)
        measured = ranges[seen] + rng.normal(scale=NOISE, size=int(seen.sum()))
        found = (eye + measured[:, None] * rays[seen])[: wanted - done]
        done += len(found)
        yield found
        if done == wanted:
            return
    raise RuntimeError(f"the scanner saw {done} points instead of {wanted}")


def _rays(azimuth: Floats, elevation: Floats) -> Floats:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=1)


def write_scan(path: Path, points: int) -> None:
    """Write the scan as LAS or LAZ, in steps of 0.1 mm, or as PLY."""
    if path.suffix == ".ply":
        with path.open("wb") as stream:
            head = ["ply", "format binary_little_endian 1.0", f"element vertex {points}"]
            stream.write("\n".join([*head, *(f"property double {axis}" for axis in "xyz"), "end_header\n"]).encode())
            for chunk in scan(points):
                stream.write(np.ascontiguousarray(chunk, "<f8").tobytes())
        return
    import laspy

    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, 1e-4)
    with laspy.open(path, mode="w", header=header) as writer:
        for chunk in scan(points):
            record = laspy.ScaleAwarePointRecord.zeros(len(chunk), header=header)
            record.x, record.y, record.z = chunk.T
            writer.write_points(record)


def run(source: Path, target: Path, limit: str, options: list[str]) -> dict[str, Any]:
    """Run the command on a file; return its summary with seconds of CPU, and its memory in bytes at the peak."""
    command = [sys.executable, "-m", "jetnormal", "estimate", str(source), "-o", str(target), "--force", "--json"]
    command += ["--max-memory", limit, *options]
    start = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        memory, status = 0, None
        while status is None:
            memory = max(memory, sum(map(held_by, family(process.pid))))
            time.sleep(0.2)
            pid, ended, used = os.wait4(process.pid, os.WNOHANG)
            status = ended if pid else None
        assert process.stdout is not None
        summary: dict[str, Any] = json.loads(process.stdout.read())
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)} failed")
    return summary | {"wall": time.perf_counter() - start, "cpu": used.ru_utime + used.ru_stime, "memory": memory}


def family(pid: int) -> list[int]:
    """A process and all that it has begun."""
    found = [pid]
    for parent in found:
        with suppress(OSError):
            for task in Path(f"/proc/{parent}/task").iterdir():
                found += map(int, (task / "children").read_text().split())
    return found


def held_by(pid: int) -> int:
    """Bytes of memory that are a process's own."""
    with suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("RssAnon:"):
                return int(line.split()[1]) * 1024
    return 0


def report(points: int, how: str, found: dict[str, Any]) -> None:
    """Print a row of the table."""
    tiles = found.get("tiles", {})
    stages = ", ".join(f"{name} {seconds:.0f}" for name, seconds in found["seconds"].items())
    millions = points / 1e6
    cells = [f"{points:,}", how, tiles.get("count", 1), f"{found['wall']:.0f}", f"{found['cpu'] / millions:.1f}"]
    cells += [f"{found['memory'] / 1e9:.2f}", f"{tiles.get('bytes_on_disk', 0) / 1e9:.2f}", stages]
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def compare(first: Path, second: Path) -> str:
    """Tell how far the normals of two files differ."""
    from jetnormal.formats import read
    from jetnormal.geometry.metrics import angles

    a, b = read(first).normals, read(second).normals
    assert a is not None and b is not None
    both = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
    angle = angles(a[both], b[both])
    same = (np.einsum("ij,ij->i", a[both], b[both]) > 0).mean()
    shares = " ".join(f"{np.quantile(angle, q):.3f}" for q in (0.5, 0.9, 0.99, 0.999, 1))
    rms = float(np.sqrt(np.square(angle).mean()))
    return f"rms {rms:.4f} degrees (at 50 90 99 99.9 100 %: {shares}), signs equal for {100 * same:.3f} %"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--points", type=int, nargs="+", default=[3_000_000])
    parser.add_argument("--at-once", type=int, default=3_000_000)
    parser.add_argument("--max-memory", default="2GB")
    parser.add_argument("--options", type=shlex.split, default=[], help="of the command, such as '--model pca'")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()))
    parser.add_argument("--scan", type=Path, default=None)
    arguments = parser.parse_args()
    if arguments.scan is not None:
        write_scan(arguments.scan, arguments.points[0])
        return
    print("| points | how | tiles | wall s | CPU s per million | memory GB | disk GB | seconds by stage |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    notes = []
    for points in arguments.points:
        source, tiled, whole = (arguments.folder / f"{name}_{points}.las" for name in ("scan", "tiled", "whole"))
        if not source.exists():
            write_scan(source, points)
        if points <= arguments.at_once:
            report(points, "at once", run(source, whole, "1000GB", arguments.options))
        report(points, "in tiles", run(source, tiled, arguments.max_memory, arguments.options))
        if points <= arguments.at_once:
            notes.append(f"{points:,} points, tiles against the whole: {compare(tiled, whole)}")
    print("\n".join(["", *notes]))


if __name__ == "__main__":
    main()
