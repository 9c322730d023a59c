"""Learn to push a block to a pose by proximal policy optimization (PPO, Schulman et al. 2017), in JAX from end to end.

    python examples/learn_push_box.py [--seconds 90] [--seed 0] [--known-friction]

trains a policy for `pushjax.tasks.PushBox` and tests it under friction that it has not seen. The policy has no memory,
so it cannot identify the friction.
"""

import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Float, PRNGKeyArray

import pushjax as pj
from pushjax.tasks import PushBox, TableParams, TaskState

ENV = PushBox()
EPISODE, SUCCESS = 100, 0.8  # control steps of an episode; coverage of the goal that counts as success
REWARD_SCALE, DISCOUNT = 0.03, 0.97  # with this scale returns have a size of about one
ENVIRONMENTS, STEPS, EPOCHS, MINIBATCHES = 1024, 16, 3, 8  # of one update
TRACE_DECAY, CLIP, ENTROPY, VALUE_WEIGHT = 0.95, 0.2, 1e-3, 0.5
RESET, STEP = jax.vmap(ENV.reset, (0, None)), jax.vmap(ENV.step, (0, 0, 0, None))  # of all environments
OPTIMIZER = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3))


def friction(contact: tuple[float, float], dof: float) -> TableParams:
    """Return the parameters of the task with random friction at the finger, and limit surfaces of so many dof."""
    return ENV.params(model=pj.FrictionModel(dof, contact, sampler="sum_of_squares"), success_coverage=SUCCESS)


# So many degrees of freedom leave the mean: one program then serves both, because only numbers differ.
KNOWN, RANDOM = friction((0.3, 0.3), 1e6), friction((0.15, 0.45), 20.0)
TESTS = {
    "0.3, even pressure": KNOWN,
    "0 to 0.1, random surface": friction((0.0, 0.1), 12.0),
    "0.6 to 1, random surface": friction((0.6, 1.0), 12.0),
}


class Policy(eqx.Module):
    """A policy with normally distributed actions, and an estimate of the value of a state."""

    actor: eqx.nn.MLP  # from features to the mean of the action
    critic: eqx.nn.MLP  # from features to the value
    log_std: Array  # (actions,), logarithm of the standard deviation of the actions

    def __init__(self, key: PRNGKeyArray, width: int = 64):
        actor_key, critic_key = jax.random.split(key)
        self.actor = eqx.nn.MLP(8, ENV.num_actions, width, 2, jax.nn.elu, key=actor_key)
        self.critic = eqx.nn.MLP(8, "scalar", width, 2, jax.nn.elu, key=critic_key)
        self.log_std = jnp.full(ENV.num_actions, -0.5, self.actor.layers[0].weight.dtype)

    def mean(self, observations: Float[Array, "*batch 6"]) -> Array:
        """Return the means of the actions, (..., actions)."""
        return jnp.vectorize(self.actor, signature="(i)->(j)")(features(observations))

    def value(self, observations: Float[Array, "*batch 6"]) -> Array:
        """Return the estimated returns, (...)."""
        return jnp.vectorize(self.critic, signature="(i)->()")(features(observations))

    def log_prob(self, observations: Array, actions: Array) -> Array:
        """Return the logarithm of the density of actions, but for a constant."""
        scaled = (actions - self.mean(observations)) * jnp.exp(-self.log_std)
        return jnp.sum(-0.5 * scaled**2 - self.log_std, axis=-1)


def features(observations: Float[Array, "*batch 6"]) -> Float[Array, "*batch 8"]:
    """Return what the networks see: the observation in units of about one, and the way from the block to the finger."""
    finger, block, turn = jnp.split(observations, 3, axis=-1)
    return jnp.concatenate([10 * (finger - block), 10 * block, turn, 4 * finger], axis=-1)


class Learner(NamedTuple):
    """State of the training."""

    policy: Policy
    optimizer: Any
    states: TaskState
    observations: Array


def start(key: PRNGKeyArray, params: TableParams) -> Learner:
    """Return the state before the first update. Episodes are at different times, so that they do not end together."""
    policy_key, reset_key, time_key = jax.random.split(key, 3)
    observations, states = RESET(jax.random.split(reset_key, ENVIRONMENTS), params)
    times = jax.random.randint(time_key, (ENVIRONMENTS,), 0, params.max_steps_in_episode, states.time.dtype)
    policy = Policy(policy_key)
    return Learner(policy, OPTIMIZER.init(eqx.filter(policy, eqx.is_array)), states.replace(time=times), observations)


