"""Recipes: a training as a TOML file.

    family = "patchfit"      # kind of network (training.families)
    base = "deepfit-paper"   # another recipe, by name or file, that this one changes

    [network]                # the network's configuration
    [data]                   # DataOptions
    [training]               # TrainOptions, and what the kind of network adds (training.families)
    [losses]                 # LossWeights, of patch networks

The recipes in the folder `recipes` are known by their names. A run keeps its recipe, complete, as config.toml.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jetnormal.errors import InputError, UsageError
from jetnormal.support.options import Option, OptionSet, build, fields
from jetnormal.support.suggest import did_you_mean
from jetnormal.training.options import DataOptions, TrainOptions

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Tables = dict[str, Any]
SUFFIX = ".toml"
_FOLDER = Path(__file__).parent / "recipes"
_TABLES = ("network", "data", "training", "losses")
_TOP = ("family", "about", "base")


@dataclass(frozen=True)
class Recipe:
    """All that decides on the result of a training.

    Attributes:
        family: kind of network.
        network: its configuration, a dataclass.
        data: the clouds.
        training: options of the training.
        losses: factors of the loss terms; None where the family has none.
        about: what the recipe is for.
    """

    family: str
    network: Any
    data: DataOptions
    training: TrainOptions
    losses: OptionSet | None = None
    about: str = ""

    def tables(self) -> Tables:
        """Return the recipe as the tables of a TOML file, complete."""
        parts = {name: getattr(self, name) for name in _TABLES}
        tables = {name: dataclasses.asdict(part) for name, part in parts.items() if part is not None}
        return {"family": self.family, "about": self.about} | tables

    def facts(self) -> Tables:
        """Return what a resumed run must have in common with the interrupted one: folders by their names alone."""
        facts = json.loads(json.dumps(self.tables()))
        del facts["about"]
        facts["data"]["folders"] = [Path(folder).name for folder in self.data.folders]
        facts["data"]["validation"] = self.data.validation and Path(self.data.validation).name
        return facts


def recipe_names() -> list[str]:
    """List the recipes that are known by name."""
    return sorted(path.stem for path in _FOLDER.glob(f"*{SUFFIX}"))


def read_recipe(name: str, changes: Tables | None = None) -> Recipe:
    """Read a recipe.

    Args:
        name: one of `recipe_names()`, or a file.
        changes: tables that replace entries of the file.

    Raises:
        InputError: there is no such recipe, or it is not TOML.
        UsageError: a setting is unknown or its value does not fit.
    """
    tables = read_tables(name)
    return make_recipe(merged(tables, changes or {}), f"{name}: ")


def read_tables(name: str) -> Tables:
    """Read the tables of a recipe, merged into those of its base.

    Raises:
        InputError: there is no such recipe, it is not TOML, or its bases go round in circles.
        UsageError: it has an unknown table.
    """
    tables: Tables = {}
    path, seen = _find(name, Path()), []
    while True:
        if path in seen:
            raise InputError(f"{path}: is its own base")
        seen.append(path)
        own = _parse(path)
        tables = merged(own, tables)
        if "base" not in own:
            break
        path = _find(str(own["base"]), path.parent)
    tables.pop("base", None)
    return tables


def make_recipe(tables: Tables, where: str = "") -> Recipe:
    """Make a recipe from its tables.

    Raises:
        UsageError: a setting is unknown or its value does not fit.
    """
    from jetnormal.training.families import family

    if "family" not in tables:
        raise UsageError(f'{where}has no family; say family = "patchfit" or "cloudfit", or name a base')
    kind = family(tables["family"])
    kinds: dict[str, Any] = {"network": kind.config, "data": DataOptions, "training": kind.training}
    if kind.losses is not None:
        kinds["losses"] = kind.losses
    elif tables.get("losses"):
        raise UsageError(f"{where}{tables['family']} has no table [losses]")
    parts = {name: build(each, tables.get(name, {}), f"{where}[{name}] ") for name, each in kinds.items()}
    return Recipe(tables["family"], about=str(tables.get("about", "")), **parts)


def merged(tables: Tables, changes: Tables) -> Tables:
    """Return tables with some entries replaced."""
    both = {**tables, **changes}
    for name in tables.keys() & changes.keys() & set(_TABLES):
        both[name] = {**tables[name], **changes[name]}
    return both


def parse_changes(texts: list[str], tables: Tables) -> Tables:
    """Turn texts such as "learning_rate=1e-4" or "network.order=2" into changes of a recipe.

    Args:
        texts: each KEY=VALUE; a key that several tables have needs its table's name.
        tables: of the recipe, complete.

    Raises:
        UsageError: a text has another form, or its key is unknown or ambiguous.
    """
    settings = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not equals:
            raise UsageError(f"{text!r} is not KEY=VALUE")
        settings[key.strip()] = _parse_value(value.strip())
    return placed(settings, tables)


def placed(settings: dict[str, Any], tables: Tables) -> Tables:
    """Put settings into the tables that have them.

    Args:
        settings: values by KEY or TABLE.KEY.
        tables: of the recipe, complete.

    Raises:
        UsageError: a key is unknown, or several tables have it.
    """
    changes: Tables = {}
    for key, value in settings.items():
        *table, name = key.split(".", 1)
        homes = [home for home in _TABLES if name in tables.get(home, {}) and table in ([], [home])]
        if not homes:
            known = [entry for home in _TABLES for entry in tables.get(home, {})]
            raise UsageError(f"the recipe has no setting {key}{did_you_mean(name, known)}")
        if len(homes) > 1:
            raise UsageError(f"{name} may be {' or '.join(f'{home}.{name}' for home in homes)}: write one of them")
        changes.setdefault(homes[0], {})[name] = value
    return changes


def recipe_text(recipe: Recipe, explained: bool = False) -> str:
    """Write a recipe as TOML, complete; settings without a value are left out.

    Args:
        recipe: to write.
        explained: whether each option is preceded by its help.
    """
    lines = [f"{name} = {_toml(value)}" for name, value in recipe.tables().items() if name in _TOP and value != ""]
    for table in _TABLES:
        part = getattr(recipe, table)
        if part is None:
            continue
        lines += ["", f"[{table}]"]
        for field in fields(type(part)):
            value = getattr(part, field.name)
            if explained and isinstance(field.note, Option):
                lines.append(f"# {field.note.help}")
            if value is not None:
                lines.append(f"{field.name} = {_toml(value)}")
            elif explained:
                default = field.note.default if isinstance(field.note, Option) else None
                lines.append(f"# {field.name} = ...  ({default or 'left out'})")
    return "\n".join([*lines, ""])


def _find(name: str, folder: Path) -> Path:
    """The file of a recipe: a known name, or a path seen from a folder."""
    known = _FOLDER / f"{name}{SUFFIX}"
    if name in recipe_names():
        return known
    path = folder / name
    if not path.is_file():
        names = recipe_names()
        raise InputError(f"{name}: no such recipe; there are {', '.join(names)}, or a file{did_you_mean(name, names)}")
    return path.resolve()


def _parse(path: Path) -> Tables:
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error})") from error
    for name, value in tables.items():
        if name not in _TABLES + _TOP or isinstance(value, dict) != (name in _TABLES):
            plan = "; plans of tables are for benchmarks/ablation.py" if {"test", "table"} <= tables.keys() else ""
            raise UsageError(f"{path}: unknown entry {name}{plan or did_you_mean(name, _TABLES + _TOP)}")
    return tables


def _parse_value(text: str) -> Any:
    """A value as TOML writes it; a text that is none is taken as it is."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _toml(value: Any) -> str:
    """A value as TOML writes it; JSON's texts are TOML's, too."""
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value) if isinstance(value, (str, bool)) else repr(value)
