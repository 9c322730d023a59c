"""Time of a step of a push against the size of the batch, drawn.

Times are wall times of whole programs of 8 steps, medians after a first run, divided by pushes and steps.
"""

import json
from pathlib import Path
from typing import Any, Literal

import jax
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from benchmarks import cases
from benchmarks.timing import alternate, compiled
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.plot.files import save
from pushjax.plot.style import STYLE, curve_styles

LABELS = {"push_quartic": "square", "push_t": "T"}
REPEATS = 5


def run(
    batch: tuple[int, ...] = (1, 10, 100, 1000, 10_000, 100_000),
    dtype: Literal["float32", "float64"] = "float32",
    beside: tuple[Path, ...] = (),
    out: Path | None = None,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Time pushes of the square and of a T in batches of several sizes.

    Args:
        batch: Numbers of pushes.
        dtype: Floating type.
        beside: Earlier records of this case, from other machines, whose rows are drawn too.
        out: Folder for the picture.
        progress: Called with the number of rows done and their total.

    Returns:
        The record, with one row for each push and batch.
    """
    jax.config.update("jax_enable_compilation_cache", False)
    rows: list[dict[str, Any]] = []
    makers = (_square, cases.push_t)
    device = jax.devices()[0].device_kind
    for count in batch:
        works = [make(dtype, count) for make in makers]
        programs = {work.case: compiled(work.function, *work.args) for work in works}
        timings = alternate({name: program.run for name, program in programs.items()}, REPEATS)
        for work in works:
            seconds = timings[work.case].median
            row = {"case": work.case, "batch": count, "run_s": seconds, "compile_s": programs[work.case].compile_s}
            rows.append(row | {"ns_per_step": 1e9 * seconds / (count * work.steps), "device": device})
            progress(len(rows), len(batch) * len(makers))
    record = result_record("cost-by-batch", {"batch": batch, "dtype": dtype}, rows=rows, pictures=[])
    if out is not None:
        others = [row for path in beside for row in json.loads(path.read_text())["rows"]]
        record["pictures"] = [save(figure([*rows, *others]), out / "cost_by_batch.png")]
    return record


def figure(rows: list[dict[str, Any]]) -> Figure:
    """Plot the time of a step against the size of the batch, one line for each push and device.

    Args:
        rows: Rows of the records.
    """
    curves: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        device = {"cpu": "CPU"}.get(row["device"], row["device"])
        name = f"{LABELS[row['case']]}, {device}"
        curves.setdefault(name, []).append((row["batch"], row["ns_per_step"]))
    with plt.rc_context(STYLE):
        found, axes = plt.subplots(figsize=(6.8, 3.8), layout="constrained")
        for name, points, look in curve_styles(curves):
            axes.loglog(*zip(*sorted(points), strict=True), ms=4, lw=1.1, label=name, **look)
        axes.set(xlabel="pushes in the batch", ylabel="time per step of a push / ns")
        axes.set_title("What a step costs in a batch")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return found


def summary(record: dict[str, Any]) -> str:
    """Return the text that the command prints: one line per push and batch."""
    lines = [f"{'push':14}{'batch':>10}{'run / ms':>12}{'ns per step':>14}{'compile / s':>13}"]
    for row in record["rows"]:
        lines.append(
            f"{row['case']:14}{row['batch']:10}{1e3 * row['run_s']:12.3f}{row['ns_per_step']:14.2f}"
            f"{row['compile_s']:13.1f}"
        )
    return "\n".join(lines + [f"drew {path}" for path in record["pictures"]])


def _square(dtype: str, batch: int) -> cases.Work:
    """Make the program of the square's pushes, without the search for the fewest steps."""
    one, args = cases.each_push("quartic", dtype, batch, cases.MANY_STEPS)
    function = cases.final_poses(one, batch)
    return cases.Work("push_quartic", dtype, batch, cases.MANY_STEPS, function, args)
