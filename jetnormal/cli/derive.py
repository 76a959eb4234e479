"""Typer commands derived from option dataclasses (`support.options`).

    @with_options
    def estimate(input: Path, output: Path, options: EstimateOptions, json: Json = False) -> None:

has one option for each field of EstimateOptions; the function gets them back as one instance. With

    changes: Annotated[dict[str, Any], Given(DataOptions)]

it gets a dictionary of those that were given, without any defaults.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, get_args, get_origin

import typer
from typer.core import TyperCommand

from jetnormal.support.options import Field, Nested, Option, OptionSet, fields
from jetnormal.support.suggest import did_you_mean

_Function = TypeVar("_Function", bound=Callable[..., None])
_Set = TypeVar("_Set", bound=OptionSet)


@dataclass(frozen=True)
class Given:
    """Annotates a parameter of a command that gets only the given options of a set.

    Attributes:
        kind: the option set.
        default: how the help shows a default that is not said by the field.
    """

    kind: type[OptionSet]
    default: str | None = None


class GroupedCommand(TyperCommand):
    """A command whose help lists the options under their groups, in plain text.

    Typer's own groups, its panels, need Rich, whose import takes longer than all the rest of the start.
    """

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Name a required argument without Typer's braces."""
        return [piece.replace("{", "").replace("}", "") for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                default = "Options"
                if parameter.param_type_name == "argument":
                    default = "Arguments"
                    record = (record[0].partition(" <")[0], record[1])  # without Typer's <path>
                group = getattr(parameter, "rich_help_panel", None) or default
                sections.setdefault(group, []).append(record)
        sections["Options"] = sections.pop("Options", [])  # those of no group come last
        for group, records in sections.items():
            if records:
                with formatter.section(group):
                    formatter.write_dl(records)


def with_options(function: _Function) -> _Function:
    """Replace each parameter that is annotated with an `OptionSet`, or as `Given`, by options for its fields."""
    signature = inspect.signature(function, eval_str=True)
    sets = {name: p.annotation for name, p in signature.parameters.items() if _is_set(p.annotation)}
    given = {name: note for name, p in signature.parameters.items() if (note := _given(p.annotation))}
    parameters: list[inspect.Parameter] = []
    for name, parameter in signature.parameters.items():
        if name in sets:
            parameters += _parameters(sets[name])
        elif name in given:
            parameters += _optional(given[name])
        else:
            parameters.append(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY))

    @functools.wraps(function)
    def command(**values: Any) -> None:
        arguments = {name: value for name, value in values.items() if name in signature.parameters}
        arguments |= {name: _gathered(kind, values) for name, kind in sets.items()}
        arguments |= {name: _chosen(note.kind, values) for name, note in given.items()}
        function(**arguments)

    made: Any = command
    made.__signature__ = signature.replace(parameters=parameters)
    made.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    del made.__wrapped__  # Typer would look at its annotations
    return made


def one_of(*choices: str) -> dict[str, Any]:
    """Return the settings of a Typer option, of type Any, that takes one of some words."""

    def parse(text: str) -> str:
        if text not in choices:
            raise ValueError(f"{text!r} is not one of {', '.join(choices)}{did_you_mean(text, choices)}")
        return text

    def complete(text: str) -> list[str]:
        return [choice for choice in choices if choice.startswith(text)]

    return {"parser": _parser(parse), "metavar": "|".join(choices), "autocompletion": complete}


def _is_set(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, OptionSet)


def _given(annotation: Any) -> Given | None:
    notes = get_args(annotation)[1:] if get_origin(annotation) is Annotated else ()
    return next((note for note in notes if isinstance(note, Given)), None)


def _shown(kind: type, only: tuple[str, ...] | None = None) -> Iterator[Field]:
    """The fields of a set, and of those nested in it, that the command line has."""
    for field in fields(kind):
        if only is not None and field.name not in only:
            continue
        if isinstance(field.note, Nested):
            yield from _shown(field.type, field.note.only)
        elif field.note is not None and field.note.flag:
            yield field


def _parameters(kind: type) -> Iterator[inspect.Parameter]:
    """The options of a set as parameters of a command."""
    for field in _shown(kind):
        default = inspect.Parameter.empty if field.default is dataclasses.MISSING else field.default
        annotation: Any = Annotated[_typer_type(field), _typer_option(field)]
        yield inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _optional(given: Given) -> Iterator[inspect.Parameter]:
    """The options of a set as parameters of a command, each None where it is not given."""
    for field in _shown(given.kind):
        assert isinstance(field.note, Option)
        note = dataclasses.replace(field.note, default=field.note.default or given.default)
        annotation: Any = Annotated[_typer_type(field) | None, _typer_option(dataclasses.replace(field, note=note))]
        yield inspect.Parameter(field.name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)


def _typer_type(field: Field) -> Any:
    """The type of a field as Typer knows it: a tuple of any length is an option that may be repeated."""
    assert isinstance(field.note, Option)
    if field.note.parse is not None or field.choices:
        return Any
    return list[get_args(field.type)[0]] if _repeats(field) else field.type  # type: ignore[misc]


def _repeats(field: Field) -> bool:
    return get_origin(field.type) is tuple and get_args(field.type)[-1] is ...


def _typer_option(field: Field) -> Any:
    note = field.note
    assert isinstance(note, Option)
    names = note.names
    if not names and field.type is bool and field.default is False:
        names = (f"--{field.name.replace('_', '-')}",)  # without a --no-NAME
    settings: dict[str, Any] = {}
    if note.low in (0, 1) and note.high is None:  # which goes without saying in the help
        settings = {"callback": _at_least(note.low)}
    elif {int, float} & {*field.types}:
        settings = {"min": note.low, "max": note.high}
    if note.parse is not None:
        settings["parser"] = _parser(note.parse)
    elif field.choices:
        settings = one_of(*field.choices)
    if note.metavar is not None:
        settings["metavar"] = note.metavar
    if note.complete is not None:
        settings["autocompletion"] = note.complete
    shown = True if note.default is None else note.default
    return typer.Option(*names, help=note.help, show_default=shown, rich_help_panel=note.group, **settings)


def _at_least(low: float) -> Callable[[Any], Any]:
    """A callback of a Typer option that refuses a number below a bound."""

    def checked(value: Any) -> Any:
        if value is not None and value < low:
            raise typer.BadParameter(f"{value} is not {low} or more")
        return value

    return checked


def _parser(parse: Callable[[str], Any]) -> Callable[[str], Any]:
    """The parser of a field with the error that Typer reports by the option's name."""

    @functools.wraps(parse)
    def parser(text: Any) -> Any:
        if not isinstance(text, str):
            return text  # a default is a value already
        try:
            return parse(text)
        except ValueError as error:
            raise typer.BadParameter(str(error)) from None

    return parser


def _gathered(kind: type[_Set], values: Mapping[str, Any], only: tuple[str, ...] | None = None) -> _Set:
    """An instance of a set from the values of a command line."""
    chosen: dict[str, Any] = {}
    for field in fields(kind):
        if only is not None and field.name not in only:
            continue
        if isinstance(field.note, Nested):
            chosen[field.name] = _gathered(field.type, values, field.note.only)
        elif field.note is not None and field.note.flag:
            value = values[field.name]
            chosen[field.name] = tuple(value or ()) if _repeats(field) else value
    return kind(**chosen)


def _chosen(kind: type[OptionSet], values: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a command line that were given."""
    given = {field.name: values[field.name] for field in _shown(kind) if values[field.name] not in (None, [])}
    return {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
