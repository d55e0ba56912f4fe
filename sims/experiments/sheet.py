"""A table of results: written as Markdown and CSV, shown on a terminal."""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from ocp.files import write_text

ABSENT = "absent"


@dataclass
class Sheet:
    """Rows of text under named columns.

    Attributes:
        title: what the table shows.
        columns: their names; the first column names the rows.
        rows: as many cells as columns.
        notes: below the table.
    """

    title: str
    columns: Sequence[str]
    rows: list[Sequence[str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, *cells: str) -> None:
        """One row."""
        if len(cells) != len(self.columns):
            raise ValueError(f"row: needs {len(self.columns)} cells, got {len(cells)}")
        self.rows.append(cells)

    def markdown(self) -> str:
        """The table in Markdown, its title as a heading."""
        lines = [f"## {self.title}", "", _row(self.columns)]
        lines.append("|" + "|".join([" :-- ", *[" --: "] * (len(self.columns) - 1)]) + "|")
        lines += [_row(row) for row in self.rows]
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines) + "\n"

    def csv(self) -> str:
        """The table as comma-separated values."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows(self.rows)
        return text.getvalue()

    def terminal(self) -> Table:
        """The table for a terminal."""
        table = Table(title=self.title)
        for k, column in enumerate(self.columns):
            table.add_column(column, justify="left" if k == 0 else "right")
        for row in self.rows:
            table.add_row(*row)
        return table

    def write(self, folder: Path, stem: str) -> None:
        """`stem`.md and `stem`.csv into `folder`."""
        write_text(folder / f"{stem}.md", self.markdown())
        write_text(folder / f"{stem}.csv", self.csv())


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def number(value: float | None, form: str = "{:.2f}", missing: str = "-") -> str:
    """A number for a table, or what stands for none."""
    return missing if value is None else form.format(value)


def percent(value: float | None, missing: str = "-") -> str:
    """A fraction as percent, with digits for small ones."""
    if value is None:
        return missing
    if abs(value) >= 1e4:
        return "over 1e6 %"
    return f"{100 * value:.2f} %" if abs(value) < 0.1 else f"{100 * value:.1f} %"


def seconds(value: float | None, missing: str = "-") -> str:
    """A duration in the unit that suits it."""
    if value is None:
        return missing
    if value < 1e-3:
        return f"{1e6 * value:.0f} µs"
    if value < 1:
        return f"{1e3 * value:.3g} ms"
    return f"{value:.3g} s" if value < 120 else f"{value / 60:.3g} min"
