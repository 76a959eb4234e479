from __future__ import annotations

import csv
import io

import pytest

from jetnormal import evaluate
from jetnormal.evaluation.tables import comma_separated, latex, make_tables, markdown, print_tables


@pytest.fixture
def evaluation(folder, turned):
    return evaluate(folder, [turned(2.0, "coarse"), turned(1.0, "fine")])


def printed(tables) -> str:
    stream = io.StringIO()
    print_tables(tables, stream)
    return stream.getvalue()


def test_tables_have_a_row_per_model_and_a_column_per_category(evaluation):
    rmse, pgp5, pgp10, overview = make_tables(evaluation)
    assert rmse.columns == ["model", "none", "low", "medium", "high", "gradient", "striped", "average"]
    assert rmse.names == ["coarse", "fine"]
    coarse, fine = rmse.cells()
    assert [text for text, _ in coarse] == ["4.00", "8.00", "10.00", "12.00", "14.00", "16.00", "10.67"]
    assert [best for _, best in coarse] == [False] * 7
    assert fine == [(text, True) for text in ["2.00", "4.00", "5.00", "6.00", "7.00", "8.00", "5.33"]]
    coarse, fine = pgp5.cells()
    assert (coarse[0], fine[0], coarse[2]) == (("50.0", False), ("100.0", True), ("0.0", False))
    coarse, fine = pgp10.cells()
    assert coarse[0] == fine[0] == ("100.0", True)
    assert overview.columns == ["model", "median (°)", "AUC30 (%)", "RMSE to clean (°)", "seconds", "points/s"]


def test_scores_that_no_model_has_have_no_column(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "ball")
    plain, oriented = (make_tables(evaluate(tmp_path, [turned(1.0)], orient=way))[3] for way in ("none", "mst"))
    assert plain.columns == ["model", "median (°)", "AUC30 (%)", "seconds", "points/s"]
    assert oriented.columns[3:5] == ["oriented RMSE (°)", "signs right (%)"]
    assert not any(best for row in plain.cells() for _, best in row)  # nothing to be better than


def test_printed_tables_are_not_cut_where_there_is_no_terminal(folder, turned):
    name = "a/very/long/path/" * 8 + "model.safetensors[1]"
    text = printed(make_tables(evaluate(folder, [turned(1.0, name), turned(2.0, "other")])))
    assert text.count(name) == 4
    lines = [line.split() for line in text.splitlines()]
    assert ["other", "4.00", "8.00", "10.00", "12.00", "14.00", "16.00", "10.67"] in lines


def test_markdown_marks_the_best(evaluation):
    lines = markdown(make_tables(evaluation)).splitlines()
    assert lines[2] == "| model | none | low | medium | high | gradient | striped | average |"
    assert lines[3] == "|---|---:|---:|---:|---:|---:|---:|---:|"
    assert lines[4] == "| `coarse` | 4.00 | 8.00 | 10.00 | 12.00 | 14.00 | 16.00 | 10.67 |"
    assert lines[5].startswith("| `fine` | **2.00** | **4.00** |")


def test_latex_marks_the_best_and_escapes_names(folder, turned):
    lines = latex(make_tables(evaluate(folder, [turned(2.0, "a_b/50%"), turned(1.0, "fine")]))).splitlines()
    assert lines[1:4] == [
        r"\begin{tabular}{lrrrrrrr}", r"\toprule",
        r"model & none & low & medium & high & gradient & striped & average \\",
    ]  # fmt: skip
    assert lines[5] == r"\texttt{a\_b/50\%} & 4.00 & 8.00 & 10.00 & 12.00 & 14.00 & 16.00 & 10.67 \\"
    assert lines[6].startswith(r"\texttt{fine} & \textbf{2.00} & \textbf{4.00}")
    assert sum(line == r"\end{tabular}" for line in lines) == 4
    assert any(r"median (\textdegree{})" in line for line in lines)


def test_a_single_category_needs_no_average(tmp_path, write_sphere, turned):
    write_sphere(tmp_path, "ball")
    rmse = make_tables(evaluate(tmp_path, [turned(1.0)]))[0]
    assert rmse.columns == ["model", "none"]


def test_csv_has_a_row_per_cloud_category_and_average(evaluation):
    rows = list(csv.DictReader(io.StringIO(comma_separated(evaluation))))
    assert len(rows) == 2 * (7 + 6 + 1)
    fine = {(row["category"], row["cloud"]): row for row in rows if row["model"] == "fine"}
    assert float(fine["none", "bb"]["rmse"]) == pytest.approx(3, abs=1e-3)
    assert float(fine["none", ""]["rmse"]) == pytest.approx(2, abs=1e-3)
    assert float(fine["average", ""]["rmse"]) == pytest.approx(32 / 6, abs=1e-3)
    assert fine["none", "bb"]["points"] == "400"
    assert fine["none", "bb"]["oriented_rmse"] == fine["average", ""]["seconds"] == ""
