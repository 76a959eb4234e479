"""The Python library: takes what a caller has, runs a job on it, gives back what the caller would use next.

Options are the fields of `jobs.options`: the signatures are derived from them, so that `help`, editors and type
checkers know each one.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Protocol, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from jetnormal import formats
from jetnormal.cloud import Cloud
from jetnormal.convert import library_of, to_cloud, to_open3d
from jetnormal.errors import JetnormalWarning, UsageError
from jetnormal.evaluation.options import EvaluateOptions
from jetnormal.jobs.estimate import Result, find_normals, with_normals
from jetnormal.jobs.options import EstimateOptions, NormalOptions, ReconstructOptions
from jetnormal.jobs.prediction import kept_estimator, prepare_estimator
from jetnormal.mesh import Mesh
from jetnormal.support.options import Option, Vector, fields
from jetnormal.support.report import StageTimer
from jetnormal.support.suggest import did_you_mean

if TYPE_CHECKING:
    from jetnormal.estimators.base import Estimator as DirectionEstimator
    from jetnormal.evaluation.results import Evaluation

Path_ = str | PathLike[str]
P = ParamSpec("P")
R = TypeVar("R")


A = TypeVar("A")
B = TypeVar("B")


def _options(kind: Callable[P, Any]) -> Callable[[Callable[[A, Any], R]], Callable[Concatenate[A, P], R]]:
    """Give a function of points and an option set the fields of the set as options of its own."""
    return _flattened(kind)


def _options_of_two(kind: Callable[P, Any]) -> Callable[[Callable[[A, B, Any], R]], Callable[Concatenate[A, B, P], R]]:
    """The same for a function of two arguments and an option set."""
    return _flattened(kind)


def _flattened(kind: Any) -> Callable[[Callable[..., R]], Callable[..., R]]:
    """What `_options` does: the options are made an instance of their set, which is the function's last argument."""

    def decorate(function: Callable[..., R]) -> Callable[..., R]:
        own = fields(kind)
        names = [field.name for field in own]
        first = list(inspect.signature(function).parameters)[:-1]

        @functools.wraps(function)
        def call(*arguments: Any, **options: Any) -> R:
            for name in options:
                if name not in names and name not in first:
                    hint = did_you_mean(name, names)
                    raise TypeError(f"{function.__name__}() has no option {name!r}{hint}")
            named = {name: options.pop(name) for name in first if name in options}
            count = len(first) - len(named)
            return function(*arguments[:count], **named, options=kind(*arguments[count:], **options))

        made: Any = call
        made.__signature__ = _signature(function, kind)
        lines = [f"    {one.name}: {one.note.help}" for one in own if isinstance(one.note, Option)]
        made.__doc__ = f"{inspect.getdoc(function)}\n\nOptions:\n" + "\n".join(lines)
        return call

    return decorate


def _signature(function: Callable[..., Any], kind: Any) -> inspect.Signature:
    types = {field.name: field.type for field in fields(kind)}
    own = inspect.signature(function)
    *first, _ = own.parameters.values()
    rest = [one.replace(annotation=types[one.name]) for one in inspect.signature(kind).parameters.values()]
    return inspect.Signature([*first, *rest], return_annotation=own.return_annotation)


def _warn(messages: Iterable[str]) -> None:
    """Send warnings to the line of the caller's program that called this module."""
    depth = 2
    frame = inspect.currentframe()
    while frame is not None and frame.f_globals.get("__name__") == __name__:
        frame = frame.f_back
        depth += 1
    for message in messages:
        warnings.warn(message, JetnormalWarning, stacklevel=depth - 1)


