"""The options of the jobs, each defined once: commands, signatures and documentation are derived from them.

This module imports nothing heavy: the command line needs it to print its help.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from os import PathLike
from typing import Annotated, Any, Literal

from jetnormal.errors import UsageError
from jetnormal.jobs.parsing import (
    Names,
    complete_model,
    parse_bytes,
    parse_component,
    parse_names,
    parse_up,
    parse_vector,
    parse_words,
)
from jetnormal.support.options import MAX_THREADS, Option, OptionSet, Vector

DEFAULT_MODEL = "cloudfit"
DEPTHS = (4, 12)  # of the octree: 16 to 4096 cells along a side


@dataclass(frozen=True)
class NormalOptions(OptionSet):
    """How normals are estimated and how their signs are chosen.

    Raises:
        UsageError: an option is out of range or contradicts another.
    """

    model: Annotated[
        str | PathLike[str],
        Option(
            "auto (cloudfit), another packaged network (jetnormal models), pca, jet, or a model file; settings may "
            "follow a colon, as in jet:k=32,order=2.",
            metavar="NAME|FILE",
            group="Model",
            parse=str,
            complete=complete_model,
        ),
    ] = "auto"
    _: KW_ONLY
    k: Annotated[
        int | None,
        Option(
            "Neighbors per point (pca, jet, patch networks).", low=1, metavar="K", default="the model's", group="Model"
        ),
    ] = None
    order: Annotated[
        int | None, Option("Order of the fitted jet (jet).", low=1, metavar="N", default="the model's", group="Model")
    ] = None
    iterations: Annotated[
        int | None,
        Option(
            "Fits per point, each from the normal of the one before (patch networks, iternet).",
            low=1,
            metavar="N",
            default="the model's",
            group="Model",
        ),
    ] = None
    orient: Annotated[
        Literal["auto", "global", "mst", "viewpoint", "up", "none"],
        Option(
            "How the signs are chosen: auto (by the sensor, if it is known, else by the shape of the cloud), global, "
            "mst, viewpoint, up or none.",
            metavar="METHOD",
            group="Signs",
        ),
    ] = "auto"
    viewpoint: Annotated[
        Vector | None,
        Option("Position that the normals look towards.", parse=parse_vector, metavar="X,Y,Z", group="Signs"),
    ] = None
    viewpoint_attribute: Annotated[
        Names | None,
        Option("Attributes that hold it for each point.", parse=parse_names, metavar="X,Y,Z", group="Signs"),
    ] = None
    trajectory: Annotated[
        str | None,
        Option("File with a row time x y z for each position of the sensor.", metavar="FILE", group="Signs"),
    ] = None
    time_attribute: Annotated[
        str, Option("Attribute that holds each point's time on the trajectory.", metavar="NAME", group="Signs")
    ] = "gps_time"
    device: Annotated[
        str,
        Option(
            "Where a network runs; auto takes a GPU, if there is one, for patch networks.",
            metavar="auto|cpu|cuda[:N]",
            group="Resources",
        ),
    ] = "auto"
    threads: Annotated[
        int | None, Option("CPU threads.", low=1, high=MAX_THREADS, metavar="T", default="all cores", group="Resources")
    ] = None
    batch_size: Annotated[
        int | None,
        Option("Patches at a time (patch networks).", low=1, metavar="B", default="fits memory", group="Resources"),
    ] = None

    @property
    def model_name(self) -> str:
        """What `estimators.factory.make_estimator` takes: the default model for "auto"."""
        return DEFAULT_MODEL if self.model == "auto" else str(self.model)

    def __post_init__(self) -> None:
        given: Any = self.viewpoint
        if hasattr(given, "__len__") and not isinstance(given, str):  # a list or an array is as good as a tuple
            object.__setattr__(self, "viewpoint", _numbers(given))
        if isinstance(self.model, PathLike):
            object.__setattr__(self, "model", str(self.model))
        if not isinstance(self.model, str):
            raise UsageError(
                f"`model` is a name or the path of a model file, not a {type(self.model).__name__}; "
                "`estimate` and `Estimator` keep what they load"
            )
        super().__post_init__()
        viewpoint, names = self.viewpoint, self.viewpoint_attribute
        if viewpoint is not None and not all(map(math.isfinite, viewpoint)):
            raise UsageError("`viewpoint` takes three finite numbers")
        if names is not None and not all(names):
            raise UsageError("`viewpoint_attribute` takes the names of three attributes, of x, y and z")
        given = [o for o in ("viewpoint", "viewpoint_attribute", "trajectory") if getattr(self, o) is not None]
        if len(given) > 1:
            raise UsageError(f"`{given[0]}` contradicts `{given[1]}`: leave one of them out")
        if self.orient not in ("auto", "viewpoint"):
            for option in ("viewpoint", "viewpoint_attribute", "trajectory"):
                if getattr(self, option) is not None:
                    raise UsageError(f"`{option}` contradicts `orient={self.orient}`: leave one of them out")


def _numbers(given: Any) -> tuple[float, ...]:
    """The numbers of a sequence.

    Raises:
        UsageError: it holds anything else.
    """
    try:
        return tuple(float(value) for value in given)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"`viewpoint` takes three finite numbers, not {str(given)[:80]}") from None


@dataclass(frozen=True)
class ReadOptions(OptionSet):
    """How the file of a cloud is read."""

    _: KW_ONLY
    format: Annotated[
        str | None,
        Option(
            "Format where no suffix tells it: ply, las, csv... for - (a stream), kitti for .bin.",
            metavar="NAME", group="Files",
        ),
    ] = None  # fmt: skip
    columns: Annotated[
        str | None,
        Option(
            "What the columns of a text file are: id,x,y,z,- or x=East,y=North,z=Height.",
            metavar="NAMES", default="by their names, else x,y,z first", group="Files",
        ),
    ] = None  # fmt: skip
    decimal: Annotated[
        Literal["point", "comma"] | None,
        Option("Decimal sign of a text file.", default="a comma only between semicolons", group="Files"),
    ] = None


@dataclass(frozen=True)
class FileOptions(ReadOptions):
    """How the files of a cloud are read and written."""

    _: KW_ONLY
    encoding: Annotated[
        str | None, Option("Encoding of the output, such as ascii.", metavar="E", default="the input's", group="Files")
    ] = None


@dataclass(frozen=True)
class BatchOptions(OptionSet):
    """How many files go into one folder."""

    _: KW_ONLY
    suffix: Annotated[
        str,
        Option("Added to the names of the files in DIR: _n makes scan_n.ply.", metavar="TEXT", group="Many files"),
    ] = ""
    jobs: Annotated[
        int,
        Option(
            "Files in memory at a time; one is computed, the others are read or written.",
            low=1, metavar="N", group="Many files",
        ),
    ] = 2  # fmt: skip
    skip_existing: Annotated[
        bool, Option("Skip files whose results are in DIR already, as after an interruption.", group="Many files")
    ] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if {"/", "\\"} & set(self.suffix):
            raise UsageError(f"`suffix` is the end of a name, not a path: {self.suffix!r}")


@dataclass(frozen=True)
class LargeOptions(OptionSet):
    """How a cloud that is larger than memory is computed in tiles."""

    _: KW_ONLY
    max_memory: Annotated[
        int | None,
        Option(
            "Memory to use, such as 4GB; a cloud that would take more is computed in tiles on disk.",
            parse=parse_bytes, metavar="SIZE", default="60 % of the machine's", group="Large clouds",
        ),
    ] = None  # fmt: skip
    resume: Annotated[bool, Option("Continue an interrupted run with the tiles it left.", group="Large clouds")] = False
    cluster: Annotated[
        str | None,
        Option(
            "Compute tiles by Ray: local, auto (this machine's cluster), or ray://HOST:10001.",
            metavar="ADDRESS", group="Large clouds",
        ),
    ] = None  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.max_memory is not None and self.max_memory <= 0:
            raise UsageError(f"`max_memory` is a number of bytes above 0, not {self.max_memory}")
        known = self.cluster is None or self.cluster in ("local", "auto") or self.cluster.startswith("ray://")
        if not known:
            raise UsageError(f"`cluster` is local, auto or ray://HOST:10001, not {self.cluster!r}")


@dataclass(frozen=True)
class EstimateOptions(NormalOptions):
    """What `jetnormal.estimate` does: how normals are estimated, and what a cloud gets beside them."""

    _: KW_ONLY
    curvature: Annotated[
        bool, Option("Add the attributes curvature (the mean), curvature_max and curvature_min.", group="Attributes")
    ] = False
    confidence: Annotated[
        bool, Option("Add the attribute confidence, 0 to 1: how reliable the normal is.", group="Attributes")
    ] = False
    sign_confidence: Annotated[
        bool, Option("Add the attribute sign_confidence, the probability that the sign is right.", group="Attributes")
    ] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sign_confidence and self.orient == "none":
            raise UsageError("`sign_confidence` contradicts `orient=none`, which chooses no signs")


@dataclass(frozen=True)
class SurfaceOptions(OptionSet):
    """How a mesh is made of oriented points.

    A surface is taken as open, and cut where the points end, if more than 2 % of its area is farther from all points
    than three times the radius around the nearest of them that holds eight others.
    """

    _: KW_ONLY
    depth: Annotated[
        int | None,
        Option(
            "Depth of Poisson's octree, 2^D cells along a side.",
            low=DEPTHS[0], high=DEPTHS[1], metavar="D", default="the points' spacing, or their noise", group="Surface",
        ),
    ] = None  # fmt: skip
    scale: Annotated[
        float, Option("Size of the solved cube over that of the cloud.", low=1, high=10, metavar="S", group="Surface")
    ] = 1.1
    trim: Annotated[
        float | None,
        Option(
            "Share of the vertices to cut off where points are sparse; 0 for none.",
            low=0, high=1, metavar="Q", default="none if closed, else where the points end", group="Surface",
        ),
    ] = None  # fmt: skip
    min_component: Annotated[
        int | Literal["largest"] | None,
        Option(
            "Remove components with fewer points; largest keeps only the largest.",
            parse=parse_component, metavar="N|largest", default="30, or 0.2 % of the points", group="Surface",
        ),
    ] = None  # fmt: skip
    smooth: Annotated[
        int,
        Option(
            "Rounds of smoothing, which does not shrink (Taubin, 1995).", low=0, high=1000, metavar="N", group="Surface"
        ),
    ] = 0
    faces: Annotated[
        int | None,
        Option(
            "Simplify to about so many faces (Garland and Heckbert, 1997).",
            low=4, metavar="N", default="all", group="Surface",
        ),
    ] = None  # fmt: skip
    recompute: Annotated[bool, Option("Estimate normals even if the cloud has some.", group="Surface")] = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.min_component, int) and self.min_component < 0:
            raise UsageError(f"`min_component` is a number of points, 0 or more, not {self.min_component}")
        if self.trim == 1:
            raise UsageError("`trim` is a share below 1: nothing would be left")


@dataclass(frozen=True)
class ReconstructOptions(NormalOptions, SurfaceOptions):
    """What `jetnormal.reconstruct` does: how a mesh is made, and how normals are estimated if there are none.

    On one thread, the same cloud gives the same mesh bit for bit; on more, the order of its vertices changes.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.orient == "none":
            raise UsageError("a surface needs to know outside from inside: leave `orient=none` out")


