"""Difference between float32 and float64: distances of the final poses, and contact modes that differ."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import reference_push
from benchmarks.timing import both_dtypes
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record

PUSHES, CHUNK = 100_000, 5000
MODELS = ("quartic", "ellipsoid")
STEPS = (8, 50, 200)
LEVELS = (0.5, 0.99, 1.0)


def run(scale: float = 1.0, seed: int = 0, progress: ProgressCallback = no_progress) -> dict[str, Any]:
    """Compute the same random pushes in float32 and in float64.

    Start, direction and friction of each push are random. There are 100 000 pushes (times `scale`) for each limit
    surface and number of steps.

    Args:
        scale: Factor of the number of pushes, 100 000.
        seed: Seed of the pushes.
        progress: Called after every row with the number of rows done and their total.

    Returns:
        The record, with one row for each limit surface and number of steps: quantiles of the distance between the two
        final poses (mm; angles times the surface's length), the fraction of steps whose mode differs, the number of
        steps that failed, and whether the same call gives the same bits again.

    Raises:
        ValueError: If `scale` leaves no push.
    """
    pushes = round(scale * PUSHES)
    if pushes < 1:
        raise ValueError(f"scale must leave one push of {PUSHES} at least; got {scale}")
    todo = [(model, steps) for model in MODELS for steps in STEPS]
    rows = []
    with both_dtypes():
        for done, (model, steps) in enumerate(todo):
            rows.append(_row(model, steps, pushes, seed))
            progress(done + 1, len(todo))
    return result_record("numerics", {"pushes": pushes, "seed": seed}, rows=rows)


def _row(model: str, steps: int, pushes: int, seed: int) -> dict[str, Any]:
    apart, flips, failed, same = [], 0, 0, True
    length = float(reference_push.square(model).surface.length)
    kinds = {dtype: reference_push.task(model, dtype) for dtype in ("float32", "float64")}
    for chunk in range(-(-pushes // CHUNK)):
        rng = np.random.default_rng((seed, steps, chunk))
        offset = rng.uniform(-reference_push.MAX_OFFSET, reference_push.MAX_OFFSET, CHUNK).astype(np.float32)
        angle = rng.uniform(-reference_push.MAX_ANGLE, reference_push.MAX_ANGLE, CHUNK).astype(np.float32)
        friction = rng.uniform(0.15, 0.35, CHUNK).astype(np.float32)
        # The paths and frictions in float64 are exactly those in float32, so that only the arithmetic differs.
        path = reference_push.paths(jnp.asarray(offset), jnp.asarray(angle), steps)
        found = {d: _pushed(here, path.astype(d), jnp.asarray(friction, d)) for d, here in kinds.items()}
        one, two = (tuple(np.asarray(part) for part in found[d]) for d in ("float32", "float64"))
        here = min(CHUNK, pushes - chunk * CHUNK)
        apart.append(reference_push.error_mm(one[0].astype(float), two[0], length)[:here])
        flips += int((one[1] != two[1])[:here].sum())
        failed += int(one[2][:here].sum() + two[2][:here].sum())
        for dtype, before in (("float32", one), ("float64", two)):
            again = _pushed(kinds[dtype], path.astype(dtype), jnp.asarray(friction, dtype))
            same &= all(np.array_equal(a, b) for a, b in zip(before, map(np.asarray, again), strict=True))
    quantiles = np.quantile(np.concatenate(apart), LEVELS)
    return {
        "model": model,
        "steps": steps,
        "pushes": pushes,
        "median_mm": float(quantiles[0]),
        "p99_mm": float(quantiles[1]),
        "worst_mm": float(quantiles[2]),
        "mode_flips": flips / (pushes * steps),
        "failed_steps": failed,
        "same_bits_again": same,
    }


@jax.jit
def _pushed(here: reference_push.Task, path: jax.Array, friction: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    def one(path, friction):
        push = here.push(path, friction)
        return push.pose[-1], push.mode[:, 0], jnp.sum(push.failed)

    return jax.vmap(one)(path, friction)


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    lines = [
        f"float32 beside float64, {record['settings']['pushes']} pushes of 50 mm:",
        f"{'surface':11}{'steps':>6}{'median':>13}{'99 %':>13}{'worst':>13}{'mode flips':>12}{'failed':>8}  same bits",
    ]
    for row in record["rows"]:
        lines.append(
            f"{row['model']:11}{row['steps']:6}{row['median_mm']:10.1e} mm{row['p99_mm']:10.1e} mm"
            f"{row['worst_mm']:10.1e} mm{row['mode_flips']:12.1e}{row['failed_steps']:8}  {row['same_bits_again']}"
        )
    return "\n".join(lines)
