"""Convexity, mean and repairs of a million random surfaces of each sampler.

    python -m benchmarks friction [--n 1000000] [--certificates 200] [--x64]

Convexity is judged in float64 by a sweep of the Hessian that does not use the sampler's certificate. For a few surfaces
a semi-definite program also searches for a Gram matrix that proves it (needs cvxpy).
"""

import argparse
import time
from typing import Any

import jax

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--n", type=int, default=1_000_000)
parser.add_argument("--certificates", type=int, default=200)
parser.add_argument("--x64", action="store_true")
arguments = parser.parse_args()
if arguments.x64:
    jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

import pushjax as pj  # noqa: E402
from benchmarks._measure import header  # noqa: E402
from pushjax.friction.quartic import MONOMIALS  # noqa: E402
from pushjax.testing.convexity import least_curvatures  # noqa: E402

CHUNK = 50_000
DOFS = (10, 20, 50, 250)
# Least curvature of a surface that counts as convex, relative to its largest coefficient. It is below zero by roundoff.
CONVEX = -1e-8 if arguments.x64 else -3e-7


@jax.jit
def drawn(around, keys):
    """Return the coefficients and the shrinkage of one sample for each key."""
    sample = jax.vmap(around.sample)(keys)
    return sample.surface.coefficients, sample.shrinkage


def draw(model: pj.FrictionModel, surface: pj.LimitSurface, n: int):
    """Draw random surfaces in chunks.

    Args:
        model: Distribution of the friction.
        surface: Mean of the surfaces.
        n: Number of samples.

    Returns:
        The coefficients, (n, 15), and the shrinkage, (n,), in float64, and the time that sampling took without
        compiling, in s.
    """
    around = model.around(surface)
    keys = jax.random.split(jax.random.key(1), n)
    jax.block_until_ready(drawn(around, keys[:CHUNK]))
    begun, parts = time.perf_counter(), []
    for first in range(0, n, CHUNK):
        parts.append([np.asarray(x, np.float64) for x in drawn(around, keys[first : first + CHUNK])])
    seconds = time.perf_counter() - begun
    return *(np.concatenate(part) for part in zip(*parts, strict=True)), seconds


def certified(coefficients: np.ndarray) -> int:
    """Count the quartics for which a semi-definite program proves that they are convex.

    The proof is a Gram matrix of z' hess H(F) z that is positive semi-definite to 1e-6.

    Args:
        coefficients: Coefficients, (n, 15).
    """
    import cvxpy as cp

    rng = np.random.default_rng(0)
    found = 0
    f, z = rng.normal(size=(2, 120, 3))
    y = np.einsum("ni,nj->nij", z, f).reshape(120, 9)
    q, slack = cp.Variable((9, 9), symmetric=True), cp.Variable()
    value = cp.Parameter(120)
    forms = cp.hstack([cp.sum(cp.multiply(np.outer(row, row), q)) for row in y])
    problem = cp.Problem(cp.Maximize(slack), [forms == value, q >> slack * np.eye(9)])
    for c in coefficients:
        c = c / np.abs(c).max()
        value.value = np.array([_bent(c, a, b) for a, b in zip(f, z, strict=True)])
        problem.solve(solver=cp.CLARABEL)
        found += slack.value is not None and float(slack.value) > -1e-6
    return found


def _bent(c: np.ndarray, f: np.ndarray, z: np.ndarray) -> float:
    """Return z' hess H(F) z as the second derivative of the polynomial H(F + t z), which is exact."""
    t = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    values = np.prod((f + t[:, None] * z)[:, None] ** MONOMIALS, axis=2) @ c
    return float(2 * np.polyfit(t, values, 4)[2])


def main() -> None:
    print(header())
    block = pj.Polygon.rectangle(0.09, 0.09)
    surface = pj.fit_limit_surface(*pj.Support.uniform(block, points=64).wrench_twist_pairs(jax.random.key(0), 400))
    assert isinstance(surface, pj.Quartic)
    mean = np.asarray(surface.coefficients, np.float64)
    n = arguments.n
    print(f"quartic of a square on 64 points, {surface.coefficients.dtype}, {n} samples each")
    rays = np.random.default_rng(0).normal(size=(1000, 3))
    products = np.prod(rays[:, None] ** MONOMIALS, axis=2)
    for sampler in ("gram", "sum_of_squares"):
        for dof in DOFS:
            count = n if dof == 20 else max(n // 10, CHUNK)
            c, pull, seconds = draw(pj.FrictionModel(dof=dof, friction=0.3, sampler=sampler), surface, count)
            raw = (c - pull[:, None] * mean) / (1 - pull[:, None])
            error = raw.std(axis=0) / np.sqrt(count)
            off = np.abs(raw.mean(axis=0) - mean) / error
            shift = (c.mean(axis=0) - mean) / np.abs(mean).max()
            values = raw[:100_000] @ products.T
            spread = np.mean(values.var(axis=0) / values.mean(axis=0) ** 2) * dof / 2
            begun = time.perf_counter()
            curvature = least_curvatures(c)
            print(
                f"{sampler:14} dof {dof:3}: {count:8} samples, {1e6 * seconds / count:5.1f} us each; "
                f"{np.sum(~(curvature >= CONVEX))} not convex (least curvature {curvature.min():.1e}, "
                f"{time.perf_counter() - begun:.0f} s of sweep); repaired {np.mean(pull > 0):.2%}, mean shrinkage "
                f"{pull[pull > 0].mean() if (pull > 0).any() else 0:.3f}; mean off {off.max():.1f} standard errors at "
                f"worst before repair, {np.abs(shift).max():.2e} of the largest coefficient after; relative variance "
                f"of H {spread:.3f} of 2 / dof",
                flush=True,
            )
            if dof == 20 and arguments.certificates:
                few = np.concatenate([c[pull > 0][: arguments.certificates // 2], c[pull == 0]])
                few = few[: arguments.certificates]
                print(f"       a semi-definite program certifies {certified(few)} of {len(few)}", flush=True)
    a = np.array([[1.0, 0.2, -0.1], [0.2, 1.5, 0.3], [-0.1, 0.3, 0.8]])
    around = pj.FrictionModel(dof=20.0, friction=0.3).around(pj.Ellipsoid(a, 0.03))
    ellipsoids: Any = jax.jit(jax.vmap(around.sample))(jax.random.split(jax.random.key(2), n)).surface
    drawn_a = np.asarray(ellipsoids.A, np.float64)
    variance = (a**2 + np.outer(np.diag(a), np.diag(a))) / 20
    off = np.abs(drawn_a.mean(axis=0) - a) / np.sqrt(variance / n)
    ratio = drawn_a.var(axis=0) / variance
    print(
        f"ellipsoid dof 20: mean off {off.max():.1f} standard errors at worst, variances {ratio.min():.4f} to "
        f"{ratio.max():.4f} of the formula's"
    )


if __name__ == "__main__":
    main()
