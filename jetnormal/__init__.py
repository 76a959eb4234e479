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
    from jetnormal import errors
    from jetnormal.api import Estimator, estimate, evaluate, reconstruct, write
    from jetnormal.cloud import Cloud
    from jetnormal.errors import JetnormalWarning
    from jetnormal.formats import read
    from jetnormal.jobs.estimate import Result
    from jetnormal.jobs.options import EstimateOptions, ReconstructOptions
    from jetnormal.mesh import Mesh
    from jetnormal.networks.checkpoint import load_model
    from jetnormal.orientation.policy import orient

__all__ = [
    "Cloud",
    "EstimateOptions",
    "Estimator",
    "JetnormalWarning",
    "Mesh",
    "ReconstructOptions",
    "Result",
    "__version__",
    "errors",
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
    "EstimateOptions": "jetnormal.jobs.options",
    "Estimator": "jetnormal.api",
    "JetnormalWarning": "jetnormal.errors",
    "Mesh": "jetnormal.mesh",
    "ReconstructOptions": "jetnormal.jobs.options",
    "Result": "jetnormal.jobs.estimate",
    "estimate": "jetnormal.api",
    "evaluate": "jetnormal.api",
    "load_model": "jetnormal.networks.checkpoint",
    "orient": "jetnormal.orientation.policy",
    "read": "jetnormal.formats",
    "reconstruct": "jetnormal.api",
    "write": "jetnormal.api",
}


def __getattr__(name: str) -> Any:
    if name == "errors":
        return import_module("jetnormal.errors")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value  # the next access does not come here again
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
