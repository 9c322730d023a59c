"""Proximal policy optimization (Schulman et al. 2017), a zeroth-order learner: it needs no derivatives of the task."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, PRNGKeyArray

from examples.push_box_policy import DISCOUNT, ENV, REWARD_SCALE, Policy, starts_in_midst
from pushjax.tasks import TableParams, TaskState

ENVIRONMENTS, STEPS = 1024, 16  # of one update
EPOCHS, MINIBATCHES = 3, 8
TRACE_DECAY, CLIP, ENTROPY, VALUE_WEIGHT = 0.95, 0.2, 1e-3, 0.5
OPTIMIZER = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))


class Batch(NamedTuple):
    """What an update learns from: an array over the steps for each field."""

    observation: Array
    action: Array
    log_prob: Array
    advantage: Array
    returns: Array


class Learner(NamedTuple):
    """State of the training."""

    policy: Policy
    optimizer: Any
    states: TaskState
    observations: Array


def start(key: PRNGKeyArray, params: TableParams) -> Learner:
    """Return the state before the first update. Episodes are at different times of their limit."""
    policy_key, reset_key, time_key = jax.random.split(key, 3)
    observations, states = starts_in_midst(reset_key, time_key, params, ENVIRONMENTS)
    policy = Policy(policy_key)
    return Learner(policy, OPTIMIZER.init(eqx.filter(policy, eqx.is_array)), states, observations)


@eqx.filter_jit
def update(learner: Learner, key: PRNGKeyArray, params: TableParams) -> tuple[Learner, Array]:
    """Take control steps in all environments and improve the policy. Return the mean reward, too."""
    collect_key, shuffle_key = jax.random.split(key)
    states, observations, batch, reward = _collect(learner, collect_key, params)
    trainable, static = eqx.partition(learner.policy, eqx.is_array)

    def minibatch_step(carry: tuple[Any, Any], batch: Batch):
        trainable, optimizer = carry
        gradient = jax.grad(lambda trainable: _loss(eqx.combine(trainable, static), batch))(trainable)
        changes, optimizer = OPTIMIZER.update(gradient, optimizer)
        return (eqx.apply_updates(trainable, changes), optimizer), None

    def epoch(carry: tuple[Any, Any], key: PRNGKeyArray):
        order = jax.random.permutation(key, ENVIRONMENTS * STEPS).reshape(MINIBATCHES, -1)
        return jax.lax.scan(minibatch_step, carry, jax.tree.map(lambda leaf: leaf[order], batch))

    carry = trainable, learner.optimizer
    (trainable, optimizer), _ = jax.lax.scan(epoch, carry, jax.random.split(shuffle_key, EPOCHS))
    return Learner(eqx.combine(trainable, static), optimizer, states, observations), reward


def _collect(learner: Learner, key: PRNGKeyArray, params: TableParams) -> tuple[TaskState, Array, Batch, Array]:
    policy = learner.policy

    def step(carry: tuple[TaskState, Array], key: PRNGKeyArray):
        states, observations = carry
        action_key, step_key = jax.random.split(key)
        mean, actions = policy.act(action_key, observations)
        keys = jax.random.split(step_key, ENVIRONMENTS)
        after, states, reward, terminated, truncated, info = jax.vmap(ENV.step, in_axes=(0, 0, 0, None))(
            keys, states, actions, params
        )
        # The value after a truncation is that of the observation before the reset.
        next_value = jnp.where(terminated, 0.0, jax.vmap(policy.value)(info["final_observation"]))
        record = (observations, actions, _log_prob(policy, mean, actions), REWARD_SCALE * reward, next_value)
        return (states, after), (*record, jax.vmap(policy.value)(observations), terminated | truncated)

    carry = learner.states, learner.observations
    (states, after), record = jax.lax.scan(step, carry, jax.random.split(key, STEPS))
    observation, action, log_prob, reward, next_value, value, ended = record

    def backward(advantage: Array, row: tuple[Array, Array]):
        error, ended = row
        advantage = error + DISCOUNT * TRACE_DECAY * jnp.where(ended, 0.0, advantage)
        return advantage, advantage

    errors = reward + DISCOUNT * next_value - value
    _, advantage = jax.lax.scan(backward, jnp.zeros(ENVIRONMENTS), (errors, ended), reverse=True)
    batch = Batch(observation, action, log_prob, advantage, advantage + value)
    flat = jax.tree.map(lambda leaf: leaf.reshape(ENVIRONMENTS * STEPS, *leaf.shape[2:]), batch)
    return states, after, flat, jnp.mean(reward) / REWARD_SCALE


def _log_prob(policy: Policy, mean: Array, actions: Array) -> Array:
    """Return the logarithm of the density of actions, but for a constant."""
    scaled = (actions - mean) * jnp.exp(-policy.log_std)
    return jnp.sum(-0.5 * scaled**2 - policy.log_std, axis=-1)


def _loss(policy: Policy, batch: Batch) -> Array:
    mean = jax.vmap(policy.mean)(batch.observation)
    ratio = jnp.exp(_log_prob(policy, mean, batch.action) - batch.log_prob)
    advantage = (batch.advantage - jnp.mean(batch.advantage)) / (jnp.std(batch.advantage) + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    error = jax.vmap(policy.value)(batch.observation) - batch.returns
    return -jnp.mean(gain) + VALUE_WEIGHT * jnp.mean(error**2) - ENTROPY * jnp.sum(policy.log_std)
