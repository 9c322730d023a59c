"""Analytic policy gradients: derivatives of the return through the simulator, over a short horizon.

As in the short-horizon actor-critic of Xu et al. 2022: the loss is minus the rewards of a few control steps and the
value of the last state, and its derivative goes through all of these steps. The value is learned from the same steps.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PRNGKeyArray

from examples.push_box_policy import DISCOUNT, ENV, REWARD_SCALE, Policy, starts, starts_in_midst
from pushjax.tasks import TableParams, TaskState

ENVIRONMENTS = 512
TRACE_DECAY = 0.95
CRITIC_STEPS = 8
ACTOR = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(2e-3))
CRITIC = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(2e-3))


class Learner(NamedTuple):
    """State of the training."""

    policy: Policy
    optimizers: Any
    states: TaskState
    observations: Array


def start(key: PRNGKeyArray, params: TableParams) -> Learner:
    """Return the state before the first update. Episodes are at different times of their limit."""
    policy_key, reset_key, time_key = jax.random.split(key, 3)
    observations, states = starts_in_midst(reset_key, time_key, params, ENVIRONMENTS)
    policy = Policy(policy_key)
    parameters = eqx.filter(policy, eqx.is_array)
    return Learner(policy, (ACTOR.init(parameters), CRITIC.init(parameters)), states, observations)


@eqx.filter_jit
def update(learner: Learner, key: PRNGKeyArray, params: TableParams, horizon: int) -> tuple[Learner, Array]:
    """Take `horizon` control steps in all environments and improve the policy. Return the mean reward, too."""
    act_key, reset_key = jax.random.split(key)
    policy, (actor, critic) = learner.policy, learner.optimizers
    (_, (states, after, record)), gradient = _gradient(policy, learner, act_key, params, horizon)
    changes, actor = ACTOR.update(gradient, actor)
    policy = eqx.apply_updates(policy, changes)
    policy, critic = _fit_values(policy, critic, record)
    # Episodes end between updates only, so that no derivative goes through a reset.
    ended = jax.vmap(ENV.is_truncated, in_axes=(0, None))(states, params) | record.success[-1]
    new_observations, new_states = starts(reset_key, params, ENVIRONMENTS)
    states, after = jax.tree.map(
        lambda new, old: jnp.where(ended.reshape(-1, *[1] * (old.ndim - 1)), new, old),
        (new_states, new_observations),
        (states, after),
    )
    return Learner(policy, (actor, critic), states, after), jnp.mean(record.reward) / REWARD_SCALE


class Record(NamedTuple):
    """The control steps of one update, each an array (steps, environments, ...)."""

    observation: Array
    reward: Array
    next_observation: Array
    success: Array


@eqx.filter_value_and_grad(has_aux=True)
def _gradient(policy: Policy, learner: Learner, key: PRNGKeyArray, params: TableParams, horizon: int):
    def step(carry: tuple[TaskState, Array], key: PRNGKeyArray):
        states, observations = carry
        # Noise explores, and smooths the return; its size is not learned.
        _, actions = policy.act(key, observations)
        after, states, reward, success, _ = jax.vmap(ENV.step_env, in_axes=(None, 0, 0, None))(
            key, states, actions, params
        )
        return (states, after), Record(observations, REWARD_SCALE * reward, after, success)

    carry = learner.states, learner.observations
    (states, after), record = jax.lax.scan(step, carry, jax.random.split(key, horizon))
    discounts = DISCOUNT ** jnp.arange(horizon + 1)
    # A step after success has nothing to gain, and its reward is about zero, as is the value.
    fixed = eqx.tree_at(lambda policy: policy.critic, policy, replace_fn=_without_derivatives)
    value = jax.vmap(fixed.value)(after) * discounts[-1]
    gain = jnp.sum(discounts[:-1, None] * record.reward, axis=0) + value
    return -jnp.mean(gain), (states, after, jax.tree.map(jax.lax.stop_gradient, record))


def _without_derivatives(tree: Any) -> Any:
    """Return a pytree whose arrays are constants."""
    return jax.tree.map(lambda leaf: jax.lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def _fit_values(policy: Policy, optimizer: Any, record: Record) -> tuple[Policy, Any]:
    """Fit the critic to the returns of the recorded steps."""
    evaluate = jax.vmap(jax.vmap(policy.value))
    value, next_value = evaluate(record.observation), evaluate(record.next_observation)

    def backward(advantage: Array, row: tuple[Array, Array]):
        error, success = row
        advantage = error + DISCOUNT * TRACE_DECAY * jnp.where(success, 0.0, advantage)
        return advantage, advantage

    errors = record.reward + DISCOUNT * jnp.where(record.success, 0.0, next_value) - value
    _, advantage = jax.lax.scan(backward, jnp.zeros(ENVIRONMENTS), (errors, record.success), reverse=True)
    target = advantage + value

    @eqx.filter_grad
    def gradient(policy: Policy) -> Array:
        return jnp.mean((jax.vmap(jax.vmap(policy.value))(record.observation) - target) ** 2)

    trainable, static = eqx.partition(policy, eqx.is_array)

    def step(carry: tuple[Any, Any], _: Any):
        trainable, optimizer = carry
        changes, optimizer = CRITIC.update(gradient(eqx.combine(trainable, static)), optimizer)
        return (eqx.apply_updates(trainable, changes), optimizer), None

    (trainable, optimizer), _ = jax.lax.scan(step, (trainable, optimizer), None, CRITIC_STEPS)
    return eqx.combine(trainable, static), optimizer
