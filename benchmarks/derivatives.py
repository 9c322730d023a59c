"""Cost of the derivatives of pushes and their agreement with finite differences.

- `cost`: time of reverse and forward mode beside the push alone: 200 steps, float32, timed in turns in one run.
- `memory`: memory that reverse mode needs, as counted by the compiler, and ways to need less.
- `agreement`: relative error |derivative - difference| / max(1, |difference|) of random pushes against central
  differences, in float64, with lengths in units of the surface's. Differences of two widths, H and H / 4, are
  extrapolated, so that neither the truncation error (1e-20 times the fifth derivative) nor roundoff (1e-10) matters. A
  push is compared where the modes, the status and, for one finger, the touched edge or vertex are the same in every
  step on both sides, and a hand that jams stops in the same part of a step, because elsewhere there may be no
  derivative. Where the error is still large, it is computed once more with differences of width FINE.
- `grasps`: the same for random grasps.
- `random`: derivatives of E[f] by `dof` and by the range of friction through `random_rollout`, against differences of
  means.
- `picture`: the final angle and its derivative along three lines: friction, start of a push, start angle in a jaw.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import pushjax as pj
from benchmarks._derivative_cases import (
    LENGTH,
    RADIUS,
    TOLERANCE,
    Batched,
    Case,
    compare,
    fitted,
    grasps,
    one_finger,
    two_fingers,
)
from benchmarks.timing import Program, alternate, compiled
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record

Part = Literal["cost", "memory", "agreement", "grasps", "random", "picture"]
Row = dict[str, Any]
MANY, FEW, GRASPS, JAWS, QUICK = 10_000, 1000, 300, 100, 40


# --- cost and memory ---


class Timed(NamedTuple):
    """Pushes in float32 and a scalar of each."""

    scalar: Callable  # of the friction, start pose and coefficients of one push
    inputs: tuple  # of `scalar`, with a leading axis of the batch; it is differentiated by all

    def total(self, *inputs):
        """Return the sum of the scalars of all pushes."""
        return jnp.sum(jax.vmap(self.scalar)(*inputs))


def pushes(fingers: int, batch: int, steps: int, stretch: int | None = None) -> Timed:
    """Return pushes of a square by one or two fingers, with `jax.checkpoint` of each stretch of steps if given."""
    # Then reverse mode stores one pose of each stretch and recomputes its steps. Otherwise it stores what it needs of
    # every step.
    block, key = pj.Polygon.rectangle(0.09, 0.09), jax.random.key(1)
    mean = fitted(block, jnp.float32)
    one, two = jnp.array([-0.06, 0.01]), jnp.array([-0.06, 0.01, 0.0, 0.05])
    way = jnp.array([0.05, 0.0]) if fingers == 1 else jnp.array([0.05, 0.01, 0.2, 0.0])
    start = one if fingers == 1 else two
    hand = pj.Hand.finger(RADIUS) if fingers == 1 else pj.Hand.two_fingers(RADIUS)
    path = pj.line(start, start + way, steps)
    k1, k2, k3 = jax.random.split(key, 3)
    coefficients = mean.coefficients * (1 + 0.01 * jax.random.normal(k1, (batch, 15)))
    poses = jnp.array([1e-3, 1e-3, 0.05]) * jax.random.normal(k2, (batch, 3))
    friction = jax.random.uniform(k3, (batch,), minval=0.15, maxval=0.35)

    def scalar(mu, pose, c):
        slider = pj.Slider(block, pj.Quartic(c, mean.length))
        if stretch is None:
            end = pj.rollout(slider, hand, path, pose=pose, friction=mu).pose[-1]
        else:
            parts = jnp.arange(steps // stretch)[:, None] * stretch + jnp.arange(stretch + 1)
            push = jax.checkpoint(lambda at, part: pj.rollout(slider, hand, part, pose=at, friction=mu).pose[-1])
            end, _ = jax.lax.scan(lambda at, part: (push(at, part), None), pose, path[parts])
        return jnp.sum((end / jnp.array([LENGTH, LENGTH, 1.0])) ** 2)

    return Timed(scalar, (friction, poses, coefficients))


def cost(quick: bool) -> list[Row]:
    """Time the push, its gradient and its tangent, for one and two fingers."""
    batch, rows = 50 if quick else 2000, []
    for fingers, target in ((1, 4.0), (2, 6.0)):
        timed = pushes(fingers, batch, 200)

        def tangent(mu, *others, timed=timed):
            return jax.jvp(lambda m: timed.total(m, *others), (mu,), (jnp.ones_like(mu),))

        functions = {"push": timed.total, "gradient": jax.grad(timed.total, argnums=(0, 1, 2)), "tangent": tangent}
        ready = {name: compiled(function, *timed.inputs) for name, function in functions.items()}
        timings = alternate({name: program.run for name, program in ready.items()}, repeats=7 // fingers)
        for name, program in ready.items():
            row: Row = {"fingers": fingers, "batch": batch, "steps": 200, "what": name, "run_s": timings[name].median}
            row |= {"compile_s": program.compile_s, "ratio": timings[name].median / timings["push"].median}
            rows.append(row | {"bytes": stored(program), "target": target if name == "gradient" else None})
    return rows


def stored(program: Program) -> int:
    """Return the bytes that the compiler reserved for the program in addition to its inputs and outputs."""
    call: Any = program.call
    return call.memory_analysis().temp_size_in_bytes


def memory(quick: bool) -> list[Row]:
    """Measure memory and time of the gradient, as it is and with three ways to need less memory."""
    batch = 50 if quick else 2000
    timed, stretched = pushes(1, batch, 200), pushes(1, batch, 200, stretch=20)
    again = Timed(jax.checkpoint(timed.scalar), timed.inputs)

    def chunks(*inputs):
        return jnp.sum(jax.lax.map(lambda each: timed.scalar(*each), inputs, batch_size=batch // 10))

    ways = {"as it is": timed.total, "jax.checkpoint of the scalar": again.total}
    ways |= {"stretches of 20 steps, each in jax.checkpoint": stretched.total, "lax.map, a tenth at once": chunks}
    ready = {name: compiled(jax.grad(way, argnums=(0, 1, 2)), *timed.inputs) for name, way in ways.items()}
    timings = alternate({name: program.run for name, program in ready.items()})
    about = {"batch": batch, "steps": 200}
    return [
        about | {"way": name, "bytes": stored(each), "run_s": timings[name].median, "compile_s": each.compile_s}
        for name, each in ready.items()
    ]


# --- agreement ---


def agreement(quick: bool) -> list[Row]:
    """Compare the derivatives of random pushes with central differences."""
    few, many = (QUICK, QUICK) if quick else (FEW, MANY)
    return judged({"one finger, pentagons": one_finger(many), "two fingers push": two_fingers(few)})


def grasping(quick: bool) -> list[Row]:
    """Compare the derivatives of random grasps with central differences."""
    few, fewer = (QUICK, QUICK) if quick else (GRASPS, JAWS)
    return judged({"two fingers grasp": grasps(False, few), "jaw grasps": grasps(True, fewer)})


def judged(cases: dict[str, Case]) -> list[Row]:
    """Compare each case with central differences, and return one row for each."""
    rows = []
    for name, case in cases.items():
        found = compare(case)
        error = found.error[found.same]
        last, failed = found.status[:, -1], np.isin(found.status, [s for s in pj.Status if s.failed]).any(axis=1)
        row = {"case": name, "pushes": len(case.inputs), "directions": len(case.along), "finite": found.finite.sum()}
        row |= {"judged": len(error), "left_out": found.same.size - len(error), "failed": failed.sum()}
        row |= {"held": np.isin(last, [pj.Status.GRASPED, pj.Status.JAMMED]).sum()}
        row |= {f"q{100 * q:g}": np.quantile(error, q) for q in (0.5, 0.99, 0.999)} | {"largest": error.max()}
        row |= {"above": (error > TOLERANCE).sum(), "above_fine": (found.fine > TOLERANCE).sum()}
        row |= {"largest_fine": np.where(found.error > TOLERANCE, found.fine, found.error).max()}
        rows.append(row)
    return rows


# --- random friction ---


def random(quick: bool) -> list[Row]:
    """Compare derivatives of means over random friction with differences of means, for the README's square."""
    block, hand, n, rows = pj.Polygon.rectangle(0.09, 0.09), pj.Hand.finger(RADIUS), 1000 if quick else 20_000, []
    slider, path = pj.Slider(block, fitted(block, float)), pj.line((-0.06, 0.01), (-0.01, 0.01), 50)
    names, keys = ["dof", "lowest mu", "highest mu"], jax.random.split(jax.random.key(7), n)
    raw = np.asarray(jax.random.key_data(keys))
    programs: dict[str, tuple[Batched, Batched]] = {}
    samplers: list[tuple[Any, float]] = [("gram", 50.0), ("gram", 20.0), ("gram", 12.0), ("sum_of_squares", 20.0)]
    for sampler, dof in samplers:

        def moments(given, key, sampler=sampler):
            model = pj.FrictionModel(dof=given[0], friction=given[1:], sampler=sampler)
            key = jax.random.wrap_key_data(key)
            end = pj.random_rollout(key, slider, hand, path, pose=jnp.zeros(3), model=model).push.pose[-1]
            return jnp.stack([end[0] / LENGTH, end[2], (end[2] + 0.4) ** 2])

        values, slopes = programs.setdefault(sampler, (Batched(moments, 4000), Batched(jax.jacfwd(moments), 4000)))
        at, width = np.array([dof, 0.15, 0.35]), np.array([0.05 * dof, 0.002, 0.002])
        slope = slopes(np.tile(at, (n, 1)), raw)
        for k, name in enumerate(names):
            shift = np.eye(3)[k] * width
            ends = [values(np.tile(at + sign * shift, (n, 1)), raw) for sign in (1, -1)]
            difference = (ends[0] - ends[1]) / (2 * width[k])
            mine, theirs = slope[:, :, k].mean(axis=0), difference.mean(axis=0)
            paired = (slope[:, :, k] - difference).std(axis=0) / np.sqrt(n)
            rows.append({"sampler": sampler, "dof": dof, "by": name, "derivative": mine, "difference": theirs})
            rows[-1] |= {"standard_error": paired, "finite": np.isfinite(slope[:, :, k]).all()}
    return rows


