"""Times of the cases, in turns with the machine's own ceilings, and comparison with an earlier record."""

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import cases
from benchmarks.timing import Program, Timing, alternate, both_dtypes, called, ceiling, compiled, rates
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record

Make = Callable[[str, int], cases.Work]
CASES: dict[str, tuple[Make, ...]] = {
    "push": (cases.push,),
    "ellipsoid": (partial(cases.push, model="ellipsoid"),),
    "gradient": (cases.gradient,),
    "grasp": (cases.grasp, partial(cases.grasp, varied=True)),
    "t": tuple(partial(cases.push_t, where=where) for where in ("side", "hull", "corner")),
    "hands": (cases.push_two_fingers, cases.grasp_jaw),
    "solve": tuple(partial(cases.solve, contacts=m) for m in range(1, 9)),
    "sampling": (cases.sampling,),
    "fit": tuple(partial(cases.fit, degree=degree) for degree in (4, 2)),
    "monte_carlo": (cases.monte_carlo,),
    "several": tuple(partial(cases.push_row, kind=kind, count=n) for kind in ("disks", "squares") for n in (1, 2, 3)),
}
BATCH = 2000
BATCHES = {"fit": (200,), "monte_carlo": (2000, 100_000), "several": (256,)}  # for cases with other batches
# A row that costs more than this factor times its baseline is a regression. Runs beside other programs scatter by 1.2.
SLOWER = 1.5
MOST_S = 20.0  # largest time of all runs of one row
CURVE = (2, 4, 8, 16, 32, 64)  # numbers of steps of a push that are drawn beside those of peers
SAME = ("case", "dtype", "batch")  # rows that agree in these are compared with each other


def run(
    case: Sequence[str] = tuple(CASES),
    dtype: Sequence[str] = ("float32", "float64"),
    batch: Sequence[int] | None = None,  # default: BATCH, or BATCHES for the cases named there
    # That may be used (Linux); default: all. It must be set before JAX starts. With several cores, the threads that
    # share a program wait for each other, so the cost per core has to be measured with 1.
    cores: int | None = None,
    peers: bool = False,  # also time the same work by other programs, and pushes with several numbers of steps
    baseline: Path | None = None,  # file of an earlier record, made with the same number of cores
    out: Path | None = None,  # folder for a picture of pushes beside peers; default: no picture
    progress: ProgressCallback = no_progress,  # called with the number of rows done and their total
    keep: Callable[[dict[str, Any]], None] = lambda record: None,  # called with the record so far
) -> dict[str, Any]:
    """Time the cases, with one row for each case, floating type and batch."""
    # A row has the time to compile and to run in s (wall and processor time, medians of up to seven runs after a first
    # one), steps in contact per second, what the compiler counts, and the cost of a step in multiply-adds of one
    # processor at its best. With a baseline, `slower` has the rows that cost more than SLOWER times what they did
    # there, both in units of the multiply-add kernel, and `new` those that are not in it.
    for number in batch or ():
        if number < 1:
            raise ValueError(f"batch must be positive; got {number}")
    before = None if baseline is None else read_baseline(baseline, cores)
    if cores is not None:
        _use(cores)
    if peers:
        from benchmarks.peers import rows as others

        others.check(case)
    todo = [
        partial(make, kind, number)
        for name in case
        for make in CASES[name]
        for kind in dtype
        for number in batch or BATCHES.get(name, (BATCH,))
    ]
    total = len(todo) + (1 if peers else 0)
    rows: list[dict[str, Any]] = []
    settings = {"cases": list(case), "dtypes": list(dtype), "batches": None if batch is None else list(batch)}
    settings |= {"cores": cores}
    record = result_record("bench", settings, rows=rows, ceilings={}, slower=[], new=[])
    with both_dtypes():  # the errors of float32 too are those against float64
        for done, work in enumerate(todo):
            row, top = _row(work())
            record["ceilings"][row["dtype"]] = top
            rows.append(row)
            keep(record)
            progress(done + 1, total)
        if peers:
            from benchmarks.peers import rows as others

            record["peers"] = others.rows(case)
            others.compare(rows, record["peers"])
            record["by_steps"], record["pictures"] = [], []
            if "push" in case:
                record["by_steps"] = [_row(cases.push(kind, BATCH, steps=n))[0] for kind in dtype for n in CURVE]
                record["pictures"] = [] if out is None else [others.draw(record, out)]
            keep(record)
            progress(total, total)
    if before is not None:
        record["slower"], record["new"] = slower(rows, before)
    return record


def _use(cores: int) -> None:
    """Limit this process to so many cores."""
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("--cores can be told to Linux only")
    mine = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(mine):
        raise ValueError(f"--cores must be from 1 to {len(mine)}; got {cores}")
    os.sched_setaffinity(0, mine[:cores])


def _row(work: cases.Work) -> tuple[dict[str, Any], dict[str, float]]:
    """Return the row of one program, and the machine's ceilings, timed in turns with it."""
    program = (called if work.host else compiled)(work.function, *work.args)
    top = ceiling(work.dtype)
    timings = alternate({"case": program.run} | top.runs(), most_s=MOST_S)
    peaks = rates(top, work.dtype, timings)
    return _figures(work, program, timings["case"], peaks), peaks


