"""What identification finds when the truth is known: from pushes without noise, and how often its intervals hold it.

    python benchmarks/identification.py [--pushes 50] [--repetitions 200] [--noise 0.5]

A 90 mm square, pushed 30 mm by a 5 mm finger anywhere on its sides, up to 34 degrees from their normals, in 30 steps.
Of every repetition friction (0.1 to 0.5), limit surface (dof 50 about uniform pressure), centre of pressure (3 mm) and
inset of the outline (1 mm) are drawn anew, from what identification is told beforehand; final poses are measured with
noise. All repetitions are one batch.
"""

import argparse
import time

import jax
import jax.numpy as jnp
import numpy as np
from _measure import header

import pushjax as pj
from pushjax.identify.model import Body, trajectories
from pushjax.identify.unknowns import Prior

HALF, RADIUS, TRAVEL, STEPS = 0.045, 0.005, 0.03, 30
UNKNOWNS = pj.Unknowns((0.0, 1.0), dof=50, center=0.003, inset=0.001)


def planned(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[jax.Array, jax.Array]:
    """Starts (*shape, 3) and paths (*shape, STEPS + 1, 2)."""
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


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--pushes", type=int, default=50)
    parser.add_argument("--repetitions", type=int, default=200)
    parser.add_argument("--noise", type=float, default=0.5, help="mm, of x, y and length * theta each")
    arguments = parser.parse_args()
    print(header())
    rng = np.random.default_rng(1)
    square, hand = pj.Polygon.rectangle(2 * HALF, 2 * HALF), pj.Hand.finger(RADIUS)
    mean = pj.fit_limit_surface(*pj.Support.uniform(square).wrench_twist_pairs(jax.random.key(0), 400))
    several = jax.tree.map(lambda leaf: leaf[None], mean)
    prior = Prior.of(UNKNOWNS, several, jnp.asarray([0.25]), jnp.zeros(2))
    layout, count = prior.layout, arguments.repetitions
    starts, paths = planned(rng, (count, arguments.pushes))
    truth, mu = rng.normal(size=(count, layout.size)), rng.uniform(0.1, 0.5, count)
    own = int(layout.index[0, layout.local["friction"]][0])
    truth[:, own] = np.log(mu / (1 - mu))
    truth = jnp.asarray(truth, jnp.float32)

    @jax.jit
    @jax.vmap
    def ends(z, start, path):
        pushes = pj.Pushes(start[None], path[None], start[None])
        return trajectories(prior.physical(z), several, Body(square, hand, prior.origin), pushes).pose[0, :, -1]

    noise = 1e-3 * arguments.noise * rng.normal(size=starts.shape) / [1, 1, float(mean.length)]
    seen = ends(truth, starts, paths) + jnp.asarray(noise, jnp.float32)

    @jax.jit
    @jax.vmap
    def identified(start, path, end):
        return pj.identify(pj.Pushes(start, path, end), pj.Slider(square, mean), hand, UNKNOWNS, robust=None)

    begin = time.perf_counter()
    compiled = identified.lower(starts, paths, seen).compile()
    middle = time.perf_counter()
    found = jax.block_until_ready(compiled(starts, paths, seen))
    took = time.perf_counter() - middle
    print(f"{count} x {arguments.pushes} pushes: compiled in {middle - begin:.0f} s, run in {took:.0f} s")
    print(f"not converged: {int(np.sum(np.asarray(found.status) != 0))}; sigma {1e3 * np.median(found.sigma):.3f} mm")
    deviation = np.sqrt(np.diagonal(np.linalg.inv(np.asarray(found.precision, float)), axis1=1, axis2=2))
    off = np.abs(np.asarray(found.z) - np.asarray(truth)) / deviation
    for level, reach in ((0.5, 0.6745), (0.9, 1.6449)):
        held = (off < reach).mean(axis=0)
        parts = {name: held[layout.index[0, layout.local[name]]] for name in layout.names}
        print(
            f"intervals of {100 * level:.0f} % hold", {name: f"{100 * np.mean(v):.1f} %" for name, v in parts.items()}
        )


if __name__ == "__main__":
    main()
