"""`pushjax bench`: rows of figures, in turns with the machine's own ceilings; and against figures kept from before."""

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pushjax.bench import cases, outlines
from pushjax.bench import devices as sharding
from pushjax.bench.measure import Program, Timing, alternate, both_dtypes, called, ceiling, compiled, rates
from pushjax.report import envelope

Make = Callable[[str, int], cases.Work]
CASES: dict[str, tuple[Make, ...]] = {
    "push": (cases.push,),
    "ellipsoid": (partial(cases.push, model="ellipsoid"),),
    "gradient": (cases.gradient,),
    "grasp": (cases.grasp, partial(cases.grasp, varied=True)),
    "solve": tuple(partial(cases.solve, contacts=m) for m in range(1, 9)),
    "sampling": (cases.sampling,),
    "fit": tuple(partial(cases.fit, degree=degree) for degree in (4, 2)),
    "monte_carlo": (cases.monte_carlo,),
    "outline": tuple(partial(outlines.push, which=each) for each in outlines.EACH),
}
BATCH = 2000
BATCHES = {"fit": (200,), "monte_carlo": (2000, 100_000)}  # where it is not that
SHARDED = ("push", "ellipsoid")  # cases that --devices is for
SLOWER = 1.5  # times what was kept: more is a regression. Runs beside other programs scatter by 1.2.
MOST_S = 20.0  # of one row
CURVE = (2, 4, 8, 16, 32, 64)  # steps of a push, beside peers
SAME = ("case", "dtype", "batch", "devices")  # what makes two rows the same one


