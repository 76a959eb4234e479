"""The options of an evaluation, each defined once. This module imports nothing heavy."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, Literal

from jetnormal.errors import UsageError
from jetnormal.support.options import MAX_THREADS, Option, OptionSet


@dataclass(frozen=True)
class EvaluateOptions(OptionSet):
    """What `jetnormal.evaluate` does."""

    _: KW_ONLY
    list_file: Annotated[
        str | None,
        Option(
            "File in DIR that lists the clouds.",
            names=("--list",), metavar="FILE", default="testset_all.txt, else all", group="Data",
        ),
    ] = None  # fmt: skip
    all_points: Annotated[bool, Option("Evaluate all points instead of those in NAME.pidx.", group="Data")] = False
    normals: Annotated[
        tuple[str, ...],
        Option(
            "Also score normals of another program: DIR/CLOUD.normals has a row for each point, or for each "
            "evaluated point; repeatable.",
            metavar="NAME=DIR", group="Data",
        ),
    ] = ()  # fmt: skip
    orient: Annotated[
        Literal["none", "global", "mst", "viewpoint", "up"],
        Option(
            "Choose signs as well (global, mst, viewpoint, up) and score them; all points are estimated. viewpoint: by "
            "NAME.ply of a scan.",
            metavar="METHOD",
            group="Data",
        ),
    ] = "none"
    results: Annotated[
        Path | None,
        Option(
            "Folder in which normals are kept, so that an interrupted evaluation can continue.",
            metavar="DIR",
            group="Output",
        ),
    ] = None
    export_normals: Annotated[
        Path | None,
        Option("Write the normals of each model as DIR/MODEL/CLOUD.normals.", metavar="DIR", group="Output"),
    ] = None
    device: Annotated[str, Option("Where networks run.", metavar="auto|cpu|cuda[:N]", group="Resources")] = "auto"
    threads: Annotated[
        int | None, Option("CPU threads.", low=1, high=MAX_THREADS, metavar="T", default="all cores", group="Resources")
    ] = None
    overwrite: Annotated[bool, Option("Replace normals that were exported before.", flag=False)] = False
    z_angles: Annotated[
        bool,
        Option(
            "Measure the angles of true normals and z axes before and after the transform of patch networks.",
            flag=False,
        ),
    ] = False

    def __post_init__(self) -> None:
        for name in ("results", "export_normals"):
            given = getattr(self, name)
            object.__setattr__(self, name, Path(given) if isinstance(given, str) else given)
        super().__post_init__()
        for text in self.normals:
            name, _, folder = text.partition("=")
            if not name or not folder:
                raise UsageError(f"`normals` takes NAME=DIR, not {text!r}")
