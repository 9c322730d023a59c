"""A hundred thousand random control steps of PushT with each limit surface, in float32, under random friction."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.tasks import PushT

BATCH, STEPS = 2048, 50


@pytest.mark.slow
@pytest.mark.parametrize("degree", [2, 4])
def test_everything_is_finite(degree):
    """Actions anywhere in the workspace, which press the block into walls and corners; automatic resets."""
    env = PushT()
    model = pj.FrictionModel(dof=20.0, friction=(0.0, 0.6))
    with jax.enable_x64(False):
        params = env.params("table" if degree == 4 else "pymunk", model=model, position_noise=1.0, action_noise=5.0)

        @jax.jit
        def program(key, states):
            def one_step(states, key):
                aim_key, step_key = jax.random.split(key)
                # half of the actions are steered at the block
                anywhere, scatter = 512 * jax.random.uniform(aim_key, (2, BATCH, 2))
                steered = states.pose[:, :2] + (scatter - 256) / 4
                actions = jnp.where((jnp.arange(BATCH) % 2 == 0)[:, None], steered, anywhere)
                keys = jax.random.split(step_key, BATCH)
                out = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)
                observation, states, reward, terminated, truncated, info = out
                leaves = jax.tree.leaves((observation, states, reward, info["coverage"]))
                finite = jnp.stack([jnp.all(jnp.isfinite(leaf)) for leaf in leaves])
                return states, (jnp.all(finite), jnp.sum(info["status"], axis=0), jnp.sum(terminated | truncated))

            return jax.lax.scan(one_step, states, jax.random.split(key, STEPS))

        keys = jax.random.split(jax.random.key(0), BATCH)
        states = jax.jit(jax.vmap(env.reset, in_axes=(0, None)))(keys, params)[1]
        _, (finite, statuses, _) = program(jax.random.key(1), states)
    counts = dict(zip(pj.Status, np.asarray(statuses).sum(0).tolist(), strict=True))
    assert np.all(finite)
    assert sum(counts.values()) == BATCH * STEPS * env.substeps
    assert counts[pj.Status.JAMMED] > 1_000
    assert counts[pj.Status.INVALID] == 0
    assert counts[pj.Status.NOT_CONVERGED] < 1e-3 * BATCH * STEPS
