"""An evaluation as text: tables for a terminal or in Markdown, and rows for a spreadsheet."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import IO

from jetnormal.evaluation.results import Evaluation, ModelResult
from jetnormal.evaluation.scores import AUC_LIMIT, Scores

LATEX = str.maketrans(
    {char: f"\\{char}" for char in "&%$#_{}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "°": r"\textdegree{}",
        "–": "--",
    }
)
"""Characters that mean something else to LaTeX."""


@dataclass(frozen=True)
class Table:
    """Rows of numbers, one per model.

    Attributes:
        title: what is in it.
        columns: headings, that of the names first.
        names: of the rows.
        values: one row of numbers for each name; None where there is none.
        formats: of the columns of numbers.
        lower_is_better: of the columns of numbers.
    """

    title: str
    columns: list[str]
    names: list[str]
    values: list[list[float | None]]
    formats: list[Callable[[float], str]]
    lower_is_better: list[bool]

    def cells(self) -> Iterator[list[tuple[str, bool]]]:
        """Yield rows of texts, each with whether it is the best of its column (never in a single row)."""
        best: list[str] = []
        for column, lower in enumerate(self.lower_is_better):
            present = [value for row in self.values if (value := row[column]) is not None]
            best.append(self.formats[column]((min if lower else max)(present)) if len(self.values) > 1 else "")
        for row in self.values:
            texts = ["–" if value is None else show(value) for value, show in zip(row, self.formats, strict=True)]
            yield [(text, text == top) for text, top in zip(texts, best, strict=True)]


def make_tables(evaluation: Evaluation) -> list[Table]:
    """Make tables of RMSE, PGP5 and PGP10 by category, and of the averages of the other scores with the speed."""
    by_category = [
        _table_by_category(evaluation, "RMSE (degrees)", lambda scores: scores.rmse, _degrees, lower=True),
        _table_by_category(evaluation, "PGP5 (%)", lambda scores: scores.pgp5, _percent),
        _table_by_category(evaluation, "PGP10 (%)", lambda scores: scores.pgp10, _percent),
    ]
    return [*by_category, _overview(evaluation)]


def _table_by_category(
    evaluation: Evaluation,
    title: str,
    value: Callable[[Scores], float],
    show: Callable[[float], str],
    lower: bool = False,
) -> Table:
    models = evaluation.models
    several = len(models[0].categories) > 1
    columns = ["model", *models[0].categories, *(["average"] if several else [])]
    values: list[list[float | None]] = [
        [value(scores) for scores in (*model.categories.values(), *([model.average] if several else []))]
        for model in models
    ]
    count = len(columns) - 1
    return Table(title, columns, [model.model for model in models], values, [show] * count, [lower] * count)


def _overview(evaluation: Evaluation) -> Table:
    """Make the table of the other averages over the categories, as far as they are known, and of the speed."""
    measures: list[tuple[str, Callable[[ModelResult], float | None], Callable[[float], str], bool]] = [
        ("median (°)", lambda model: model.average.median, _degrees, True),
        (f"AUC{AUC_LIMIT:.0f} (%)", lambda model: model.average.auc, _percent, False),
        ("RMSE to clean (°)", lambda model: model.average.clean_rmse, _degrees, True),
        ("oriented RMSE (°)", lambda model: model.average.oriented_rmse, _degrees, True),
        ("signs right (%)", lambda model: model.average.sign_accuracy, _percent, False),
        ("seconds", lambda model: model.seconds, _tenths, True),
        ("points/s", lambda model: model.points_per_second, _thousands, False),
    ]
    models = evaluation.models
    measures = [measure for measure in measures if any(measure[1](model) is not None for model in models)]
    return Table(
        "averages, and speed",
        ["model", *(name for name, *_ in measures)],
        [model.model for model in models],
        [[value(model) for _, value, _, _ in measures] for model in models],
        [show for _, _, show, _ in measures],
        [lower for *_, lower in measures],
    )


def _degrees(value: float) -> str:
    return f"{value:.2f}"


def _percent(value: float) -> str:
    return f"{100 * value:.1f}"


def _tenths(value: float) -> str:
    return f"{value:,.1f}"


def _thousands(value: float) -> str:
    return f"{value:,.0f}"


def print_tables(tables: list[Table], stream: IO[str]) -> None:
    """Print tables with Rich, the best of each column bold; as wide as need be where no terminal sets a width."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable
    from rich.text import Text

    console = Console(file=stream, highlight=False, width=None if stream.isatty() else 10_000)
    for table in tables:
        shown = RichTable(title=table.title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
        shown.add_column(table.columns[0], overflow="fold")
        for column in table.columns[1:]:
            shown.add_column(column, justify="right")
        for name, row in zip(table.names, table.cells(), strict=True):
            shown.add_row(Text(name), *(Text(text, style="bold green" if best else "") for text, best in row))
        console.print(shown)


def markdown(tables: list[Table]) -> str:
    """Write tables in Markdown, the best of each column bold."""
    lines: list[str] = []
    for table in tables:
        lines += [f"**{table.title}**", "", _markdown_row(table.columns)]
        lines.append("|---|" + "---:|" * (len(table.columns) - 1))
        for name, row in zip(table.names, table.cells(), strict=True):
            lines.append(_markdown_row([f"`{name}`", *(f"**{text}**" if best else text for text, best in row)]))
        lines.append("")
    return "\n".join(lines)


def _markdown_row(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"


def latex(tables: list[Table]) -> str:
    """Write tables in LaTeX, for the package booktabs, the best of each column bold."""
    lines: list[str] = []
    for table in tables:
        lines += [f"% {table.title}", rf"\begin{{tabular}}{{l{'r' * (len(table.columns) - 1)}}}", r"\toprule"]
        lines += [_latex_row(map(_latex_text, table.columns)), r"\midrule"]
        for name, row in zip(table.names, table.cells(), strict=True):
            cells = (rf"\textbf{{{_latex_text(text)}}}" if best else _latex_text(text) for text, best in row)
            lines.append(_latex_row([rf"\texttt{{{_latex_text(name)}}}", *cells]))
        lines += [r"\bottomrule", r"\end{tabular}", ""]
    return "\n".join(lines)


def _latex_row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _latex_text(text: str) -> str:
    return text.translate(LATEX)


def comma_separated(evaluation: Evaluation) -> str:
    """Write all scores as CSV: a row for each model and cloud, then for each category, then the average."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] | None = None
    for model in evaluation.models:
        for category, cloud, scores in _rows(model, evaluation.clouds):
            row = {"model": model.model, "category": category, "cloud": cloud} | asdict(scores)
            if cloud in model.clouds:
                row |= {"points": model.clouds[cloud].points, "seconds": model.clouds[cloud].seconds}
            if writer is None:
                writer = csv.DictWriter(stream, [*row], lineterminator="\n")
                writer.writeheader()
            writer.writerow({key: f"{value:.6g}" if isinstance(value, float) else value for key, value in row.items()})
    return stream.getvalue()


def _rows(model: ModelResult, clouds: dict[str, str]) -> Iterator[tuple[str, str, Scores]]:
    """Yield category, cloud and scores: for each cloud, for each category, for the average."""
    for name, result in model.clouds.items():
        yield clouds[name], name, result.scores
    for category, scores in model.categories.items():
        yield category, "", scores
    yield "average", "", model.average