# --- the picture ---


def lines(quick: bool) -> list[tuple[str, str, Callable, np.ndarray]]:
    """Return the title, the axis, the final angle (deg) as a function of one number, and the numbers of each line."""
    block, jaw = pj.Polygon.rectangle(0.09, 0.09), pj.Hand.parallel_jaw(0.027, 0.01)
    square = pj.Slider(block, fitted(block, float))
    small = pj.Slider(pj.Polygon.rectangle(0.05, 0.035), square.surface)
    unit = jnp.array([jnp.cos(0.35), jnp.sin(0.35)])

    def push(start, way, mu):
        path = start[None] + jnp.linspace(0, 1, 61)[:, None] * way[None]
        run = pj.rollout(square, pj.Hand.finger(RADIUS), path, pose=jnp.zeros(3), friction=mu)
        return jnp.degrees(run.pose[-1, 2])

    def closed(angle):
        path = pj.line((0.0, 0.0, 0.0, 0.077), (0.0, 0.0, 0.0, 0.031), 230)
        pose = jnp.stack([0.004, 0.0, jnp.radians(angle)])
        return jnp.degrees(pj.rollout(small, jaw, path, pose=pose, friction=0.2).pose[-1, 2])

    count = 60 if quick else 2000
    return [
        (
            "one finger",
            "friction",
            lambda mu: push(jnp.array([-0.052, 0.005]), 0.05 * unit, mu),
            np.linspace(0, 0.8, count),
        ),
        (
            "one finger, friction 0.25",
            "start, mm from the middle",
            lambda y: push(jnp.stack([-0.052, 1e-3 * y]), 0.05 * unit, 0.25),
            np.linspace(-60, 60, count),
        ),
        ("a jaw closes, friction 0.2", "start angle, deg", closed, np.linspace(0, 90, 60 if quick else 400)),
    ]


