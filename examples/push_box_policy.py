"""What all learners of `examples.learn_push_box` share: the policy, its evaluation, and the friction.

The task is `pushjax.tasks.PushBox`: a round finger pushes a block to a pose.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

import pushjax as pj
from pushjax.tasks import PushBox, TableParams, TaskState

ENV = PushBox()
EPISODE = 100  # control steps
SUCCESS = 0.8  # coverage of the goal
REWARD_SCALE = 0.03  # so that returns have a size of about one
DISCOUNT = 0.97


class Friction(NamedTuple):
    """A distribution of friction.

    Attributes:
        contact: Range of the coefficient of friction at the finger.
        dof: Degrees of freedom of the distribution of limit surfaces around that of even pressure.
    """

    contact: tuple[float, float]
    dof: float

    def params(self) -> TableParams:
        """Return the parameters of the task with this friction."""
        model = pj.FrictionModel(self.dof, self.contact, sampler="sum_of_squares")
        return ENV.params(model=model, success_coverage=SUCCESS)


# So many degrees of freedom leave the mean: one program then serves both, because only numbers differ.
KNOWN = Friction((0.3, 0.3), 1e6)
RANDOM = Friction((0.15, 0.45), 20.0)
# Of these only the first has been seen in training.
TESTS = {
    "0.3, even pressure": KNOWN,
    "0 to 0.1, random surface": Friction((0.0, 0.1), 12.0),
    "0.6 to 1, random surface": Friction((0.6, 1.0), 12.0),
}


class Policy(eqx.Module):
    """A policy with normally distributed actions, and an estimate of the value of a state.

    Attributes:
        actor: Network from features to the mean of the action.
        critic: Network from features to the value.
        log_std: Logarithm of the standard deviation of the actions.
    """

    actor: eqx.nn.MLP
    critic: eqx.nn.MLP
    log_std: Float[Array, "actions"]

    def __init__(self, key: PRNGKeyArray, width: int = 64):
        size, actions = features(jnp.zeros(6)).shape[0], ENV.num_actions
        actor_key, critic_key = jax.random.split(key)
        self.actor = eqx.nn.MLP(size, actions, width, 2, jax.nn.elu, key=actor_key)
        self.critic = eqx.nn.MLP(size, "scalar", width, 2, jax.nn.elu, key=critic_key)
        self.log_std = jnp.full(actions, -0.5, self.actor.layers[0].weight.dtype)

    def mean(self, observation: Float[Array, "6"]) -> Float[Array, "actions"]:
        """Return the mean of the action."""
        return self.actor(features(observation))

    def act(self, key: PRNGKeyArray, observations: Float[Array, "batch 6"]) -> tuple[Array, Array]:
        """Return means of the actions of a batch, and actions drawn around them, (batch, actions) each."""
        mean = jax.vmap(self.mean)(observations)
        return mean, mean + jnp.exp(self.log_std) * jax.random.normal(key, mean.shape)

    def value(self, observation: Float[Array, "6"]) -> Float[Array, ""]:
        """Return the estimated return from a state."""
        return self.critic(features(observation))


def features(observation: Float[Array, "6"]) -> Float[Array, "8"]:
    """Return what the networks see: the observation in units of about one, and the way from the block to the finger."""
    finger, block, turn = observation[:2], observation[2:4], observation[4:]
    return jnp.concatenate([10 * (finger - block), 10 * block, turn, 4 * finger])


def starts(key: PRNGKeyArray, params: TableParams, count: int) -> tuple[Array, TaskState]:
    """Start episodes. Return their observations and states."""
    return jax.vmap(ENV.reset, in_axes=(0, None))(jax.random.split(key, count), params)


def starts_in_midst(
    key: PRNGKeyArray, time_key: PRNGKeyArray, params: TableParams, count: int
) -> tuple[Array, TaskState]:
    """Start episodes at different times of their limit, so that they do not all end together."""
    observations, states = starts(key, params, count)
    return observations, states.replace(time=jax.random.randint(time_key, (count,), 0, params.max_steps_in_episode))


class Outcome(NamedTuple):
    """How episodes end, each an array over the episodes.

    Attributes:
        success: Whether the block got to the goal.
        coverage: The largest coverage of the goal.
        steps: Control steps until success, or the limit.
    """

    success: Array
    coverage: Array
    steps: Array


@eqx.filter_jit
def evaluate(policy: Policy, key: PRNGKeyArray, params: TableParams, episodes: int = 1024) -> Outcome:
    """Let a policy act without noise, for one episode in each of many environments."""
    reset_key, step_key = jax.random.split(key)
    observations, states = starts(reset_key, params, episodes)

    def step(carry: tuple[TaskState, Array, Array], _: None):
        states, observations, done = carry
        actions = jax.vmap(policy.mean)(observations)
        after = jax.vmap(ENV.step_env, in_axes=(None, 0, 0, None))(step_key, states, actions, params)
        observations, states, _reward, terminated, info = after
        coverage = jnp.where(done, 0.0, info["coverage"])
        return (states, observations, done | terminated), (coverage, done)

    start = states, observations, jnp.zeros(episodes, bool)
    (_, _, success), (coverage, done) = jax.lax.scan(step, start, None, EPISODE)
    return Outcome(success, jnp.max(coverage, axis=0), jnp.sum(~done, axis=0))
