"""Functions that the tables of predicted against measured pushes share."""

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj

BOOTSTRAP_SAMPLES = 2000


@jax.jit
def final_poses(slider: pj.Slider, hand: pj.Hand, pushes: pj.Pushes, frictions: jax.Array):
    """Simulate pushes at every friction: poses (frictions, pushes, 3) and failed steps (frictions, pushes)."""

    def final_pose(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed)

    over_pushes = jax.vmap(final_pose, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(pushes.path, pushes.start, frictions)


def bootstrapped_ci95(values: np.ndarray, rng: np.random.Generator) -> float:
    """Return half the width of the bootstrapped 95 % confidence interval of the mean of values (n,)."""
    resampled = rng.choice(values, (BOOTSTRAP_SAMPLES, len(values))).mean(axis=1)
    return float(np.diff(np.quantile(resampled, [0.025, 0.975]))[0] / 2)
