from __future__ import annotations

import pytest

from jetnormal.errors import InputError, UsageError
from jetnormal.training.recipe import make_recipe, parse_changes, read_recipe, read_tables, recipe_names, recipe_text


def written(folder, name, text) -> str:
    path = folder / name
    path.write_text(text)
    return str(path)


def test_every_packaged_recipe_can_be_read_and_says_what_it_is_for():
    assert {"cloudfit", "deepfit-paper", "adafit-paper", "graphfit-paper", "deepfit-small"} <= set(recipe_names())
    for name in recipe_names():
        assert read_recipe(name).about


def test_a_recipe_changes_its_base(tmp_path):
    written(tmp_path, "first.toml", 'base = "deepfit-paper"\n[network]\norder = 2\nneighbors = 64\n')
    second = written(tmp_path, "second.toml", 'base = "first.toml"\nabout = "mine"\n[network]\norder = 1\n')
    recipe = read_recipe(second)
    assert (recipe.about, recipe.network.order, recipe.network.neighbors) == ("mine", 1, 64)
    assert recipe.training == read_recipe("deepfit-paper").training


def test_a_written_recipe_is_read_as_the_same(tmp_path):
    recipe = read_recipe("deepfit-small", {"data": {"folders": ('C:\\a "b"', "ü"), "weights": (1.5, 2)}})
    assert read_recipe(written(tmp_path, "a.toml", recipe_text(recipe))) == recipe
    assert read_recipe(written(tmp_path, "b.toml", recipe_text(recipe, explained=True))) == recipe


def test_every_setting_of_every_recipe_is_explained():
    for name in recipe_names():
        lines = recipe_text(read_recipe(name), explained=True).splitlines()
        settings = [line for line in lines if " = " in line and not line.startswith(("family", "about"))]
        for line in settings:
            assert lines[lines.index(line) - 1].startswith("# "), f"{name}: {line}"


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        ("[network", InputError, "a.toml: cannot be read as TOML"),
        ("[network]\norder = 2", UsageError, "has no family"),
        ('family = "patchfitt"', UsageError, "family is one of patchfit, cloudfit, .*did you mean patchfit"),
        ('family = "patchfit"\n[trainig]\nepochs = 2', UsageError, "unknown entry trainig; did you mean training"),
        ('family = "patchfit"\nlosses = 3', UsageError, "unknown entry losses"),
        ('[test]\ndata = "a"\n[[table]]\ntitle = "b"', UsageError, "unknown entry test; plans of tables are for"),
        ('family = "patchfit"\n[training]\nepoch = 2', UsageError, r"\[training\] unknown setting epoch; did you mean"),
        ('family = "patchfit"\n[training]\nepochs = "2"', UsageError, r"\[training\] epochs is a whole number"),
        ('family = "patchfit"\n[network]\nweights = "deep"', UsageError, r"\[network\] weights is one of deepfit"),
        ('family = "patchfit"\n[network]\norder = 9', UsageError, r"\[network\] the order of a jet is 1 to 4"),
        ('family = "cloudfit"\n[losses]\nz_direction = 1', UsageError, r"cloudfit has no table \[losses\]"),
        ('base = "a.toml"', InputError, "is its own base"),
        ('base = "absent"', InputError, "absent: no such recipe; there are adafit-baseline"),
    ],
)
def test_mistakes_are_named(tmp_path, text, error, message):
    with pytest.raises(error, match=message):
        read_recipe(written(tmp_path, "a.toml", text))


def test_changes_find_their_tables():
    tables = read_recipe("deepfit-paper").tables()
    changes = parse_changes(
        ["learning_rate=1e-4", "network.weights=adafit", "light = true", "data.weights=[1, 2]"], tables
    )
    assert changes == {
        "training": {"learning_rate": 1e-4},
        "network": {"weights": "adafit", "light": True},
        "data": {"weights": [1, 2]},
    }
    for text, message in [
        ("order", "is not KEY=VALUE"),
        ("weights=adafit", "network.weights or data.weights"),
        ("losses.order=2", "no setting losses.order"),
        ("oder=2", "no setting oder; did you mean order"),
    ]:
        with pytest.raises(UsageError, match=message):
            parse_changes([text], tables)


def test_facts_hold_folders_by_name_alone():
    recipe = make_recipe(read_tables("cloudfit") | {"data": {"folders": ["/a/b", "c"], "validation": "/d/e"}})
    assert recipe.facts()["data"]["folders"] == ["b", "c"]
    assert recipe.facts()["data"]["validation"] == "e"
