"""An evolution strategy (Salimans et al. 2017): a zeroth-order learner that compares whole episodes."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, PRNGKeyArray

from examples.push_box_policy import ENV, EPISODE, Policy
from pushjax.tasks import TableParams, TaskState

PAIRS, SIGMA = 512, 0.05  # of policies, each with one episode; standard deviation of their parameters
OPTIMIZER = optax.adam(2e-2)


class Learner(NamedTuple):
    """State of the training."""

    policy: Policy
    optimizer: Any


def start(key: PRNGKeyArray, params: TableParams) -> Learner:
    """Return the state before the first update."""
    policy = Policy(key)
    return Learner(policy, OPTIMIZER.init(eqx.filter(policy.actor, eqx.is_array)))


@eqx.filter_jit
def update(learner: Learner, key: PRNGKeyArray, params: TableParams) -> tuple[Learner, Array]:
    """Compare episodes of pairs of policies and move toward the better ones. Return the mean reward, too."""
    noise_key, reset_key = jax.random.split(key)
    trainable, static = eqx.partition(learner.policy.actor, eqx.is_array)
    center, unravel = ravel_pytree(trainable)
    noise = jax.random.normal(noise_key, (PAIRS, center.size))
    observations, states = jax.vmap(ENV.reset, in_axes=(0, None))(jax.random.split(reset_key, PAIRS), params)

    def returns(sign: float) -> Array:
        def one(noise: Array, observation: Array, state: TaskState) -> Array:
            actor = eqx.combine(unravel(center + sign * SIGMA * noise), static)
            policy = eqx.tree_at(lambda policy: policy.actor, learner.policy, actor)

            def step(carry: tuple[TaskState, Array, Array], _: Any):
                state, observation, done = carry
                after = ENV.step_env(reset_key, state, policy.mean(observation), params)
                observation, state, reward, success, _ = after
                return (state, observation, done | success), jnp.where(done, 0.0, reward)

            carry = state, observation, jnp.zeros((), bool)
            return jnp.sum(jax.lax.scan(step, carry, None, EPISODE)[1])

        return jax.vmap(one)(noise, observations, states)

    better, worse = returns(1.0), returns(-1.0)
    # Ranks instead of returns: the few episodes that go very wrong do not decide.
    both = jnp.concatenate([better, worse])
    ranks = jnp.argsort(jnp.argsort(both)) / (2 * PAIRS - 1) - 0.5
    gradient = -(ranks[:PAIRS] - ranks[PAIRS:]) @ noise / (PAIRS * SIGMA)
    changes, optimizer = OPTIMIZER.update(unravel(gradient), learner.optimizer)
    actor = eqx.combine(eqx.apply_updates(trainable, changes), static)
    policy = eqx.tree_at(lambda policy: policy.actor, learner.policy, actor)
    return Learner(policy, optimizer), jnp.mean(both) / EPISODE
