"""Oriented surface normals for point clouds.

>>> import jetnormal
>>> cloud = jetnormal.read("scan.ply")
>>> cloud = jetnormal.estimate(cloud)
>>> jetnormal.write(cloud, "scan_with_normals.ply")

Each public name is imported from its module on first use, so that `import jetnormal` stays cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from jetnormal._version import __version__

if TYPE_CHECKING:
    from jetnormal.cloud import Cloud
    from jetnormal.evaluation import evaluate
    from jetnormal.formats import read, write
    from jetnormal.jobs.estimate import estimate
    from jetnormal.jobs.reconstruct import reconstruct
    from jetnormal.mesh import Mesh
    from jetnormal.networks.checkpoint import load_model
    from jetnormal.orientation.methods import orient

__all__ = [
    "Cloud",
    "Mesh",
    "__version__",
    "estimate",
    "evaluate",
    "load_model",
    "orient",
    "read",
    "reconstruct",
    "write",
]

_HOMES = {
    "Cloud": "jetnormal.cloud",
    "Mesh": "jetnormal.mesh",
    "estimate": "jetnormal.jobs.estimate",
    "evaluate": "jetnormal.evaluation",
    "load_model": "jetnormal.networks.checkpoint",
    "orient": "jetnormal.orientation.methods",
    "read": "jetnormal.formats",
    "reconstruct": "jetnormal.jobs.reconstruct",
    "write": "jetnormal.formats",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # the next access does not come here again
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
