"""Fits: one against two hundred in one `vmap`, and against the semi-definite program (cvxpy) on the same pairs.

    python benchmarks/fit.py

One fit is timed as a user calls it (checks and convexity test included) and as a compiled program alone.
"""

import sys
import time
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from _measure import alternate, compiled, header  # noqa: E402

import pushjax as pj  # noqa: E402

FITS, PAIRS = 200, 400


def main() -> None:
    support = pj.Support.uniform(pj.Polygon.rectangle(0.09, 0.09))
    keys = jax.random.split(jax.random.key(0), FITS)
    batch = jax.vmap(lambda key: support.wrench_twist_pairs(key, PAIRS))(keys)
    single = tuple(part[0] for part in batch)

    def fit(wrench, twist, length):
        surface, report = pj.fit_limit_surface(wrench, twist, length, report=True)
        return surface, report

    one, one_s = compiled(fit, *single)
    many, many_s = compiled(jax.vmap(fit), *batch)
    run = alternate({"one": (one, single), "many": (many, batch), "call": (fit, single)})
    print(header())
    print(f"quartic, {PAIRS} pairs, float64")
    print(f"  one fit, as called:     {1e3 * run['call']:8.2f} ms")
    print(f"  one fit, compiled:      {1e3 * run['one']:8.2f} ms   (compile {one_s:.1f} s)")
    print(f"  {FITS} fits in one vmap:  {1e3 * run['many']:8.2f} ms   (compile {many_s:.1f} s)")
    ratios = run["many"] / run["call"], run["many"] / run["one"]
    print(f"  {FITS} fits cost {ratios[0]:.1f} fits as called, {ratios[1]:.1f} compiled ones")

    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from test_fit import semidefinite_loss  # pyright: ignore[reportMissingImports]

    arrays = [np.asarray(part) for part in single]
    semidefinite_loss(*arrays)
    begin = time.perf_counter()
    best = semidefinite_loss(*arrays)
    seconds = time.perf_counter() - begin
    loss = float(one(*single)[1].loss)
    print(
        f"  semi-definite program:  {1e3 * seconds:8.2f} ms, loss {best:.6f}; ours {loss:.6f} ({loss / best:.6f} of it)"
    )


if __name__ == "__main__":
    main()
