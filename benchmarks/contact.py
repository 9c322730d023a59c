"""Time and agreement of the two solvers of a single contact.

    python -m benchmarks contact [--problems 100000] [--x64]

`ScalarRoot` and `HessianIteration` solve the random problems of `pushjax.testing.problems`. Prints the time per
problem, the iterations of `HessianIteration`, and the number of problems in which the two differ in the mode.
"""

import argparse

import jax

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--problems", type=int, default=100_000)
parser.add_argument("--x64", action="store_true")
arguments = parser.parse_args()
if arguments.x64:
    jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import pushjax as pj  # noqa: E402
from benchmarks._measure import alternate, compiled, header  # noqa: E402
from pushjax._math.vec import Vec2  # noqa: E402
from pushjax.contact.contact_plane import Contact, LimitCurve  # noqa: E402
from pushjax.contact.single import solve_single  # noqa: E402
from pushjax.testing.problems import ContactProblem, random_contact_problem  # noqa: E402


def contact_of(problem: ContactProblem) -> Contact:
    """Return the contact of `problem`, without a gap, as the solvers of one contact take it."""
    point, normal, displacement = (Vec2.of(v) for v in (problem.point, problem.normal, problem.displacement))
    return Contact(point, normal, displacement, problem.friction, jnp.zeros_like(problem.friction))


def main() -> None:
    count = arguments.problems
    print(header())
    for degree in (2, 4):
        keys = jax.random.split(jax.random.key(degree), count)
        problems = jax.jit(jax.vmap(lambda key, d=degree: random_contact_problem(key, degree=d)))(keys)
        programs, compile_s = {}, {}
        for solver in (pj.ScalarRoot(), pj.HessianIteration()):
            name = type(solver).__name__

            def solve(problem, solver=solver):
                return solve_single(problem.surface.form(), contact_of(problem), solver)

            program, compile_s[name] = compiled(jax.vmap(solve), problems)
            programs[name] = (program, (problems,))
        run_s = alternate(programs, repeats=3)
        root, hessian = (programs[name][0](problems) for name in programs)

        def trace(problem):
            contact = contact_of(problem)
            return pj.HessianIteration().trace(LimitCurve.of(problem.surface.form(), contact), contact.approach())[1]

        rounds = np.asarray(jax.jit(jax.vmap(trace))(problems))
        print(f"degree {degree}, {count} problems, {problems.point.dtype}:")
        for name, seconds in run_s.items():
            print(f"  {name:17} {1e9 * seconds / count:8.1f} ns per problem   compile {compile_s[name]:.1f} s")
        tail = np.quantile(rounds, 0.99)
        print(f"  HessianIteration rounds: median {np.median(rounds):.0f}, 99 % {tail:.0f}, worst {rounds.max()}")
        modes = np.sum(np.asarray(root.mode) != np.asarray(hessian.mode))
        unsolved = [int(np.sum(np.asarray(m.status) == pj.Status.NOT_CONVERGED)) for m in (root, hessian)]
        print(f"  modes that differ: {modes}; not converged: {unsolved[0]} and {unsolved[1]}")


if __name__ == "__main__":
    main()
