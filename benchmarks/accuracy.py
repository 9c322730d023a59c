"""Error and penetration depth of pushes as functions of the step.

    python -m benchmarks accuracy

A 90 mm square is pushed 221 times by 50 mm. The pushes start every 5 mm across a side and go every 10 degrees up to 60
degrees from its normal; mu is 0.25. Some slide off a corner. All is computed in float64; the reference has 6400 steps.
"""

import argparse

import jax

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import pushjax as pj  # noqa: E402
from benchmarks._measure import header  # noqa: E402
from pushjax.geometry import se2  # noqa: E402

LENGTH, FRICTION, GAP, REFERENCE = 0.05, 0.25, 0.0005, 6400


def fan(slider: pj.Slider, radius: float, steps: int) -> tuple[np.ndarray, float]:
    """Simulate the fan of pushes.

    Args:
        slider: The square.
        radius: Radius of the finger, m.
        steps: Number of steps of each push.

    Returns:
        The final poses, (pushes, 3), and the largest penetration depth at the end of any step, m.
    """
    offsets, angles = np.meshgrid(np.linspace(-0.04, 0.04, 17), np.radians(np.linspace(-60, 60, 13)))

    def one(offset, angle):
        start = jnp.stack([-0.045 - radius - GAP, offset])
        path = pj.line(start, start + LENGTH * jnp.stack([jnp.cos(angle), jnp.sin(angle)]), steps)
        push = pj.rollout(slider, pj.Hand.finger(radius), path, pose=jnp.zeros(3), friction=FRICTION)
        fingers = jax.vmap(lambda pose, q: se2.transform(se2.inverse(pose), q))(push.pose, path)
        gap = jax.vmap(slider.shape.signed_distance)(fingers) - radius
        return push.pose[-1], jnp.min(gap)

    pose, gap = jax.jit(jax.vmap(one))(offsets.ravel(), angles.ravel())
    return np.asarray(pose), max(0.0, -float(jnp.min(gap)))


def main() -> None:
    square = pj.Polygon.rectangle(0.09, 0.09)
    surface = pj.fit_limit_surface(*pj.Support.uniform(square).wrench_twist_pairs(jax.random.key(0), 400))
    slider = pj.Slider(square, surface)
    print(header())
    for radius in (0.00475, 0.001, 0.0):
        exact, _ = fan(slider, radius, REFERENCE)
        print(f"finger of {1e3 * radius:g} mm:  step    worst (mm, deg)      median (mm)   penetration (um)")
        for steps in (10, 25, 50, 100, 200):
            pose, depth = fan(slider, radius, steps)
            off = np.linalg.norm(pose[:, :2] - exact[:, :2], axis=1)
            turn = np.degrees(np.abs(pose[:, 2] - exact[:, 2]).max())
            print(
                f"  {1e3 * LENGTH / steps:20.2f} mm   {1e3 * off.max():8.4f} {turn:8.4f}   "
                f"{1e3 * np.median(off):10.6f}   {1e6 * depth:10.4f}"
            )


if __name__ == "__main__":
    main()
