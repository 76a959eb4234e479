"""Signs of scans from inside (rooms, streets) and of objects, by "auto": right or wrong, with and without a warning.

    python benchmarks/inside.py [--scenes 8] [--objects 30] [--meshes FOLDER]
    python benchmarks/inside.py --fit --seed 1 --scenes 40 --objects 100

Scenes and objects are drawn at random and scanned by all virtual scanners; objects are sampled, too. Some clouds are
thinned by voxels, cut, made noisy, or uneven. Directions are those of the default model, signs those of "auto", without
the places of sensors. `--fit` prints the weights of the evidence (`orientation.inside`) that fit best to these clouds.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from jetnormal.cloud import Source
from jetnormal.data.mesh_sampler import MeshSampler, load_mesh
from jetnormal.data.scanners.draw import FAMILIES, scan
from jetnormal.data.scanners.scenes import SCENE_SCANNERS, SceneTarget
from jetnormal.data.scanners.targets import MeshTarget, SolidTarget, Target
from jetnormal.data.scenes import furniture, outdoors
from jetnormal.data.scenes.draw import SCENES, random_scene
from jetnormal.data.scenes.layout import Scene
from jetnormal.data.scenes.rooms import room
from jetnormal.data.scenes.surfaces import Piece, Rng, box, frustum, joined, star, turned
from jetnormal.data.solids.draw import random_solid
from jetnormal.data.solids.starshaped import Superellipsoid
from jetnormal.data.sources import meshes_in
from jetnormal.estimators.factory import make_estimator
from jetnormal.jobs.options import DEFAULT_MODEL
from jetnormal.mesh import Mesh
from jetnormal.orientation.auto import OPEN_SHARE
from jetnormal.orientation.inside import CLOSED, OPEN, Evidence, find_evidence
from jetnormal.orientation.methods import choose_signs
from jetnormal.orientation.policy import settle

Row = tuple[str, str, tuple[bool, bool]]  # kind, variant and outcome
Example = tuple[Evidence, float]  # and whether places inside should decide
Cloud = tuple[str, np.ndarray, np.ndarray]  # kind, points (N, 3), true normals (N, 3), 0 where a point is on no surface
POINTS = 8_000, 40_000
VARIANTS = {"as it is": 0.35, "voxels": 0.3, "cut": 0.15, "noise": 0.1, "uneven": 0.1}
RIGHT = 0.85  # of the points
RIDGE = 0.5
PRIOR = 1 / 12  # share of scans from inside among all clouds
OBJECTS = ("object", "mesh")


def flat(rng: Rng) -> Scene:
    """Two to five rooms side by side."""
    pieces, stands, x = [], [], 0.0
    for _ in range(rng.integers(2, 6)):
        one = room(rng)
        place = np.array([x - one.surface.vertices[:, 0].min(), rng.uniform(-1, 1), 0.0])
        pieces.append(one.surface.placed(place, 0.0))
        stands.append(one.stands[:4] + np.append(place[:2], 0))
        x += float(np.ptp(one.surface.vertices[:, 0])) + rng.uniform(0.05, 0.4)
    places = rng.permutation(np.concatenate(stands))
    return Scene("room", joined(pieces), places, places[[0, -1]])


def crate(rng: Rng) -> Piece:
    """A box with walls, open at the top or at a side."""
    x, y, z = rng.uniform(0.5, 2, 3)
    thick = rng.uniform(0.02, 0.12) * min(x, y)
    sides = [box([thick, y, z], [x / 2, 0, 0]), box([thick, y, z], [-x / 2, 0, 0]), box([x, thick, z], [0, y / 2, 0])]
    last = box([x, thick, z], [0, -y / 2, 0]) if rng.random() < 0.5 else box([x, y, thick], [0, 0, z - thick])
    return joined([box([x, y, thick]), *sides, last])


def vessel(rng: Rng) -> Piece:
    """A pot, or a pipe open at both ends."""
    radius, height = rng.uniform(0.4, 1), rng.uniform(0.3, 3)
    inner = radius * rng.uniform(0.7, 0.97)
    if rng.random() < 0.5:
        return turned([radius, radius, inner, inner, radius], [0, height, height, 0, 0])
    return turned([0, radius, radius, inner, inner, 0], [0, 0, height, height, 0.1 * radius, 0.1 * radius])


def convex(rng: Rng) -> Piece:
    """A block, a plate, a cylinder or an egg."""
    kind = rng.integers(4)
    if kind == 0:
        return box(rng.uniform(0.3, 3, 3))
    if kind == 1:
        return box([*rng.uniform(0.5, 2, 2), rng.uniform(0.01, 0.06)])
    if kind == 2:
        return frustum([0, 0, 0], [0, 0, rng.uniform(0.2, 4)], rng.uniform(0.3, 1))
    return star(Superellipsoid(rng.uniform(0.4, 1, 3), rng.uniform(1.5, 9)), [0, 0, 0], 1.0)


def hollow(rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """Points on something convex and on the wall of a cavity in it, which may be denser or sparser; their normals."""
    piece = convex(rng)
    mesh = MeshSampler(Mesh(piece.vertices, piece.faces), piece.normals[piece.faces])
    outer, inner = mesh.sample(count(rng), rng), mesh.sample(count(rng), rng)
    middle = outer[0].mean(axis=0)
    cavity = middle + rng.uniform(0.3, 0.9) * (inner[0] - middle)
    return np.concatenate([outer[0], cavity]), np.concatenate([outer[1], -inner[1]])


THINGS = (
    crate, vessel, convex, convex, furniture.table, furniture.chair, furniture.sofa, furniture.shelf, furniture.cabinet,
    furniture.bed, furniture.tub, furniture.steps, furniture.tank, outdoors.car, outdoors.house,
)  # fmt: skip


def scans(kind: str, target: Target, scanners: list[str], rng: Rng) -> Iterator[Cloud]:
    """A cloud of each scanner that sees something."""
    for scanner in scanners:
        try:
            seen = scan(target, scanner, count(rng), rng)
        except ValueError:
            continue
        yield kind, seen.points, np.where(seen.labeled[:, None], seen.normals, 0)


def count(rng: Rng) -> int:
    return int(np.exp(rng.uniform(*np.log(POINTS))))


def clouds(seed: int, scenes: int, objects: int, meshes: Path | None) -> Iterator[tuple[Cloud, Rng]]:
    """Clouds of scenes, of solids, of things and of meshes."""
    for number in range(scenes):
        for code, kind in enumerate((*SCENES, "flat")):
            rng = np.random.default_rng([seed, number, code])
            target = SceneTarget(flat(rng) if kind == "flat" else random_scene(rng, kind))
            for cloud in scans(kind, target, list(SCENE_SCANNERS[target.kind]), rng):
                yield cloud, rng
    for number in range(objects):
        rng = np.random.default_rng([seed, number, 10])
        if number % 2:
            solid = random_solid(rng)
            yield ("object", *solid.sample(count(rng), rng)), rng
            target: Target = SolidTarget(solid)
        else:
            piece = THINGS[number // 2 % len(THINGS)](rng)
            sampler = MeshSampler(Mesh(piece.vertices, piece.faces), piece.normals[piece.faces])
            target = MeshTarget(sampler)
        for cloud in scans("object", target, list(FAMILIES), rng):
            yield cloud, rng
        if number % 3 == 0:
            yield ("object", *hollow(rng)), rng
    for number, path in enumerate(meshes_in(meshes) if meshes else []):
        rng = np.random.default_rng([seed, number, 20])
        mesh = MeshSampler(load_mesh(path))
        yield ("mesh", *mesh.sample(count(rng), rng)), rng
        for cloud in scans("mesh", MeshTarget(mesh), list(FAMILIES), rng):
            yield cloud, rng


def varied(points: np.ndarray, normals: np.ndarray, rng: Rng) -> tuple[str, np.ndarray, np.ndarray]:
    """The points as they are, or thinned, cut, or made noisy."""
    variant = str(rng.choice(list(VARIANTS), p=list(VARIANTS.values())))
    size = float(np.linalg.norm(np.ptp(np.quantile(points, [0.01, 0.99], axis=0), axis=0)))
    kept = np.ones(len(points), dtype=bool)
    if variant == "voxels":
        cells = np.floor(points / (size * rng.uniform(0.004, 0.012))).astype(np.int64)
        kept[:] = False
        kept[np.unique(cells, axis=0, return_index=True)[1]] = True
    elif variant == "noise":
        points = points + rng.normal(size=points.shape) * size * np.exp(rng.uniform(np.log(3e-4), np.log(5e-3)))
    elif variant in ("cut", "uneven"):
        height = points @ rng.normal(size=3)
        height = (height - height.min()) / np.ptp(height)
        chance = (height > np.quantile(height, rng.uniform(0.1, 0.5))) if variant == "cut" else 0.1 + 0.9 * height
        kept = rng.random(len(points)) < chance
    return variant, points[kept], normals[kept]


def share_right(normals: np.ndarray, true: np.ndarray) -> float:
    return float((np.einsum("nd,nd->n", normals, true)[true.any(axis=1)] > 0).mean())


def outcome(points: np.ndarray, normals: np.ndarray, true: np.ndarray) -> tuple[bool, bool]:
    """Whether the signs are right, and whether there is a warning."""
    orientation, decision = settle(points, normals, "auto", None, Source())
    return share_right(orientation.normals, true) >= RIGHT, bool(decision.warnings())


def print_table(rows: list[Row]) -> None:
    """The outcomes by kind, and by what was done to the clouds."""
    print("| clouds | number | right, no warning | right, warned | wrong, warned | wrong, no warning |")
    print("|---|---|---|---|---|---|")
    for label in (lambda row: row[0], lambda row: f"{'objects' if row[0] in OBJECTS else 'scenes'}, {row[1]}"):
        for name in sorted({label(row) for row in rows}):
            results = [row[2] for row in rows if label(row) == name]
            cells = [results.count(pair) for pair in ((True, False), (True, True), (False, True), (False, False))]
            print(f"| {name} | {len(results)} | " + " | ".join(map(str, cells)) + " |")


def example(kind: str, points: np.ndarray, normals: np.ndarray, true: np.ndarray) -> Example | None:
    """The evidence of a cloud, and whether places inside should decide; 1/2 if a scene makes no difference."""
    outward = choose_signs(points, normals, "view")
    found = find_evidence(points, outward.normals, float(outward.open.mean()) > OPEN_SHARE)
    if found is None:
        return None
    if kind in OBJECTS:
        return found, 0.0
    inward = share_right(choose_signs(points, normals, "inside").normals, true) >= RIGHT
    return found, 0.5 if inward == (share_right(outward.normals, true) >= RIGHT) else float(inward)


def print_fit(examples: list[Example]) -> None:
    """Fit a logistic regression with a ridge to closed clouds, and one to open ones, and print their weights."""
    scenes = np.mean([wanted > 0 for _, wanted in examples])
    for is_open in (False, True):
        some = [(found, wanted) for found, wanted in examples if found.open == is_open]
        names = OPEN if is_open else CLOSED
        values = np.array([[getattr(found, name) for name in names] for found, _ in some])
        wanted = np.array([wanted for _, wanted in some])
        weight = np.where(wanted > 0, PRIOR / scenes, (1 - PRIOR) / (1 - scenes))
        weights, constant = fit(values, wanted, weight)
        print("OPEN =" if is_open else "CLOSED =", dict(zip(names, np.round(weights, 2).tolist(), strict=True)))
        print("constant", round(constant, 2))


def fit(values: np.ndarray, wanted: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, float]:
    """The weights (K,) and the constant of a logistic regression of (N, K) values."""
    from scipy.optimize import minimize

    middle, scale = values.mean(axis=0), values.std(axis=0) + 1e-9
    inputs = np.column_stack([(values - middle) / scale, np.ones(len(values))])

    def loss(weights: np.ndarray) -> float:
        score = inputs @ weights
        return float((weight * (np.logaddexp(0, score) - wanted * score)).sum() + RIDGE * (weights[:-1] ** 2).sum())

    found = minimize(loss, np.zeros(inputs.shape[1]), method="BFGS").x
    weights = found[:-1] / scale
    return weights, float(found[-1] - weights @ middle)


def main() -> None:
    """Make the clouds; print the table of outcomes, or fit."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=777)
    parser.add_argument("--scenes", type=int, default=8, help="of each kind")
    parser.add_argument("--objects", type=int, default=30)
    parser.add_argument("--meshes", type=Path, help="folder of closed meshes, to be scanned and sampled as objects")
    parser.add_argument("--model", default=DEFAULT_MODEL)
    parser.add_argument("--fit", action="store_true")
    options = parser.parse_args()
    estimator = make_estimator(options.model)
    rows: list[Row] = []
    examples: list[Example] = []
    for (kind, points, true), rng in clouds(options.seed, options.scenes, options.objects, options.meshes):
        variant, points, true = varied(points, true, rng)
        normals = estimator(points).normals.astype(np.float64)
        known = np.isfinite(normals).all(axis=1) & normals.any(axis=1)
        cloud = points[known], normals[known], true[known]
        if not options.fit:
            rows.append((kind, variant, outcome(*cloud)))
        elif kind != "terrain" and (found := example(kind, *cloud)) is not None:
            examples.append(found)
    if options.fit:
        print_fit(examples)
    else:
        print_table(rows)


if __name__ == "__main__":
    main()