def _figures(work: cases.Work, program: Program, mine: Timing, top: dict[str, float]) -> dict[str, Any]:
    """Return the row of one program from its timing and from the machine's ceilings."""
    steps, made = work.batch * work.steps, program.traffic
    multiply_add = 2e-9 / top["multiply_add_gflops"]
    return {
        "case": work.case,
        "dtype": work.dtype,
        "batch": work.batch,
        "steps": work.steps,
        "compile_s": program.compile_s,
        "run_s": mine.median,
        "run_s_middle_half": [mine.low, mine.high],
        "processor_s": mine.processor,
        "steps_per_s": steps / mine.median,
        "ns_per_step": 1e9 * mine.processor / steps,
        "per_processor_s": work.batch / mine.processor,
        # as compiled: the compiled program computes some values several times
        "flops_per_step": made and made.flops / steps,
        "bytes_per_step": made and made.bytes / steps,
        "kernels": made and made.kernels,
        "near_copy_fraction": made and 1e-9 * made.bytes / mine.processor / top["near_copy_gbytes"],
        # the cost of a step in multiply-adds, by which regressions are detected
        "multiply_adds_per_step": mine.processor / steps / multiply_add,
        "pose_error_mm": work.error_mm,
        "peer": None,
        "peer_ratio": None,
    }


def read_baseline(path: Path, cores: int | None) -> dict[str, Any]:
    """Read an earlier record of `run`, or raise ValueError if it is not one made with this number of cores."""
    try:
        record = json.loads(path.read_text())
        if record["experiment"] != "bench" or not isinstance(record["rows"], list):
            raise KeyError
        there = record["settings"]["cores"]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise ValueError(f"--baseline: {path} holds no record of python -m benchmarks") from None
    if there != cores:
        raise ValueError(f"--baseline: {path} is of --cores {there or 'all'}; got {cores or 'all'}")
    return record


def slower(rows: list[dict[str, Any]], before: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the rows that cost more than SLOWER times what they did before, and the rows that are new."""
    # Costs are multiply-adds for one of the batch, so a row may take another number of steps than before.

    def name(row: dict[str, Any]) -> dict[str, Any]:
        return {key: row[key] for key in SAME}

    def cost(row: dict[str, Any]) -> float:
        return row["multiply_adds_per_step"] * row["steps"]

    found, new = [], []
    for row in rows:
        same = [old for old in before["rows"] if name(old) == name(row)]
        if not same:
            new.append(name(row))
        elif (times := cost(row) / cost(same[0])) > SLOWER:
            found.append(name(row) | {"times": times})
    if len(new) == len(rows):
        raise ValueError("--baseline has no row of what was measured")
    return found, new


COLUMNS = "{:20}{:9}{:>8}{:>7}{:>10}{:>11}{:>10}{:>9}{:>11}{:>8}{:>9}{:>11}"
HEADS = "case,dtype,batch,steps,compile,run,steps/s,ns/step,mult-adds,B/step,of copy,error".split(",")


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [COLUMNS.format(*HEADS)]
    for row in record["rows"]:
        cells = (
            row["case"],
            row["dtype"],
            row["batch"],
            f"{row['steps']:.4g}",
            f"{row['compile_s']:.2f} s",
            f"{1e3 * row['run_s']:.1f} ms",
            f"{row['steps_per_s']:.2e}",
            f"{row['ns_per_step']:.1f}",
            f"{row['multiply_adds_per_step']:.0f}",
            _if_there("{:.0f}", row["bytes_per_step"]),
            _if_there("{:.0%}", row["near_copy_fraction"]),
            _if_there("{:.3f} mm", row["pose_error_mm"]),
        )
        lines.append(COLUMNS.format(*cells))
    for dtype, top in record["ceilings"].items():
        lines.append(
            f"ceilings, {dtype}: {top['multiply_add_gflops']:.0f} GFLOP/s multiply-add (of one processor), "
            f"{top['near_copy_gbytes']:.0f} GB/s copied within the second-level cache, {top['copy_gbytes']:.1f} beyond"
        )
    if "peers" in record:
        from benchmarks.peers import rows as others

        lines += others.summary(record["peers"], record["rows"])
        lines += [f"drew {path}" for path in record["pictures"]]
    for row in record["new"]:
        lines.append(f"not in the baseline: {_which(row)}")
    for row in record["slower"]:
        lines.append(f"SLOWER than the baseline: {_which(row)}: {row['times']:.2f} times")
    return "\n".join(lines)


def _which(row: dict[str, Any]) -> str:
    """Return what identifies a row, as text."""
    return f"{row['case']}, {row['dtype']}, {row['batch']}"


def _if_there(wanted: str, figure: float | None) -> str:
    """Return the formatted figure, or an empty text for None."""
    return "" if figure is None else wanted.format(figure)