def collect(learner: Learner, key: PRNGKeyArray, params: TableParams) -> tuple[Learner, tuple[Array, ...], Array]:
    """Take control steps. Return the learner after them, the arguments of `loss`, and the mean reward."""
    policy = learner.policy

    def step(carry: tuple[TaskState, Array], key: PRNGKeyArray):
        states, observations = carry
        action_key, step_key = jax.random.split(key)
        mean = policy.mean(observations)
        actions = mean + jnp.exp(policy.log_std) * jax.random.normal(action_key, mean.shape)
        keys = jax.random.split(step_key, ENVIRONMENTS)
        after, states, reward, terminated, truncated, info = STEP(keys, states, actions, params)
        # The value after a truncation is that of the observation before the reset.
        next_value = jnp.where(terminated, 0.0, policy.value(info["final_observation"]))
        target, value = REWARD_SCALE * reward + DISCOUNT * next_value, policy.value(observations)
        record = (observations, actions, policy.log_prob(observations, actions), target - value, value)
        return (states, after), (*record, terminated | truncated, reward)

    carry = learner.states, learner.observations
    (states, after), record = jax.lax.scan(step, carry, jax.random.split(key, STEPS))
    observation, action, log_prob, error, value, ended, reward = record

    def backward(advantage: Array, row: tuple[Array, Array]):
        error, ended = row
        advantage = error + DISCOUNT * TRACE_DECAY * jnp.where(ended, 0.0, advantage)
        return advantage, advantage

    _, advantage = jax.lax.scan(backward, jnp.zeros(ENVIRONMENTS), (error, ended), reverse=True)
    batch = observation, action, log_prob, advantage, advantage + value
    flat = jax.tree.map(lambda leaf: leaf.reshape(ENVIRONMENTS * STEPS, *leaf.shape[2:]), batch)
    return learner._replace(states=states, observations=after), flat, jnp.mean(reward)


def loss(policy: Policy, observation: Array, action: Array, old: Array, advantage: Array, returns: Array) -> Array:
    """Return the clipped objective of PPO with the error of the values, and a bonus for entropy."""
    ratio = jnp.exp(policy.log_prob(observation, action) - old)
    advantage = (advantage - jnp.mean(advantage)) / (jnp.std(advantage) + 1e-8)
    gain = jnp.minimum(ratio * advantage, jnp.clip(ratio, 1 - CLIP, 1 + CLIP) * advantage)
    error = policy.value(observation) - returns
    return -jnp.mean(gain) + VALUE_WEIGHT * jnp.mean(error**2) - ENTROPY * jnp.sum(policy.log_std)


@eqx.filter_jit
def update(learner: Learner, key: PRNGKeyArray, params: TableParams) -> tuple[Learner, Array]:
    """Take control steps in all environments and improve the policy. Return the mean reward, too."""
    collect_key, shuffle_key = jax.random.split(key)
    learner, batch, reward = collect(learner, collect_key, params)
    trainable, static = eqx.partition(learner.policy, eqx.is_array)

    def minibatch_step(carry: tuple[Any, Any], batch: tuple[Array, ...]):
        trainable, optimizer = carry
        gradient = jax.grad(lambda trainable: loss(eqx.combine(trainable, static), *batch))(trainable)
        changes, optimizer = OPTIMIZER.update(gradient, optimizer)
        return (eqx.apply_updates(trainable, changes), optimizer), None

    def epoch(carry: tuple[Any, Any], key: PRNGKeyArray):
        order = jax.random.permutation(key, ENVIRONMENTS * STEPS).reshape(MINIBATCHES, -1)
        return jax.lax.scan(minibatch_step, carry, jax.tree.map(lambda leaf: leaf[order], batch))

    carry = trainable, learner.optimizer
    (trainable, optimizer), _ = jax.lax.scan(epoch, carry, jax.random.split(shuffle_key, EPOCHS))
    return learner._replace(policy=eqx.combine(trainable, static), optimizer=optimizer), reward


@eqx.filter_jit
def success(policy: Policy, key: PRNGKeyArray, params: TableParams) -> Array:
    """Return the share of episodes in which the policy, without noise, brings the block to the goal."""

    def step(carry: tuple[TaskState, Array, Array], _: None):
        states, observations, done = carry
        after = jax.vmap(ENV.step_env, in_axes=(None, 0, 0, None))(key, states, policy.mean(observations), params)
        observations, states, _reward, terminated, _info = after
        return (states, observations, done | terminated), None

    observations, states = RESET(jax.random.split(key, ENVIRONMENTS), params)
    (_, _, done), _ = jax.lax.scan(step, (states, observations, jnp.zeros(ENVIRONMENTS, bool)), None, EPISODE)
    return jnp.mean(done)


def main(seconds: float = 90.0, seed: int = 0, known_friction: bool = False) -> None:
    """Train a policy for PushBox by PPO, and test it under friction that it has not seen.

    Args:
        seconds: Processor time of the training, without compilation and tests.
        seed: Seed of everything random.
        known_friction: Train with a friction of 0.3 and even pressure, not with random friction.
    """
    params, key = KNOWN if known_friction else RANDOM, jax.random.key(seed)
    learner = start(key, params)
    jax.block_until_ready(update(learner, key, params))  # compiles
    used, updates = 0.0, 0
    while used < seconds:
        begin, key = time.process_time(), jax.random.fold_in(key, updates)
        learner, reward = jax.block_until_ready(update(learner, key, params))
        used, updates = used + time.process_time() - begin, updates + 1
        if updates % 20 == 0 or used >= seconds:
            print(
                f"{used:4.0f} s, {updates * ENVIRONMENTS * STEPS} control steps, mean reward {reward:.3f}", flush=True
            )
    for name, tested in TESTS.items():
        print(f"success, friction {name}: {np.asarray(success(learner.policy, jax.random.key(2000), tested)):.2f}")


if __name__ == "__main__":
    tyro.cli(main)
