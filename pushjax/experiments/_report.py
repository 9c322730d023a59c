"""What experiments share: random start positions, the text of a report, and pictures."""

import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich import box
from rich.console import Console
from rich.table import Table as RichTable

from pushjax import plot
from pushjax.datasets import Recording
from pushjax.plot.style import BLUE, GRAY


class Table(NamedTuple):
    """A table of texts."""

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


class Column(NamedTuple):
    """A column of a table."""

    head: str
    value: str | Callable[[dict[str, Any]], Any]  # key of a row, or function of a row
    form: str = ""  # format of the value


POSE = (  # the columns of a row's "pose", m and rad
    Column("x / mm", lambda row: 1e3 * row["pose"][0], ".2f"),
    Column("y / mm", lambda row: 1e3 * row["pose"][1], ".2f"),
    Column("angle / °", lambda row: np.degrees(row["pose"][2]), ".2f"),
)


def table(rows: Sequence[dict[str, Any]], *columns: tuple[Any, ...]) -> Table:
    """Return the table of records, from the fields of `Column`; "-" stands for None and for no field."""

    def text(row: dict[str, Any], column: Column) -> str:
        value = row.get(column.value) if isinstance(column.value, str) else column.value(row)
        return "-" if value is None else format(value, column.form)

    each = [Column(*column) for column in columns]
    return Table([column.head for column in each], [[text(row, column) for column in each] for row in rows])


def as_text(parts: Sequence[str | Table]) -> str:
    """Return the paragraphs and tables of a report as text."""
    text = io.StringIO()
    console = Console(file=text, width=1000, color_system=None, markup=False, highlight=False, emoji=False)
    for part in parts:
        if isinstance(part, str):
            console.print(part)
            continue
        drawn = RichTable(*part.heads, box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
        for k, column in enumerate(drawn.columns):
            column.justify = "left" if k == 0 else "right"
        for row in part.rows:
            drawn.add_row(*row)
        console.print("", drawn, "", sep="\n")
    lines = "\n".join(line.rstrip() for line in text.getvalue().splitlines())
    return lines.replace("\n\n\n", "\n\n").strip("\n")


def saved(out: Path | None, figures: Callable[[], Mapping[str, Figure]]) -> list[str]:
    """Draw figures, by the names of their files, into the folder `out`, if there is one, and return their paths."""
    return [] if out is None else [str(plot.save(figure, out / name)) for name, figure in figures().items()]


def pushes_by_error(
    pushes: Sequence[Recording], final: np.ndarray, errors: np.ndarray, shares: Mapping[str, float]
) -> dict[str, tuple[Recording, np.ndarray]]:
    """Return the pushes at named shares of the order of their errors (n,), mm, as `plot.real_figure` takes them."""
    order = np.argsort(errors)
    chosen = {name: order[round(share * (len(order) - 1))] for name, share in shares.items()}
    return {f"{name}: {errors[k]:.2f} mm": (pushes[k], final[k]) for name, k in chosen.items()}


def distribution_panel(axes: Axes, predicted: np.ndarray, no_motion: np.ndarray) -> None:
    """Draw the cumulative distributions of the deviations, mm, of the predictions and of the start poses."""
    axes.ecdf(predicted, color=BLUE, label="predicted")
    axes.ecdf(no_motion, ls="--", color=GRAY, label="no motion")
    axes.set(xscale="log", ylim=(0, 1), xlabel="deviation of the final pose / mm", ylabel="share of pushes below")
    axes.legend(loc="upper left")


def uniform_in_circle(rng: np.random.Generator, radius: float, n: int) -> np.ndarray:
    """Sample points (n, 2) uniformly in a circle about the origin, m."""
    distance, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0, 2 * np.pi, n)
    return np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=1)
