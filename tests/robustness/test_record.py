"""The tables that `make fuzz` and `make torture` write."""

from __future__ import annotations

from robustness.record import record_rows

DOCUMENT = """Text.

<!-- fuzz -->

| reader | inputs |
|---|---|
| ply | 5 |
| pcd | 6 |

More.
"""


def test_rows_are_replaced_and_added_in_their_place(tmp_path):
    path = tmp_path / "table.md"
    path.write_text(DOCUMENT)
    record_rows(path, "fuzz", [("ply", ["7"]), ("xyz", ["8"])])
    assert path.read_text() == DOCUMENT.replace("| ply | 5 |", "| ply | 7 |").replace("| 6 |\n", "| 6 |\n| xyz | 8 |\n")


def test_a_table_may_be_empty(tmp_path):
    path = tmp_path / "table.md"
    path.write_text("<!-- torture -->\n\n| command | tries |\n|---|---|\n")
    record_rows(path, "torture", [("train", ["50"])])
    assert path.read_text().endswith("|---|---|\n| train | 50 |\n")
