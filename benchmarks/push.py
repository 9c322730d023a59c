"""2000 quartic pushes of 200 steps in one call: pushes per second, the gradient's cost, and small arrays beside it.

    python benchmarks/push.py [--batch 2000] [--steps 200] [--x64]

Everything is measured in one run, in turn; quote the ratios.
"""

import argparse

import jax

parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--batch", type=int, default=2000)
parser.add_argument("--steps", type=int, default=200)
parser.add_argument("--x64", action="store_true")
arguments = parser.parse_args()
if arguments.x64:
    jax.config.update("jax_enable_x64", True)

import array_push  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from _measure import alternate, compiled, header  # noqa: E402

import pushjax as pj  # noqa: E402

RADIUS = 0.00475


def main() -> None:
    block = pj.Polygon.rectangle(0.09, 0.09)
    key = jax.random.key(0)
    mean = pj.fit_limit_surface(*pj.Support.uniform(block).wrench_twist_pairs(key, 400))
    assert isinstance(mean, pj.Quartic)
    hand = pj.Hand.finger(RADIUS)
    path = pj.line((-0.06, 0.01), (-0.01, 0.01), arguments.steps)
    batch = arguments.batch
    # small differences between the pushes, so that no work can be shared
    coefficients = mean.coefficients * (1 + 0.01 * jax.random.normal(key, (batch, 15)))
    friction = jax.random.uniform(key, (batch,), minval=0.15, maxval=0.35)

    def scalars(c, mu):
        slider = pj.Slider(block, pj.Quartic(c, mean.length))
        return pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=mu).pose[-1]

    def arrays(c, mu):
        return array_push.final_pose(
            c, mean.length, block.vertices, jnp.asarray(RADIUS, c.dtype), path, jnp.zeros(3), mu
        )

    def loss(c, mu):
        return jnp.sum(scalars(c, mu) ** 2)

    programs, compile_s = {}, {}
    for name, function in (
        ("scalars", scalars),
        ("arrays", arrays),
        ("gradient", jax.grad(loss, argnums=(0, 1))),
    ):
        program, compile_s[name] = compiled(jax.vmap(function), coefficients, friction)
        programs[name] = (program, (coefficients, friction))
    run_s = alternate(programs)

    final = {name: np.asarray(programs[name][0](coefficients, friction)) for name in ("scalars", "arrays")}
    apart = np.abs(final["scalars"] - final["arrays"]).max(axis=0)
    print(header())
    print(f"{batch} pushes of {arguments.steps} steps, {coefficients.dtype}, quartic, square, round finger")
    for name, seconds in run_s.items():
        steps = batch * arguments.steps
        print(
            f"  {name:9} compile {compile_s[name]:6.2f} s   run {1e3 * seconds:8.1f} ms   "
            f"{batch / seconds:10.0f} pushes/s   {1e9 * seconds / steps:7.1f} ns per push and step"
        )
    print(f"  small arrays / scalars: {run_s['arrays'] / run_s['scalars']:.1f} x the time")
    print(f"  gradient / forward:     {run_s['gradient'] / run_s['scalars']:.1f} x the time")
    worst = 1e3 * apart[:2].max(), np.degrees(apart[2])
    print(f"  final poses of the two differ by at most {worst[0]:.1e} mm, {worst[1]:.1e} deg")


if __name__ == "__main__":
    main()
