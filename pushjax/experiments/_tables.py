"""What tables of predicted against measured pushes share."""

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj

BOOTSTRAPS = 2000


@jax.jit
def final_poses(slider: pj.Slider, hand: pj.Hand, pushes: pj.Pushes, frictions: jax.Array):
    """Of every push at every friction, (frictions, pushes, 3), and how many of its steps failed."""

    def one(path, start, friction):
        push = pj.rollout(slider, hand, path, pose=start, friction=friction)
        return push.pose[-1], jnp.sum(push.failed)

    over_pushes = jax.vmap(one, in_axes=(0, 0, None))
    return jax.vmap(over_pushes, in_axes=(None, None, 0))(pushes.path, pushes.start, frictions)


def bootstrapped_ci95(values: np.ndarray, rng: np.random.Generator) -> float:
    """Half the width of the 95 % interval of a mean."""
    resampled = rng.choice(values, (BOOTSTRAPS, len(values))).mean(axis=1)
    return float(np.diff(np.quantile(resampled, [0.025, 0.975]))[0] / 2)