def draw(quick: bool, to: Path) -> list[Row]:
    """Draw the final angle and its derivative along each of `lines`, and save the figure to the path `to`."""
    import matplotlib.pyplot as plt

    from pushjax import plot
    from pushjax.plot.style import BLACK, GRAY, ORANGE, STYLE, legend_below

    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 3, figsize=(11, 4.8), sharex="col", layout="constrained")
        for (title, axis, angle, at), (above, below) in zip(lines(quick), axes.T, strict=True):
            both = jax.jit(jax.vmap(lambda x, angle=angle: jax.jvp(angle, (x,), (jnp.ones_like(x),))))
            value, slope = both(jnp.asarray(at))
            central = np.gradient(np.asarray(value), at)
            above.plot(at, value, ".", color=BLACK, markersize=1.5)
            below.plot(at, central, ".", color=GRAY, markersize=4, label="difference of neighbors")
            below.plot(at, slope, ".", color=ORANGE, markersize=1.5, label="jax.jvp")
            low, high = np.quantile(slope, [0.005, 0.995])
            below.set_ylim(low - 0.2 * (high - low), high + 0.2 * (high - low))
            above.set_title(title)
            below.set_xlabel(axis)
        axes[0, 0].set_ylabel("final angle, deg")
        axes[1, 0].set_ylabel("its derivative")
        legend_below(figure, axes[1, 0], columns=2)
        return [{"picture": plot.save(figure, to)}]