def run(
    case: Sequence[str] = tuple(CASES),
    dtype: Sequence[str] = ("float32", "float64"),
    batch: Sequence[int] | None = None,
    cores: int | None = None,
    devices: int | None = None,
    peers: bool = False,
    baseline: Path | None = None,
    seed: int = 0,
    out: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """A row for each case, floating type and batch: seconds to compile and to run (wall and processor time, the medians
    of up to seven runs after a first), steps in contact per second, what the compiler counts, and the share of the
    machine's multiply-add ceiling that the FLOPs the mathematics needs make up (of one processor, both by processor
    time).

    batch: default `BATCH`, of some cases `BATCHES`. cores: how many of the machine's may be used, to be said before JAX
    is; of several, the threads that share a program wait for each other, so what it costs of one core is to be measured
    on one. devices: a second row of each push, its batch over that many (`bench.devices`). peers: the same by others
    beside it, of the cases that have such (`peers.rows`); of pushes also by steps, with a picture in `out`. baseline: a
    record written before, with as many cores; `slower` then names the rows that cost more than `SLOWER` times what they
    did, both in units of the multiply-add kernel, `new` those that were not there. keep: called with the record so far.

    Raises ValueError for a batch that is not positive, cores or devices that are not there, peers that are not
    installed or that no case has, or a baseline that is no record.
    """
    for number in batch or ():
        if number < 1:
            raise ValueError(f"batch must be positive; got {number}")
    before = None if baseline is None else kept(baseline, cores)
    if cores is not None:
        _use(cores)
    if devices is not None:
        sharding.ask(devices)
    if peers:
        from pushjax.bench.peers import rows as others

        others.check(case)
    todo = [
        partial(_beside_one, make, kind, number, devices)
        if devices is not None and name in SHARDED
        else partial(_alone, make, kind, number)
        for name in case
        for make in CASES[name]
        for kind in dtype
        for number in batch or BATCHES.get(name, (BATCH,))
    ]
    total = len(todo) + (1 if peers else 0)
    rows: list[dict[str, Any]] = []
    settings = {"cases": list(case), "dtypes": list(dtype), "batches": None if batch is None else list(batch)}
    settings |= {"cores": cores, "devices": devices, "seed": seed}
    record = envelope("bench", settings, rows=rows, ceilings={}, slower=[], new=[])
    with both_dtypes():  # float32 too is compared with what float64 gives
        for done, measured in enumerate(todo):
            found, top = measured()
            record["ceilings"][found[0]["dtype"]] = top
            rows += found
            keep(record)
            progress(done + 1, total)
        if peers:
            from pushjax.bench.peers import rows as others

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


Rows = tuple[list[dict[str, Any]], dict[str, float]]


def _alone(make: Make, dtype: str, batch: int) -> Rows:
    row, top = _row(make(dtype, batch))
    return [row], top


def _beside_one(make: Make, dtype: str, batch: int, devices: int) -> Rows:
    """On one device and on several, in turns."""
    works = [make(dtype, batch), sharding.sharded(make, dtype, batch, devices)]
    programs = [compiled(work.function, *work.args) for work in works]
    timings, top = _timed({str(k): program for k, program in enumerate(programs)}, dtype)
    one, several = (
        _figures(work, program, timings[str(k)], top, on)
        for k, (work, program, on) in enumerate(zip(works, programs, (1, devices), strict=True))
    )
    return [one, several | {"speedup": timings["0"].median / timings["1"].median}], top


def _use(cores: int) -> None:
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("--cores can be told to Linux only")
    mine = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(mine):
        raise ValueError(f"--cores must be from 1 to {len(mine)}; got {cores}")
    os.sched_setaffinity(0, mine[:cores])


def _row(work: cases.Work) -> tuple[dict[str, Any], dict[str, float]]:
    program = (called if work.host else compiled)(work.function, *work.args)
    timings, top = _timed({"it": program}, work.dtype)
    return _figures(work, program, timings["it"], top), top


def _timed(programs: dict[str, Program], dtype: str) -> tuple[dict[str, Timing], dict[str, float]]:
    top = ceiling(dtype)
    runs = {name: program.run for name, program in programs.items()}
    timings = alternate(runs | top.runs(), most_s=MOST_S)
    return timings, rates(top, dtype, timings)


def _figures(
    work: cases.Work, program: Program, mine: Timing, top: dict[str, float], devices: int = 1
) -> dict[str, Any]:
    steps = work.batch * work.steps
    made = program.traffic and program.traffic.times(devices)  # the program is that of one of them
    multiply_add = 2e-9 / top["multiply_add_gflops"]
    row: dict[str, Any] = {
        "case": work.case,
        "dtype": work.dtype,
        "batch": work.batch,
        "devices": devices,
        "steps": work.steps,
        "compile_s": program.compile_s,
        "run_s": mine.median,
        "run_s_middle_half": [mine.low, mine.high],
        "processor_s": mine.processor,
        "steps_per_s": steps / mine.median,
        "ns_per_step": 1e9 * mine.processor / steps,
        "per_processor_s": work.batch / mine.processor,
        "flops_needed_per_step": work.needed,
        # as compiled, which works out some of it several times
        "flops_per_step": made and made.flops / steps,
        "bytes_per_step": made and made.bytes / steps,
        "kernels": made and made.kernels,
        "ceiling_fraction": None,
        "near_copy_fraction": made and 1e-9 * made.bytes / mine.processor / top["near_copy_gbytes"],
        # what regressions are judged by: steps' worth of multiply-adds
        "multiply_adds_per_step": mine.processor / steps / multiply_add,
        "pose_error_mm": work.error_mm,
        "speedup": None,
        "peer": None,
        "peer_ratio": None,
    }
    if work.needed is not None:
        row["ceiling_fraction"] = work.needed / 2 / row["multiply_adds_per_step"]
    return row


def kept(path: Path, cores: int | None) -> dict[str, Any]:
    """A record of `pushjax bench`. Raises ValueError for anything else, or of other cores."""
    try:
        record = json.loads(path.read_text())
        if record["experiment"] != "bench" or not isinstance(record["rows"], list):
            raise KeyError
        there = record["settings"]["cores"]
    except (json.JSONDecodeError, KeyError, TypeError):
        raise ValueError(f"--baseline: {path} holds no record of pushjax bench") from None
    if there != cores:
        raise ValueError(f"--baseline: {path} is of --cores {there or 'all'}; got {cores or 'all'}")
    return record


def slower(rows: list[dict[str, Any]], before: dict[str, Any]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows that cost more than they did, in multiply-adds for one of the batch (also if it takes other steps now); and
    rows that were not there. Raises ValueError if none was."""

    def name(row: dict[str, Any]) -> dict[str, Any]:
        return {"devices": 1} | {key: row[key] for key in SAME if key in row}

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
HEADS = "case,dtype,batch,steps,compile,run,steps/s,ns/step,of ceiling,B/step,of copy,error".split(",")


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
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
            _if_there("{:.1%}", row["ceiling_fraction"]),
            _if_there("{:.0f}", row["bytes_per_step"]),
            _if_there("{:.0%}", row["near_copy_fraction"]),
            _if_there("{:.3f} mm", row["pose_error_mm"]),
        )
        lines.append(COLUMNS.format(*cells))
        if row["speedup"] is not None:
            lines[-1] += f"  {row['devices']} devices: {row['speedup']:.2f} times as fast"
    for dtype, top in record["ceilings"].items():
        lines.append(
            f"ceilings, {dtype}: {top['multiply_add_gflops']:.0f} GFLOP/s multiply-add (of one processor), "
            f"{top['near_copy_gbytes']:.0f} GB/s copied within the second-level cache, {top['copy_gbytes']:.1f} beyond"
        )
    if "peers" in record:
        from pushjax.bench.peers import rows as others

        lines += others.summary(record["peers"], record["rows"])
        lines += [f"drew {path}" for path in record["pictures"]]
    for row in record["new"]:
        lines.append(f"not in the baseline: {_which(row)}")
    for row in record["slower"]:
        lines.append(f"SLOWER than the baseline: {_which(row)}: {row['times']:.2f} times")
    return "\n".join(lines)


def _which(row: dict[str, Any]) -> str:
    return f"{row['case']}, {row['dtype']}, {row['batch']}"


def _if_there(wanted: str, figure: float | None) -> str:
    return "" if figure is None else wanted.format(figure)
