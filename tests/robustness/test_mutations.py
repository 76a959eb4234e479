"""Damaged files give a cloud or one of jetnormal's own errors, in a second. `make fuzz` does the same for longer."""

from __future__ import annotations

import random
import time
from contextlib import suppress
from pathlib import Path

import pytest
from robustness.mutate import mutated
from robustness.readers import CLOUDS, MESHES, OTHERS, READERS, Reader

from jetnormal.errors import InputError, JetnormalError

CORPUS = Path(__file__).with_name("corpus")
SECONDS = 1.0
IN_PROCESS = CLOUDS | MESHES | OTHERS  # compiled libraries might end it


def read(reader: Reader, path: Path) -> None:
    start = time.process_time()
    try:
        reader.read(path)
    except JetnormalError as error:
        assert str(path.parent) in str(error)
        assert "\n" not in str(error)
    assert time.process_time() - start < SECONDS


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", IN_PROCESS)
def test_damaged_files(name, tmp_path):
    reader = IN_PROCESS[name]
    (tmp_path / "seeds").mkdir()
    seeds = reader.seeds(tmp_path / "seeds")
    path = tmp_path / f"a{reader.suffix}"
    for valid in seeds:
        path.write_bytes(valid)
        reader.read(path)
    for number in range(60):
        path.write_bytes(mutated(seeds, random.Random(f"{name} {number}")))
        read(reader, path)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("file", sorted(CORPUS.iterdir()), ids=lambda file: file.name)
def test_the_corpus_of_bad_files(file, tmp_path):
    """Files that once made a reader crash, hang, take gigabytes or raise what is none of jetnormal's errors."""
    path = tmp_path / file.name
    path.write_bytes(file.read_bytes())
    for reader in READERS.values():
        if reader.suffix == path.suffix and reader.available:
            read(reader, path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", "ply\nformat ascii 1.0\nelement vertex 1\n" + "property int t\n" * 20_000 + "end_header\n"),
        (
            "b.ply",
            "ply\nformat ascii 1.0\nelement vertex 1\n"
            + "".join(f"property int t{i}\n" for i in range(20_000))
            + "end_header\n",
        ),
        ("c.pcd", "FIELDS" + " a" * 20_000 + "\nSIZE" + " 4" * 20_000 + "\nTYPE" + " F" * 20_000 + "\nDATA ascii\n"),
        ("d.xyz", "1 " * 500_000 + "\n"),
        ("e.xyz", "1" * 5000 + " 2 3\n"),
        ("f.xyz", "1" * 5000 + "\n1 2 3\n"),
        ("g.csv", "a," * 20_000 + "a\n" + "1," * 20_000 + "1\n"),
    ],
)
def test_a_header_of_many_columns_and_a_number_of_many_digits_take_no_time(tmp_path, name, content):
    path = tmp_path / name
    path.write_text(content)
    start = time.process_time()
    with suppress(InputError):
        CLOUDS[name[2:]].read(path)
    assert time.process_time() - start < 3
