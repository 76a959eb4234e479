"""Give an Open3D cloud oriented normals from jetnormal, and go on with Open3D.

python examples/01_open3d_round_trip.py samples/milk.pcd
"""

from __future__ import annotations

import sys

import numpy as np

import jetnormal
from jetnormal.support.open3d_loader import import_open3d

open3d = import_open3d()  # the same as `import open3d`; it also finds libusb where the system has none
if open3d is None:
    sys.exit("Open3D cannot be loaded here")

cloud = open3d.io.read_point_cloud(sys.argv[1])
cloud = cloud.voxel_down_sample(0.004)  # any of Open3D's filters

cloud = jetnormal.estimate(cloud, viewpoint=(0, 0, 0))  # an Open3D cloud in, an Open3D cloud out

towards = np.einsum("nd,nd->n", np.asarray(cloud.normals), -np.asarray(cloud.points)) > 0
print(f"{len(cloud.points)} points, {towards.mean():.0%} of the normals look towards the camera")
