"""Estimate the normals of a terrestrial project: E57 in, E57 out, each point towards the scanner that saw it.

    python examples/04_e57_with_poses.py project.e57 project_normals.e57

Needs the extra `e57`. The same is done by `jetnormal estimate project.e57 -o project_normals.e57`.
"""

from __future__ import annotations

import sys

import numpy as np

import jetnormal

cloud = jetnormal.read(sys.argv[1])  # the points of all scans, in the common frame of the file
sensors = cloud.source.sensors
if sensors is None:
    sys.exit(f"{sys.argv[1]} does not say where the scanner stood")

scans = cloud.attributes.get("scan", np.zeros(len(cloud), dtype=int))
for scan in np.unique(scans):
    position = sensors[scans == scan][0]
    print(f"scan {scan}: {np.sum(scans == scan)} points, scanner at {np.round(position, 2).tolist()}")

cloud = jetnormal.estimate(cloud)  # takes the positions of the scanner, as they are known
towards = np.einsum("nd,nd->n", cloud.normals, sensors - cloud.points) > 0
print(f"{towards.mean():.0%} of the normals look towards their scanner")
jetnormal.write(cloud, sys.argv[2])
