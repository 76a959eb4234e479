"""Calls of the library as type checkers see them: `mypy` fails here if a wrong option is no longer an error."""

from __future__ import annotations

from typing import TYPE_CHECKING

import jetnormal

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from typing_extensions import assert_type

    def calls(points: NDArray[np.float32], cloud: jetnormal.Cloud) -> None:
        assert_type(jetnormal.estimate(points, "jet", k=32, threads=1), NDArray[np.float64])
        assert_type(jetnormal.estimate([[0.0, 0.0, 1.0]], orient="up"), NDArray[np.float64])
        assert_type(jetnormal.estimate(cloud, curvature=True), jetnormal.Cloud)
        assert_type(jetnormal.estimate("scan.ply", viewpoint=(0, 0, 1.6)), jetnormal.Cloud)
        assert_type(jetnormal.reconstruct(cloud, depth=9, model="jet"), jetnormal.Mesh)
        assert_type(jetnormal.Estimator("cloudfit", threads=1)(points), jetnormal.Result)
        jetnormal.estimate(points, modle="jet")  # type: ignore[call-overload]
        jetnormal.estimate(points, model=3)  # type: ignore[call-overload]
        jetnormal.estimate(points, orient="north")  # type: ignore[call-overload]
        jetnormal.reconstruct(points, dpeth=9)  # type: ignore[call-arg]
        jetnormal.Estimator("cloudfit", thread=1)  # type: ignore[call-arg]
