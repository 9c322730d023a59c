"""How often the confidence intervals of `identify` contain a known truth.

A 90 mm square is pushed 30 mm, in 30 steps, by a finger of 5 mm radius that starts anywhere on a side and moves up to
34 degrees from its normal. Each repetition has its own truth. The limit surface (50 degrees of freedom, around that of
uniform pressure), the center of pressure (standard deviation 3 mm) and the inset of the outline (1 mm) are drawn from
the prior of the identification, and the friction uniformly from 0.1 to 0.5. The final poses are measured with noise.
All repetitions are one batch.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.experiments._record import result_record
from pushjax.identification.model import Scene, predict_pushes
from pushjax.identification.prior import Prior

HALF, RADIUS, TRAVEL, STEPS = 0.045, 0.005, 0.03, 30
UNKNOWNS = pj.Unknowns((0.0, 1.0), surface_dof=50, pressure_center=0.003, inset=0.001)


def random_pushes(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Draw start poses (*shape, 3) and paths of the finger (*shape, STEPS + 1, 2), in float32."""
    pose = np.concatenate([rng.uniform(-0.1, 0.1, (*shape, 2)), rng.uniform(-3, 3, (*shape, 1))], axis=-1)
    side = pose[..., 2] + rng.integers(4, size=shape) * np.pi / 2
    along = side + rng.uniform(-0.6, 0.6, shape)
    place = np.stack([np.full(shape, -HALF - RADIUS - 0.001), rng.uniform(-0.8, 0.8, shape) * HALF], axis=-1)
    cos, sin = np.cos(side), np.sin(side)
    begin = pose[..., :2] + np.stack(
        [cos * place[..., 0] - sin * place[..., 1], sin * place[..., 0] + cos * place[..., 1]], axis=-1
    )
    way = np.linspace(0, TRAVEL, STEPS + 1)[:, None] * np.stack([np.cos(along), np.sin(along)], axis=-1)[..., None, :]
    return jnp.asarray(pose, jnp.float32), jnp.asarray(begin[..., None, :] + way, jnp.float32)


def run(pushes: int = 50, repetitions: int = 200, noise: float = 0.5) -> dict[str, Any]:
    """Identify objects whose truth is known.

    Args:
        pushes: Number of pushes of each object.
        repetitions: Number of objects.
        noise: Standard deviation of x, y and length * theta of the final poses, mm. 0: exact poses.

    Returns:
        The record, with one row for each level of the intervals: by the name of each unknown, the fraction of its
        intervals that contain the truth. It also has the times, the median of sigma, and the number of objects that did
        not converge.
    """
    rng = np.random.default_rng(1)
    square, hand = pj.Polygon.rectangle(2 * HALF, 2 * HALF), pj.Hand.finger(RADIUS)
    mean = pj.fit_limit_surface(*pj.Support.uniform(square).wrench_twist_pairs(jax.random.key(0), 400))
    surfaces = jax.tree.map(lambda leaf: leaf[None], mean)
    prior = Prior.of(UNKNOWNS, surfaces, {"friction": jnp.asarray([0.25])}, jnp.zeros(2))
    layout, count = prior.layout, repetitions
    starts, paths = random_pushes(rng, (count, pushes))
    truth, mu = rng.normal(size=(count, layout.size)), rng.uniform(0.1, 0.5, count)
    position = int(layout.positions[0, layout.slices["friction"]][0])
    truth[:, position] = np.log(mu / (1 - mu))
    truth = jnp.asarray(truth, jnp.float32)

    @jax.jit
    @jax.vmap
    def ends(z, start, path):
        given = pj.Pushes(start[None], path[None], start[None])
        return predict_pushes(prior.parameters(z), surfaces, Scene(square, hand, prior.origin), given).pose[0, :, -1]

    added = 1e-3 * noise * rng.normal(size=starts.shape) / [1, 1, float(mean.length)]
    measured = ends(truth, starts, paths) + jnp.asarray(added, jnp.float32)

    @jax.jit
    @jax.vmap
    def identified(start, path, end):
        return pj.identify(pj.Pushes(start, path, end), pj.Slider(square, mean), hand, UNKNOWNS, robust=None)

    begin = time.perf_counter()
    compiled = identified.lower(starts, paths, measured).compile()
    middle = time.perf_counter()
    found = jax.block_until_ready(compiled(starts, paths, measured))
    took = time.perf_counter() - middle
    deviation = np.sqrt(np.diagonal(np.linalg.inv(np.asarray(found.precision, float)), axis1=1, axis2=2))
    error = np.abs(np.asarray(found.z) - np.asarray(truth)) / deviation
    rows = []
    for level, quantile in ((0.5, 0.6745), (0.9, 1.6449)):
        inside = (error < quantile).mean(axis=0)
        parts = {name: inside[layout.positions[0, layout.slices[name]]].mean() for name in layout.names}
        rows.append({"level": level} | parts)
    return result_record(
        "identification",
        {"pushes": pushes, "repetitions": repetitions, "noise_mm": noise},
        rows=rows,
        compile_s=middle - begin,
        run_s=took,
        not_converged=int(np.sum(~np.asarray(found.converged))),
        sigma_mm=1e3 * np.median(found.sigma),
    )


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    settings = record["settings"]
    lines = [
        f"{settings['repetitions']} x {settings['pushes']} pushes: compiled in {record['compile_s']:.0f} s, run in "
        f"{record['run_s']:.0f} s",
        f"not converged: {record['not_converged']}; sigma {record['sigma_mm']:.3f} mm",
    ]
    for row in record["rows"]:
        parts = ", ".join(f"{name} {100 * share:.1f} %" for name, share in row.items() if name != "level")
        lines.append(f"intervals of {100 * row['level']:.0f} % hold: {parts}")
    return "\n".join(lines)
