"""Options: dataclasses whose fields say, once, all there is to say about an option.

    @dataclass(frozen=True)
    class Options(OptionSet):
        k: Annotated[int | None, Option("Neighbors per point.", low=1, default="the model's")] = None

The type, the default, the bounds and the help stand here. The commands (`cli.derive`) and the recipes of
`jetnormal train` are derived from them, and an instance checks its values when it is made, whoever makes it.
This module imports nothing heavy: the command line needs the options to print its help.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import numbers
import types
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from jetnormal.errors import UsageError
from jetnormal.support.suggest import did_you_mean

Vector = tuple[float, float, float]
LARGEST_INTEGER = 2**63 - 1
MAX_THREADS = 1024  # with some tens of thousands, systems and libraries crash


@dataclass(frozen=True)
class Option:
    """What the command line and the documentation say about a field.

    Attributes:
        help: one sentence.
        metavar: what stands for the value in the help, such as "DIR".
        low, high: bounds of a number, both allowed.
        default: how the help shows the default, where the value itself does not explain it.
        names: of the option, such as ("--output", "-o"); empty takes the field's name.
        group: heading in the help.
        parse: turns the text of the command line into the value; raises ValueError with a message for the user.
        flag: whether the command line has it; a recipe always does.
        complete: values that begin with a text, for the completion of the shell.
    """

    help: str
    metavar: str | None = None
    low: float | None = None
    high: float | None = None
    default: str | None = None
    names: tuple[str, ...] = ()
    group: str | None = None
    parse: Callable[[str], Any] | None = None
    flag: bool = True
    complete: Callable[[str], Iterable[str]] | None = None


@dataclass(frozen=True)
class Nested:
    """A field that holds another `OptionSet`, whose options become options of this one.

    Attributes:
        only: the fields that the command line shows; None for all.
    """

    only: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Field:
    """A field of an `OptionSet`, its annotation taken apart.

    Attributes:
        name: of the field.
        type: without the annotation.
        default: its value where it is not given, or `dataclasses.MISSING`.
        note: what is said about it; None for a field that is neither an option nor nested.
    """

    name: str
    type: Any
    default: Any
    note: Option | Nested | None

    @property
    def types(self) -> tuple[Any, ...]:
        """The members of the union that the type is; a type that is no union is the only one."""
        union = get_origin(self.type) in (Union, types.UnionType)
        return get_args(self.type) if union else (self.type,)

    @property
    def choices(self) -> tuple[str, ...]:
        """The values of the Literal among the types."""
        return tuple(value for part in self.types if get_origin(part) is Literal for value in get_args(part))


class OptionSet:
    """Base of the option dataclasses: a value that does not fit its field is refused.

    Raises:
        UsageError: a value has the wrong type, is out of bounds or is not one of the choices.
    """

    def __post_init__(self) -> None:
        for field in fields(type(self)):
            if isinstance(field.note, Option):
                check(field, getattr(self, field.name))


_Made = TypeVar("_Made")


def fields(kind: type) -> tuple[Field, ...]:
    """Return the fields of an option dataclass, in their order."""
    hints: dict[str, Any] = {}
    for base in reversed(kind.__mro__):  # typing.get_type_hints of Python 3.10 refuses KW_ONLY
        hints |= inspect.get_annotations(base, eval_str=True)
    found = []
    for field in dataclasses.fields(kind):
        hint, note = hints[field.name], None
        if get_origin(hint) is Annotated:
            hint, *notes = get_args(hint)
            note = next((item for item in notes if isinstance(item, (Option, Nested))), None)
        default = field.default if field.default_factory is dataclasses.MISSING else field.default_factory()
        found.append(Field(field.name, hint, default, note))
    return tuple(found)


def check(field: Field, value: Any) -> None:
    """Refuse a value that does not fit its field.

    Raises:
        UsageError: it has the wrong type, is out of bounds or is not one of the choices.
    """
    name = field.name.replace("_", " ")
    if not any(_fits(value, part) for part in field.types):
        meant = did_you_mean(str(value), field.choices)
        raise UsageError(f"{name} is {' or '.join(filter(None, map(_described, field.types)))}, not {value!r}{meant}")
    if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        raise UsageError(f"{name} is a number that does not fit into 64 bits")
    if isinstance(field.note, Option) and _fits(value, float):
        low = -math.inf if field.note.low is None else field.note.low
        high = math.inf if field.note.high is None else field.note.high
        if not (low <= value <= high and math.isfinite(value)):
            bounds = f"{low} to {high}" if high < math.inf else f"{low} or more" if low > -math.inf else "finite"
            raise UsageError(f"{name} is {bounds}, not {value}")


def build(kind: type[_Made], table: Mapping[str, Any], where: str = "") -> _Made:
    """Make a dataclass from the table of a TOML file; what is left out keeps its default.

    Args:
        kind: the dataclass, an `OptionSet` or another one.
        table: values by the names of the fields.
        where: how messages call the table.

    Raises:
        UsageError: an entry is unknown or its value does not fit.
    """
    known = {field.name: field for field in fields(kind)}
    values = {}
    for name, value in table.items():
        if name not in known:
            raise UsageError(f"{where}unknown setting {name}{did_you_mean(name, known)}")
        values[name] = tuple(value) if isinstance(value, list) else value
    try:
        for name, value in values.items():
            check(known[name], value)
        return kind(**values)
    except (UsageError, TypeError, ValueError) as error:
        raise UsageError(f"{where}{error}") from error


def _fits(value: Any, part: Any) -> bool:
    """Whether a value is of one of the types that fields have."""
    if part is Any:
        return True
    if get_origin(part) is Literal:
        return any(isinstance(value, type(choice)) and value == choice for choice in get_args(part))
    if get_origin(part) is tuple:
        if not isinstance(value, tuple):
            return False
        items = get_args(part)
        if items[-1] is ...:
            items = items[:1] * len(value)
        return len(value) == len(items) and all(map(_fits, value, items))
    if part in (int, float):
        kind = numbers.Integral if part is int else numbers.Real
        return isinstance(value, kind) and not isinstance(value, bool)
    return isinstance(value, part)


def _described(part: Any) -> str:
    """A type in words; nothing for None, which is the option left out."""
    if get_origin(part) is Literal:
        return "one of " + ", ".join(map(str, get_args(part)))
    if get_origin(part) is tuple:
        first, last = get_args(part)[0], get_args(part)[-1]
        return f"a list, each item {_described(first)}" if last is ... else f"{len(get_args(part))} values"
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "a text", type(None): ""}
    return words.get(part, str(part))
