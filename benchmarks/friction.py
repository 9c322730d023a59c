"""Convexity, mean and repairs of a million random surfaces of each sampler.

Convexity is checked in float64 by a sweep of the Hessian that does not use the sampler's certificate.
"""

import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.friction.quartic import MONOMIALS
from pushjax.testing.convexity import least_curvatures

CHUNK = 50_000
DOFS = (10, 20, 50, 250)
# Least curvature of a surface that counts as convex, relative to its largest coefficient. It is below zero by roundoff.
CONVEX = {"float64": -1e-8, "float32": -3e-7}
SAMPLERS = ("gram", "sum_of_squares")


@jax.jit
def drawn(around, keys):
    """Return the coefficients and the shrinkage of one sample for each key."""
    sample = jax.vmap(around.sample)(keys)
    return sample.surface.coefficients, sample.shrinkage


def draw(model: pj.FrictionModel, surface: pj.LimitSurface, n: int):
    """Draw `n` surfaces in chunks; return coefficients (n, 15) and shrinkage (n,) in float64, and the time, s."""
    around = model.around(surface)
    keys = jax.random.split(jax.random.key(1), n)
    jax.block_until_ready(drawn(around, keys[:CHUNK]))  # compiles
    begun, parts = time.perf_counter(), []
    for first in range(0, n, CHUNK):
        parts.append([np.asarray(x, np.float64) for x in drawn(around, keys[first : first + CHUNK])])
    seconds = time.perf_counter() - begun
    return *(np.concatenate(part) for part in zip(*parts, strict=True)), seconds


def run(
    n: int = 1_000_000,
    x64: bool = False,
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Draw random surfaces around the quartic of a square on 64 points.

    Args:
        n: Number of samples with 20 degrees of freedom; a tenth of it, but at least CHUNK, with others.
        x64: Whether to compute in float64.
        progress: Called with the number of rows done and their total.
        keep: Called with the record so far.

    Returns:
        The record, with the row of `_quartics` for each sampler and number of degrees of freedom.
    """
    jax.config.update("jax_enable_x64", x64)
    block = pj.Polygon.rectangle(0.09, 0.09)
    surface = pj.fit_limit_surface(*pj.Support.uniform(block, points=64).wrench_twist_pairs(jax.random.key(0), 400))
    assert isinstance(surface, pj.Quartic)
    rows: list[dict[str, Any]] = []
    record = result_record("friction", {"n": n, "dtype": str(surface.coefficients.dtype)}, rows=rows)
    todo = [(sampler, dof) for sampler in SAMPLERS for dof in DOFS]
    for sampler, dof in todo:
        rows.append(_quartics(surface, sampler, dof, n if dof == 20 else max(n // 10, CHUNK)))
        keep(record)
        progress(len(rows), len(todo))
    return record


def _quartics(surface: pj.Quartic, sampler: Any, dof: int, count: int) -> dict[str, Any]:
    """Draw `count` quartics around `surface`; return the row with their convexity and moments."""
    mean = np.asarray(surface.coefficients, np.float64)
    c, pull, seconds = draw(pj.FrictionModel(dof=dof, friction=0.3, sampler=sampler), surface, count)
    raw = (c - pull[:, None] * mean) / (1 - pull[:, None])
    off = np.abs(raw.mean(axis=0) - mean) / (raw.std(axis=0) / np.sqrt(count))
    shift = (c.mean(axis=0) - mean) / np.abs(mean).max()
    rays = np.random.default_rng(0).normal(size=(1000, 3))
    values = raw[:100_000] @ np.prod(rays[:, None] ** MONOMIALS, axis=2).T
    begun = time.perf_counter()
    curvature = least_curvatures(c)
    swept = time.perf_counter() - begun
    return {
        "sampler": sampler,
        "dof": dof,
        "samples": count,
        "us_per_sample": 1e6 * seconds / count,
        "not_convex": int(np.sum(~(curvature >= CONVEX[str(surface.coefficients.dtype)]))),
        "least_curvature": curvature.min(),
        "sweep_s": swept,
        "repaired": np.mean(pull > 0),
        "shrinkage": pull[pull > 0].mean() if (pull > 0).any() else 0.0,
        "mean_off": off.max(),  # of a mean coefficient before repairs, in standard errors
        "mean_shift": np.abs(shift).max(),  # after repairs, relative to the largest coefficient
        # relative variance of H, in units of 2 / dof
        "variance": np.mean(values.var(axis=0) / values.mean(axis=0) ** 2) * dof / 2,
    }


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [f"quartic of a square on 64 points, {record['settings']['dtype']}"]
    for row in record["rows"]:
        lines.append(
            f"{row['sampler']:14} dof {row['dof']:3}: {row['samples']:8} samples, {row['us_per_sample']:5.1f} us each; "
            f"{row['not_convex']} not convex (least curvature {row['least_curvature']:.1e}, {row['sweep_s']:.0f} s of "
            f"sweep); repaired {row['repaired']:.2%}, mean shrinkage {row['shrinkage']:.3f}; mean off "
            f"{row['mean_off']:.1f} standard errors at worst before repair, {row['mean_shift']:.2e} of the largest "
            f"coefficient after; relative variance of H {row['variance']:.3f} of 2 / dof"
        )
    return "\n".join(lines)