@dataclass(frozen=True)
class PreviewOptions(OptionSet):
    """How a cloud or a mesh is shown."""

    _: KW_ONLY
    views: Annotated[
        tuple[str, ...],
        Option(
            "One or more, in a grid: iso, front, back, left, right, top, bottom, or AZIMUTH:ELEVATION in degrees.",
            parse=parse_words, metavar="V,V,...", default="auto: where the outer sides are seen",
        ),
    ] = ("auto",)  # fmt: skip
    up: Annotated[
        Vector | Literal["auto"],
        Option(
            "Direction that is up in the views; auto tells it from the shape.",
            parse=parse_up, metavar="X,Y,Z|auto", default="0,0,1",
        ),
    ] = (0.0, 0.0, 1.0)  # fmt: skip
    size: Annotated[int, Option("Pixels of the longer side of a view.", low=16, high=8192, metavar="N")] = 1000
    colors: Annotated[
        tuple[Literal["auto", "normals", "file", "confidence", "plain"], ...],
        Option(
            "One or more of normals, file (its own), confidence, plain; auto: a cloud by normals, a mesh by its own.",
            parse=parse_words, metavar="C,C,...", default="auto",
        ),
    ] = ("auto",)  # fmt: skip
    background: Annotated[Literal["white", "dark"], Option("Background of the picture and the page.")] = "white"

    def __post_init__(self) -> None:
        super().__post_init__()
        from jetnormal.rendering.camera import check_view

        if not self.views or not self.colors:
            raise UsageError("there must be a view and a coloring")
        for view in self.views:
            check_view(view)
        if self.up != "auto" and not (all(map(math.isfinite, self.up)) and any(self.up)):
            raise UsageError("`up` takes three finite numbers, not all of them zero")
