"""Time and success of the solvers of one to eight contacts, side by side.

`Exhaustive`, `Projected` and, for a single contact, `ScalarRoot` and `HessianIteration` solve the random problems of
`pushjax.testing.problems`. Each row has the time per problem, its ratio to that of one contact by `ScalarRoot`, the
fraction of the problems with a motion for which the solver finds one, and the time to trace and compile.
"""

from typing import Any, Literal

import jax
import numpy as np

import pushjax as pj
from benchmarks.timing import alternate, compiled
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.testing.problems import random_contacts_problem

SEVERAL = {"Exhaustive": pj.Exhaustive(), "Projected": pj.Projected()}
ONE = {"ScalarRoot": pj.ScalarRoot(), "HessianIteration": pj.HessianIteration()}
REPEATS = 11


def run(
    problems: int = 2000,
    degree: Literal[2, 4] = 4,
    x64: bool = False,
    most: int = 8,
    progress: ProgressCallback = no_progress,
) -> dict[str, Any]:
    """Solve random problems with every solver.

    Args:
        problems: Number of problems for each number of contacts.
        degree: Degree of the limit surface: 2 for an ellipsoid, 4 for a quartic.
        x64: Whether to compute in float64.
        most: Largest number of contacts.
        progress: Called with the number of programs compiled and their total.

    Returns:
        The record, with one row for each number of contacts and solver.
    """
    jax.config.update("jax_enable_x64", x64)
    todo = [
        (m, name, solver) for m in range(1, most + 1) for name, solver in ((ONE if m == 1 else {}) | SEVERAL).items()
    ]
    drawn, programs = {}, {}
    for m, name, solver in todo:
        if m not in drawn:
            keys = jax.random.split(jax.random.key(m), problems)
            draw = jax.vmap(lambda key, m=m: random_contacts_problem(key, contacts=m, degree=degree))
            drawn[m] = jax.jit(draw)(keys)

        def solve(problem, solver=solver):
            return pj.solve_contacts(problem.surface, problem.contacts, solver=solver)

        programs[m, name] = compiled(jax.vmap(solve), drawn[m])
        progress(len(programs), len(todo))
    timings = alternate({f"{m} {name}": each.run for (m, name), each in programs.items()}, REPEATS)
    rows = []
    for (m, name), program in programs.items():
        status, exact = (np.asarray(each.run().status) for each in (program, programs[m, "Exhaustive"]))
        seconds = timings[f"{m} {name}"].median
        row = {"contacts": m, "solver": name, "us_per_problem": 1e6 * seconds / problems}
        row |= {"ratio_to_one": seconds / timings["1 ScalarRoot"].median, "compile_s": program.compile_s}
        rows.append(row | {"found": np.mean(status[exact == pj.Status.MOVING] == pj.Status.MOVING)})
    settings = {"problems": problems, "degree": degree, "dtype": str(drawn[1].contacts.point.dtype)}
    return result_record("solvers", settings, rows=rows)


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    settings = record["settings"]
    lines = [f"degree {settings['degree']}, {settings['problems']} problems each, {settings['dtype']}:"]
    lines.append("contacts solver                us each    x one    found   compile s")
    for row in record["rows"]:
        lines.append(
            f"{row['contacts']:8} {row['solver']:18} {row['us_per_problem']:9.3f} {row['ratio_to_one']:8.1f} "
            f"{row['found']:8.2%} {row['compile_s']:11.1f}"
        )
    return "\n".join(lines)
