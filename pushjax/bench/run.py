"""`pushjax bench`: rows of figures, in turns with the machine's own ceilings; and against figures kept from before."""

import json
import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from pushjax.bench import cases
from pushjax.bench.measure import alternate, both_dtypes, ceiling, compiled, rates
from pushjax.report import envelope

Make = Callable[[str, int], cases.Work]
CASES: dict[str, dict[str, Make]] = {
    "push": {"push_quartic": cases.push},
    "ellipsoid": {"push_ellipsoid": partial(cases.push, model="ellipsoid")},
    "gradient": {"gradient": cases.gradient},
    "grasp": {"grasp_two_fingers": cases.grasp},
    "solve": {f"solve_{m}": partial(cases.solve, contacts=m) for m in (1, 2, 3, 4)},
    "sampling": {"sampling": cases.sampling},
}
BATCH = 2000
SLOWER = 1.5  # times what was kept: more is a regression. Runs beside other programs scatter by 1.2.
MOST_S = 20.0  # of one row
CURVE = (2, 4, 8, 16, 32, 64)  # steps of a push, beside peers


def run(
    case: Sequence[str] = tuple(CASES),
    dtype: Sequence[str] = ("float32", "float64"),
    batch: Sequence[int] = (BATCH,),
    cores: int | None = None,
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

    cores: how many of the machine's may be used, to be said before JAX is; of several, the threads that share a
    program wait for each other, so what it costs of one core is to be measured on one. peers: the same push by MuJoCo
    and MJX beside it, by steps, with a picture in `out`. baseline: a record written before; `slower` then names the
    rows that cost more than `SLOWER` times what they did, both in units of the multiply-add kernel. keep: called with
    the record so far.

    Raises ValueError for a batch that is not positive, cores that are not there, peers that are not installed, or a
    baseline that is no record.
    """
    for number in batch:
        if number < 1:
            raise ValueError(f"batch must be positive; got {number}")
    before = None if baseline is None else kept(baseline)
    if cores is not None:
        _use(cores)
    each = [make for name in case for make in CASES[name].values()]
    makes = [(make, kind, number) for make in each for kind in dtype for number in batch]
    total = len(makes) + (1 if peers else 0)
    rows: list[dict[str, Any]] = []
    settings = {"cases": list(case), "dtypes": list(dtype), "batches": list(batch), "cores": cores, "seed": seed}
    record = envelope("bench", settings, rows=rows, ceilings={}, slower=[])
    with both_dtypes():  # float32 too is compared with what float64 gives
        for done, (make, kind, number) in enumerate(makes):
            row, top = _row(make(kind, number))
            record["ceilings"][kind] = top
            rows.append(row)
            keep(record)
            progress(done + 1, total)
        if peers:
            from pushjax.bench.peers import rows as others

            record["peers"] = others.rows()
            others.compare(rows, record["peers"])
            record["by_steps"] = [_row(cases.push(kind, BATCH, steps=n))[0] for kind in dtype for n in CURVE]
            record["pictures"] = [] if out is None else [others.draw(record, out)]
            progress(total, total)
    if before is not None:
        record["slower"] = slower(rows, before)
    return record


def _use(cores: int) -> None:
    if not hasattr(os, "sched_setaffinity"):
        raise ValueError("--cores can be told to Linux only")
    mine = sorted(os.sched_getaffinity(0))
    if not 1 <= cores <= len(mine):
        raise ValueError(f"--cores must be from 1 to {len(mine)}; got {cores}")
    os.sched_setaffinity(0, mine[:cores])


def _row(work: cases.Work) -> tuple[dict[str, Any], dict[str, float]]:
    program = compiled(work.function, *work.args)
    top = ceiling(work.dtype)
    timings = alternate({"it": program.run, "multiply_add": top.multiply_add.run}, most_s=MOST_S)
    timings |= alternate({"copied": top.copied.run}, repeats=2)
    mine, reference = timings["it"], timings["multiply_add"]
    steps = work.batch * work.steps
    row: dict[str, Any] = {
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
        "flops_needed_per_step": work.needed,
        "compiler_flops": program.flops,
        "compiler_bytes": program.bytes,
        "ceiling_fraction": None,
        # what regressions are judged by: steps' worth of multiply-adds
        "multiply_adds_per_step": mine.processor / steps / (reference.processor / (top.flops / 2)),
        "pose_error_mm": work.error_mm,
        "peer": None,
        "peer_ratio": None,
    }
    if work.needed is not None:
        row["ceiling_fraction"] = work.needed / 2 / row["multiply_adds_per_step"]
    return row, rates(top, timings)


def kept(path: Path) -> dict[str, Any]:
    """A record of `pushjax bench`. Raises ValueError for anything else."""
    try:
        record = json.loads(path.read_text())
        if record["experiment"] != "bench" or not isinstance(record["rows"], list):
            raise KeyError
    except (json.JSONDecodeError, KeyError, TypeError):
        raise ValueError(f"--baseline: {path} holds no record of pushjax bench") from None
    return record


def slower(rows: list[dict[str, Any]], before: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows that cost more than they did, in multiply-adds per step."""
    found = []
    for row in rows:
        for old in before["rows"]:
            if all(old[name] == row[name] for name in ("case", "dtype", "batch")):
                times = row["multiply_adds_per_step"] / old["multiply_adds_per_step"]
                if times > SLOWER:
                    found.append({name: row[name] for name in ("case", "dtype", "batch")} | {"times": times})
    return found


def summary(record: dict[str, Any]) -> str:
    """What the command prints."""
    lines = [
        f"{'case':18}{'dtype':9}{'batch':>8}{'steps':>7}{'compile':>10}{'run':>11}{'steps/s':>10}{'ns/step':>9}"
        f"{'of ceiling':>11}{'error':>11}"
    ]
    for row in record["rows"]:
        share = "" if row["ceiling_fraction"] is None else f"{100 * row['ceiling_fraction']:.1f} %"
        error = "" if row["pose_error_mm"] is None else f"{row['pose_error_mm']:.3f} mm"
        lines.append(
            f"{row['case']:18}{row['dtype']:9}{row['batch']:8}{row['steps']:7.4g}{row['compile_s']:8.2f} s"
            f"{1e3 * row['run_s']:8.1f} ms{row['steps_per_s']:10.2e}{row['ns_per_step']:9.1f}{share:>11}{error:>11}"
        )
    for dtype, top in record["ceilings"].items():
        lines.append(
            f"ceilings, {dtype}: {top['multiply_add_gflops']:.0f} GFLOP/s multiply-add (of one processor), "
            f"{top['copy_gbytes']:.1f} GB/s copied"
        )
    if "peers" in record:
        from pushjax.bench.peers import rows as others

        lines += others.summary(record["peers"], record["rows"])
        lines += [f"drew {path}" for path in record["pictures"]]
    for row in record["slower"]:
        which = f"{row['case']}, {row['dtype']}, {row['batch']}"
        lines.append(f"SLOWER than the baseline: {which}: {row['times']:.2f} times")
    return "\n".join(lines)