@dataclass(frozen=True, repr=False)
class Estimator(NormalOptions):
    """An estimator of normals that is loaded once and called for many clouds.

    >>> estimate = jetnormal.Estimator("cloudfit", threads=1)
    >>> result = estimate(points)
    >>> result.normals, result.confidence, result.warnings

    Its options are those of `jetnormal.estimate`; each says more in `help(jetnormal.estimate)`.

    Raises:
        UsageError: an option is out of range or contradicts another.
        ModelError: there is no such model.
        ResourceError: the device is not there.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "_loaded", prepare_estimator(self))

    def __call__(self, points: Any, *, viewpoint: Vector | None = None) -> Result:
        """Estimate oriented unit normals.

        Args:
            points: (N, 3) or organized (H, W, 3) coordinates, a cloud, the path of one, or an object of PyTorch,
                Open3D, trimesh or PyVista.
            viewpoint: where the sensor stood this time, (x, y, z) in the frame of the points.

        Returns:
            The normals and what is known about them, by row as the points; of (H, W, 3) points, by row and column.

        Raises:
            InputError: there are fewer than three different finite points, or coordinates beyond 1e150.
            ShapeError: the points are of another shape.
        """
        options: NormalOptions = self
        if viewpoint is not None:
            options = replace(_plain(self, NormalOptions), viewpoint=viewpoint)
        cloud = _taken(points)
        found = find_normals(cloud, options, self._loaded, StageTimer())  # type: ignore[attr-defined]
        _warn([*cloud.source.notes, *found.warnings])
        return found.shaped(_rows_of(points, cloud))

    def __reduce__(self) -> Any:
        """Send the options to another process, which loads the model anew."""
        options = {field.name: getattr(self, field.name) for field in fields(type(self))}
        return functools.partial(type(self), **options), ()

    def __repr__(self) -> str:
        chosen = (f"{field.name}={value!r}" for field in fields(type(self))
                  if (value := getattr(self, field.name)) != field.default)  # fmt: skip
        return f"Estimator({', '.join(chosen)})"


class _Estimate(Protocol[P]):
    """`estimate` as type checkers see it, with the options P."""

    @overload
    def __call__(self, points: Cloud | Path_, *positional: P.args, **options: P.kwargs) -> Cloud: ...
    @overload
    def __call__(
        self, points: NDArray[Any] | list[Any] | tuple[Any, ...], *positional: P.args, **options: P.kwargs
    ) -> NDArray[np.float64]: ...
    @overload
    def __call__(self, points: object, *positional: P.args, **options: P.kwargs) -> Any: ...


def _estimates(kind: Callable[P, Any]) -> Callable[[Callable[[Any, Any], Any]], _Estimate[P]]:
    return _options(kind)  # type: ignore[return-value]


@_estimates(EstimateOptions)
def estimate(points: Any, options: EstimateOptions) -> Any:
    """Estimate oriented unit normals; the model stays loaded for the next call.

    Args:
        points: (N, 3) or organized (H, W, 3) coordinates, a cloud, the path of one, or an object of PyTorch, Open3D,
            trimesh or PyVista.

    Returns:
        For a cloud or a path, a new cloud with normals and the attributes asked for; for an Open3D cloud, such a one;
        for all else float64 normals in the shape of the points. A row is NaN where a point is not finite or its
        neighbors are collinear or coincide. `jetnormal.Estimator` tells more.

    Raises:
        InputError: there are fewer than three different finite points, or coordinates beyond 1e150.
        ShapeError: the points are of another shape.
        UsageError: an option is out of range or contradicts another, or attributes are asked for of plain points.
        ModelError: there is no such model.
        ResourceError: the device is not there.
    """
    cloud = _taken(points)
    plain = not isinstance(points, (Cloud, str, PathLike)) and library_of(points) != "open3d"
    for name in ("curvature", "confidence", "sign_confidence"):
        if plain and getattr(options, name):
            raise UsageError(f"`{name}` is an attribute of a cloud: pass a Cloud, or take the Result of an Estimator")
    result = find_normals(cloud, options, kept_estimator(options), StageTimer())
    finished, replaced = with_normals(cloud, result, options)
    _warn([*cloud.source.notes, *result.warnings, *replaced])
    if plain:
        return result.shaped(_rows_of(points, cloud)).normals
    return finished if isinstance(points, (Cloud, str, PathLike)) else to_open3d(points, finished)


@_options(ReconstructOptions)
def reconstruct(points: Any, options: ReconstructOptions) -> Mesh:
    """Make a triangle mesh of points: screened Poisson reconstruction (Kazhdan and Hoppe, 2013).

    Args:
        points: as for `jetnormal.estimate`; the normals and colors of a cloud are used if it has some.

    Returns:
        The mesh, in the coordinates of the points, with their colors.

    Raises:
        InputError: there are fewer than ten different points with a normal, or all of them lie on one line.
        ShapeError: the points are of another shape.
        UsageError: an option is out of range or contradicts another.
        ModelError: there is no such model.
        ResourceError: the device or Open3D is not there, or its solver fails.
    """
    from jetnormal.jobs.reconstruct import reconstruct_cloud

    cloud = _taken(points)
    mesh, facts = reconstruct_cloud(cloud, options, StageTimer())
    _warn([*cloud.source.notes, *facts["warnings"]])
    return mesh


@_options_of_two(EvaluateOptions)
def evaluate(data: Path_, models: Sequence[str | DirectionEstimator], options: EvaluateOptions) -> Evaluation:
    """Compare estimators by the PCPNet protocol. One cloud is in memory at a time, and all models see it.

    Args:
        data: folder in PCPNet's layout: NAME.xyz, NAME.normals and, where not all points count, NAME.pidx.
        models: names or files, with settings as in "jet:k=122,order=2" (`estimators.factory.make_estimator`), or
            estimators (`estimators.base.Estimator`).

    Raises:
        InputError: the list or a file of a cloud is missing, unreadable or does not fit the others.
        UsageError: there is no model, one is given twice, or its settings are wrong.
        ModelError: a model is unknown or damaged.
        ResourceError: there is no such device.
    """
    from jetnormal.evaluation.protocol import evaluate

    return evaluate(Path(data), models, options)


def write(
    content: Any, path: Path_, *, format: str | None = None, encoding: str | None = None, overwrite: bool = False
) -> None:
    """Write a cloud or a mesh; the file appears complete or not at all.

    Args:
        content: a `Mesh`, a `Cloud`, or points as for `jetnormal.estimate`.
        path: the target, whose suffix tells the format; or "-", standard output, for a cloud.
        format: of a cloud, where the suffix does not tell it, such as "ply".
        encoding: of a cloud, such as "ascii" or "binary"; None keeps what the cloud was read in.
        overwrite: whether an existing file may be replaced.

    Raises:
        InputError: the file cannot be written.
        UsageError: the format has no such encoding.
    """
    if isinstance(content, Mesh):
        from jetnormal.formats.meshes import write_mesh

        if encoding is not None or format is not None:
            raise UsageError("`encoding` and `format` are options of clouds; a mesh has one by its suffix")
        _warn(write_mesh(content, path, overwrite=overwrite))
    else:
        _warn(formats.write(to_cloud(content), path, format=format, encoding=encoding, overwrite=overwrite))


def _taken(points: Any) -> Cloud:
    return formats.read(points) if isinstance(points, (str, PathLike)) else to_cloud(points)


def _rows_of(points: Any, cloud: Cloud) -> tuple[int, ...]:
    """The shape that results for points have: (H, W) of organized ones, else (N,)."""
    shape = np.shape(points) if not isinstance(points, (Cloud, str, PathLike)) else ()
    return shape[:2] if len(shape) == 3 else (len(cloud),)


def _plain(options: NormalOptions, kind: type[NormalOptions]) -> NormalOptions:
    """The options alone, of something that has more."""
    return kind(**{field.name: getattr(options, field.name) for field in fields(kind)})