# --- the record ---


def run(
    parts: Annotated[tuple[Part, ...], tyro.conf.Positional] = get_args(Part),
    quick: bool = False,
    picture: Path = Path("derivatives.png"),
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Measure cost and agreement of derivatives, in float32 the cost and the memory, and in float64 the rest.

    Args:
        parts: Which parts.
        quick: Small batches: does it run.
        picture: File of the picture.
        progress: Called with the number of parts done and their total.
        keep: Called with the record so far.

    Returns:
        The record, with the rows of each part by its name.
    """
    jax.config.update("jax_enable_compilation_cache", False)  # compile times are measured
    made: dict[str, Callable[[bool], list[Row]]] = {"cost": cost, "memory": memory, "agreement": agreement}
    made |= {"grasps": grasping, "random": random, "picture": lambda quick: draw(quick, picture)}
    chosen = [part for part in made if part in parts]
    rows: dict[str, list[Row]] = {}
    record = result_record("derivatives", {"quick": quick, "parts": chosen})
    for part in chosen:
        jax.config.update("jax_enable_x64", part not in ("cost", "memory"))
        rows[part] = made[part](quick)
        keep(record | rows)
        progress(len(rows), len(chosen))
    return record | rows


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = []
    for part in record["settings"]["parts"]:
        lines.append(f"{part}, {'float64' if part not in ('cost', 'memory') else 'float32'}")
        lines += [f"  {_line(part, row)}" for row in record[part]]
    return "\n".join(lines)


def _line(part: str, row: Row) -> str:
    """Return the text of one row."""
    if part in ("cost", "memory"):
        each = row["batch"] * row["steps"]
        bytes_each = f"{row['bytes'] / each:.1f} bytes per push and step"
        if part == "memory":
            return (
                f"gradient, {row['way']:46}: {row['bytes'] / 1e6:7.1f} MB, {bytes_each}, {1e3 * row['run_s']:8.1f} ms"
            )
        return (
            f"{row['fingers']} finger(s), {row['what']:8}: compile {row['compile_s']:5.1f} s, run "
            f"{1e3 * row['run_s']:8.1f} ms, {1e9 * row['run_s'] / each:.0f} ns and {bytes_each}, {row['ratio']:.2f} x "
            "the push"
        )
    if part in ("agreement", "grasps"):
        errors = ", ".join(f"{name} {row[name]:.1e}" for name in ("q50", "q99", "q99.9", "largest"))
        return (
            f"{row['case']}: {row['pushes']} pushes x {row['directions']} directions; {row['finite']} with all "
            f"derivatives finite; {row['held']} end held, {row['failed']} with failed steps; {row['left_out']} pairs "
            f"left out\n     {errors}; {row['above']} above {TOLERANCE:g}, {row['above_fine']} by finer differences "
            f"({row['largest_fine']:.1e})"
        )
    if part == "random":
        figures = zip(row["derivative"], row["difference"], row["standard_error"], strict=True)
        text = "; ".join(f"{a:.3e} / {b:.3e} ± {e:.0e}" for a, b, e in figures)
        return f"{row['sampler']}, dof {row['dof']:g}, by {row['by']:10}: {text}"
    return f"drew {row['picture']}"
