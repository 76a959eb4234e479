"""What the documentation tells people to type works as written.

Blocks marked `sh` and `python` run, page by page, in a folder with small clouds of the names that the pages use. Blocks
marked `text` (long trainings, installations) do not run, but the options in them must exist.
"""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import typer
from shapes import cube, sphere

from jetnormal import Cloud, Mesh, write
from jetnormal.cli.app import app
from jetnormal.errors import InputError
from jetnormal.formats.meshes import write_mesh
from jetnormal.support.open3d_loader import import_open3d

ROOT = Path(__file__).parents[2]
PAGES = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md"))]
CARDS = ["CONTRIBUTING.md", *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "models").glob("[!R]*.md"))]
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```", re.M | re.S)


def blocks(page: str, *kinds: str) -> list[tuple[str, str]]:
    return [(kind, text) for kind, text in BLOCK.findall((ROOT / page).read_text()) if kind in kinds]


def commands(text: str) -> list[list[str]]:
    """The words of each line, continued lines joined and comments left out."""
    lines = text.replace("\\\n", " ").splitlines()
    return [words for line in lines if (words := shlex.split(line, comments=True))]


@pytest.fixture(scope="session")
def scans(tmp_path_factory) -> Path:
    """A folder with a small cloud or mesh under each name that the pages use."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(0)
    colors = {name: rng.integers(0, 256, 1500).astype(np.uint8) for name in ("red", "green", "blue")}
    write(Cloud(sphere(1500) * [1, 0.8, 0.6], attributes=colors), folder / "scan.ply")
    walls = rng.uniform(-1, 1, size=(1500, 3))
    walls[np.arange(1500), rng.integers(0, 3, 1500)] = rng.choice([-1.0, 1.0], 1500)
    write(Cloud(walls * [3, 2, 1.5] + [0, 0, 1.5]), folder / "room.ply")
    ground = np.c_[rng.uniform(0, 100, size=(1500, 2)), np.zeros(1500)]
    ground[:, 2] = 3 * np.sin(ground[:, 0] / 10)
    write(Cloud(ground), folder / "terrain.xyz")
    above = ground + np.array([0, 0, 2])
    sensor = {f"sensor_{axis}": values for axis, values in zip("xyz", above.T, strict=True)}
    write(Cloud(ground, attributes=sensor), folder / "drive.ply")
    (folder / "meshes").mkdir()
    write_mesh(Mesh(*cube()), folder / "meshes" / "cube.ply")
    shutil.copytree(ROOT / "samples", folder / "samples")
    return folder


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "sh", "python")])
def test_the_blocks_of_a_page_run_as_written(page, scans, tmp_path, monkeypatch):
    if import_open3d() is None:
        pytest.skip("the meshes of the pages need Open3D")
    folder = tmp_path / "work"
    shutil.copytree(scans, folder)
    monkeypatch.chdir(folder)
    for kind, text in blocks(page, "sh", "python"):
        if kind == "python":
            exec(compile(text, page, "exec"), {})
            continue
        for words in commands(text):
            if words[0] == "jetnormal":
                app(words[1:], standalone_mode=False)
            else:
                subprocess.run(words, check=True)


@pytest.mark.parametrize("page", [*PAGES, *CARDS])
def test_the_options_that_a_page_names_exist(page):
    program = typer.main.get_command(app)
    for _, text in blocks(page, "sh", "text"):
        for words in commands(text):
            if "jetnormal" not in words or words[0] in ("docker", "pip"):
                continue
            name, *rest = words[words.index("jetnormal") + 1 :]
            command = program.commands[name]
            options = {
                option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)
            }
            for word in rest:
                if word.startswith("--"):
                    assert word.split("=")[0] in options, f"{page}: jetnormal {name} has no option {word}"


@pytest.mark.parametrize("page", [*PAGES, *CARDS])
def test_commands_name_files_of_the_repository(page):
    for script in re.findall(r"python ((?:benchmarks|docs|examples)/\S+\.py)", (ROOT / page).read_text()):
        assert (ROOT / script).is_file(), f"{page} names {script}"


def test_links_within_the_repository_lead_somewhere():
    """The site's own links are checked when it is built; these are read on a forge or in an editor."""
    others = [f"{folder}/README.md" for folder in ("samples", "models", "benchmarks/results")]
    pages = [path.relative_to(ROOT) for path in (ROOT / "docs").glob("*.md")]
    for page in ["README.md", "CHANGELOG.md", "CONTRIBUTING.md", *CARDS, *others, *pages]:
        for link in re.findall(r"\]\(([^)#]+)[^)]*\)", (ROOT / page).read_text()):
            assert "://" in link or (ROOT / page).parent.joinpath(link).exists(), f"{page}: {link}"


def test_the_example_of_a_format_keeps_points_and_normals(tmp_path):
    names: dict = {}
    exec(next(text for _, text in blocks("docs/formats.md", "python") if "FORMATS" in text), names)
    (rows,) = names["FORMATS"]
    path = tmp_path / "a.rows"
    with path.open("wb") as stream:
        lost = rows.write(Cloud(sphere(20), sphere(20), {"label": np.arange(20)}), stream, "binary")
    assert len(lost) == 1 and "label" in lost[0]
    np.testing.assert_array_equal(rows.read(path).points, sphere(20))
    np.testing.assert_allclose(rows.read(path).normals, sphere(20), atol=1e-7)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match="damaged"):
        rows.read(path)


def test_the_readme_is_short_and_its_numbers_stand_in_the_results():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 120 and max(map(len, text.splitlines())) <= 120
    paragraph = text[text.index("Accuracy:") : text.index("## Documentation")]
    results = "".join(path.read_text() for path in (ROOT / "benchmarks" / "results").glob("*.md"))
    numbers = re.findall(r"\d+\.\d+", paragraph)
    assert numbers and [number for number in numbers if number not in results] == []
