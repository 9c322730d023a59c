"""Time and success of the solvers of one to eight contacts.

    python -m benchmarks several_contacts [--problems 2000] [--degree 4] [--x64] [--most 8]

`Exhaustive`, `Projected` and, for a single contact, `ScalarRoot` solve the random problems of
`pushjax.testing.problems`. Prints the time per problem, its ratio to that of one contact by `ScalarRoot`, the fraction
of the problems with a motion for which each solver finds one, and the time to trace and compile.
"""

import argparse

import jax

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--problems", type=int, default=2000)
parser.add_argument("--degree", type=int, default=4, choices=(2, 4))
parser.add_argument("--x64", action="store_true")
parser.add_argument("--most", type=int, default=8)
arguments = parser.parse_args()
if arguments.x64:
    jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import pushjax as pj  # noqa: E402
from benchmarks._measure import alternate, compiled, header  # noqa: E402
from pushjax.testing.problems import random_contacts_problem  # noqa: E402


def main() -> None:
    count = arguments.problems
    print(header())
    programs, compile_s, problems = {}, {}, {}
    for m in range(1, arguments.most + 1):
        keys = jax.random.split(jax.random.key(m), count)

        def draw(key, m=m):
            return random_contacts_problem(key, contacts=m, degree=arguments.degree)

        problems[m] = jax.jit(jax.vmap(draw))(keys)
        solvers = {"Exhaustive": pj.Exhaustive(), "Projected": pj.Projected()}
        single = {"ScalarRoot": pj.ScalarRoot()} if m == 1 else {}
        for name, solver in (single | solvers).items():

            def solve(problem, solver=solver):
                return pj.solve_contacts(problem.surface, problem.contacts, solver=solver)

            program, seconds = compiled(jax.vmap(solve), problems[m])
            programs[f"{m} {name}"], compile_s[f"{m} {name}"] = (program, (problems[m],)), seconds
    run_s = alternate(programs, repeats=11)
    print(f"degree {arguments.degree}, {count} problems each, {problems[1].contacts.point.dtype}:")
    print("contacts solver        us each    x one    found   compile s")
    for name, seconds in run_s.items():
        m, solver = name.split()
        status = np.asarray(programs[name][0](problems[int(m)]).status)
        exact = np.asarray(programs[f"{m} Exhaustive"][0](problems[int(m)]).status)
        found = np.mean(status[exact == pj.Status.MOVING] == pj.Status.MOVING)
        times = seconds / run_s["1 ScalarRoot"]
        print(f"{m:8} {solver:12} {1e6 * seconds / count:9.3f} {times:8.1f} {found:8.2%} {compile_s[name]:11.1f}")


if __name__ == "__main__":
    main()
