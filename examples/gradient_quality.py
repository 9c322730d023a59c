"""Derivatives through the simulator beside likelihood ratios, as estimates of the same policy gradient.

    python -m examples.gradient_quality [--samples 65536] [--seconds 25] [--json FILE]

Both estimate the derivative of the expected return of a few control steps by the parameters of the policy's mean, under
the policy's noise (Suh et al. 2022, "Do differentiable simulators give better policy gradients?"):

- the derivative of the return through `step_env`, with the noise held fixed; as it is, and with a limit on the
  derivatives by the states between control steps, which makes it biased;
- the likelihood ratio, which uses only rewards, less the return of an independent second episode from the same state.

For each horizon the table says how many samples an estimate needs until its noise is as large as the gradient, and in
brackets the cosine of its mean with that of the likelihood ratio, and its length in units of that. If they are not one,
the estimate is biased, or not known well enough.
States come from episodes of the policy. They are separated by whether the finger is at the block.
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PRNGKeyArray

import pushjax as pj
from examples import ppo
from examples.push_box_policy import DISCOUNT, ENV, RANDOM, REWARD_SCALE, Policy, starts_in_midst
from pushjax.tasks import TableParams, TaskState

HORIZONS = (1, 2, 4, 8, 16)
TOGETHER = 1024  # samples of one call
WALK = 24  # control steps of the policy before a sample begins
ESTIMATES = ("likelihood ratio", "through the simulator", "the same, limited")
LIMIT = 10.0  # of the derivative of a return by a state, 1/m
NEAR = 0.002  # m, largest gap between a finger and a block that it is "at"


class Sample(NamedTuple):
    """Estimates from one start state, for each horizon.

    Attributes:
        estimates: Derivatives of the return, (estimates, horizons, parameters), in the order of `ESTIMATES`.
        near: Whether the finger is at the block at the start.
    """

    estimates: Float[Array, "estimates horizons parameters"]
    near: Bool[Array, ""]


def episode(
    policy: Policy, key: PRNGKeyArray, state: TaskState, first: Array, params: TableParams, limit: float = np.inf
) -> Any:
    """Return the rewards of control steps with noise, and the logarithms of the densities of the actions."""

    def step(carry: tuple[TaskState, Array], key: PRNGKeyArray):
        state, observation = carry if limit == np.inf else _limit_derivatives(carry, limit)
        mean, deviation = policy.mean(observation), jnp.exp(policy.log_std)
        action = mean + deviation * jax.random.normal(key, mean.shape)
        scaled = (jax.lax.stop_gradient(action) - policy.mean(jax.lax.stop_gradient(observation))) / deviation
        observation, state, reward, _, _ = ENV.step_env(key, state, action, params)
        return (state, observation), (REWARD_SCALE * reward, -0.5 * jnp.sum(scaled**2))

    return jax.lax.scan(step, (state, first), jax.random.split(key, HORIZONS[-1]))[1]


def _limit_derivatives(carry: tuple[TaskState, Array], most: float) -> tuple[TaskState, Any]:
    """Return states and observations, whose derivatives in reverse mode are shortened to a largest length."""
    states, observations = carry
    pose, hand, observations = (_limited(rows, most) for rows in (states.pose, states.hand, observations))
    return states.replace(pose=pose, hand=hand), observations


@partial(jax.custom_vjp, nondiff_argnums=(1,))
def _limited(rows: Array, most: float) -> Array:
    return rows


def _shorten(most: float, _: None, derivatives: Array) -> tuple[Array]:
    length = jnp.linalg.norm(derivatives, axis=-1, keepdims=True)
    return (jnp.where(length > most, derivatives * (most / jnp.where(length > most, length, 1.0)), derivatives),)


_limited.defvjp(lambda rows, most: (rows, None), _shorten)


def sample(policy: Policy, key: PRNGKeyArray, state: TaskState, first: Array, params: TableParams) -> Sample:
    """Return the estimates from one state. Those through the simulator share their noise."""
    through_key, ratio_key, other_key = jax.random.split(key, 3)
    counts, steps = jnp.asarray(HORIZONS), jnp.arange(HORIZONS[-1])
    before = counts[:, None] > steps
    weight = jnp.where(before, DISCOUNT**steps, 0.0)  # (horizons, steps)
    arrays, static = eqx.partition(policy, eqx.is_array)
    flat, unravel = ravel_pytree(arrays.actor)

    def rewards(flat: Array, key: PRNGKeyArray, limit: float = np.inf):
        changed = eqx.tree_at(lambda tree: tree.actor, arrays, unravel(flat))
        return episode(eqx.combine(changed, static), key, state, first, params, limit)

    (gained, _), back = jax.vjp(lambda flat: rewards(flat, ratio_key), flat)
    baseline, _ = rewards(flat, other_key)
    # the sum from each step to the horizon
    to_go = jnp.cumsum((weight * (gained - baseline))[:, ::-1], axis=1)[:, ::-1] * before
    estimates = [jax.vmap(lambda row: back((jnp.zeros_like(row), row))[0])(to_go)]
    for limit in (np.inf, LIMIT):
        _, back = jax.vjp(lambda flat, limit=limit: rewards(flat, through_key, limit)[0], flat)
        estimates.append(jax.vmap(lambda row, back=back: back(row)[0])(weight))
    finger = pj.se2.transform(pj.se2.inverse(state.pose), state.hand)
    gap = params.slider.shape.signed_distance(finger) - ENV.hand_model.radius[0]
    return Sample(jnp.stack(estimates), gap < NEAR)


@eqx.filter_jit
def sums(policy: Policy, key: PRNGKeyArray, params: TableParams) -> dict[str, tuple[Array, Array, Array]]:
    """Return for each kind of state: their number, and sums of the estimates and of their squares."""
    reset_key, time_key, walk_key, sample_key = jax.random.split(key, 4)
    first, states = starts_in_midst(reset_key, time_key, params, TOGETHER)

    def step(carry: tuple[TaskState, Array], key: PRNGKeyArray):
        states, first = carry
        noise_key, step_key = jax.random.split(key)
        _, actions = policy.act(noise_key, first)
        keys = jax.random.split(step_key, TOGETHER)
        first, states, *_ = jax.vmap(ENV.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)
        return (states, first), None

    (states, first), _ = jax.lax.scan(step, (states, first), jax.random.split(walk_key, WALK))
    keys = jax.random.split(sample_key, TOGETHER)
    found = jax.vmap(sample, in_axes=(None, 0, 0, 0, None))(policy, keys, states, first, params)
    of = {"at the block": found.near, "apart from it": ~found.near}
    return {
        name: (
            jnp.sum(chosen),
            jnp.einsum("skhp,s->khp", found.estimates, chosen.astype(found.estimates.dtype)),
            jnp.einsum("skhp,skhp,s->kh", found.estimates, found.estimates, chosen.astype(found.estimates.dtype)),
        )
        for name, chosen in of.items()
    }


def compare(policy: Policy, key: PRNGKeyArray, params: TableParams, samples: int) -> list[dict[str, Any]]:
    """Compare both estimates, from a number of samples in all. Return a row for each horizon and kind of state."""
    total: dict[str, list[np.ndarray]] = {}
    for k in range(-(-samples // TOGETHER)):
        for name, parts in sums(policy, jax.random.fold_in(key, k), params).items():
            new = [np.asarray(part, float) for part in parts]
            total[name] = [old + part for old, part in zip(total[name], new, strict=True)] if name in total else new
    rows = []
    for name, (count, first, second) in total.items():
        mean, square = first / count, second / count
        signal = (count * np.sum(mean**2, axis=-1) - square) / (count - 1)  # |E g|^2 without bias
        signal = np.where(signal > 0, signal, np.nan)  # the noise is larger
        needed = (square - signal) / signal
        cosine = np.sum(mean * mean[0], axis=-1) / np.sqrt(signal * signal[0])
        for k, horizon in enumerate(HORIZONS):
            for each, estimate in enumerate(ESTIMATES):
                figures = {"needed": needed[each, k], "cosine": cosine[each, k] if each else 1.0}
                figures["length"] = np.sqrt(signal[each, k] / signal[0, k])
                known = {key: float(value) if np.isfinite(value) else None for key, value in figures.items()}
                rows.append({"states": name, "count": int(count), "horizon": horizon, "estimate": estimate} | known)
    return rows


def table(rows: list[dict[str, Any]]) -> str:
    """Return the samples that each estimate needs as a table; in brackets cosine and length of the derivatives."""
    lines = ["| states | control steps | " + " | ".join(ESTIMATES) + " |", "|---" * (2 + len(ESTIMATES)) + "|"]
    for row, *others in zip(*[iter(rows)] * len(ESTIMATES), strict=True):
        cells = [_number(row["needed"])]
        cells += [
            " ".join([_number(each["needed"]), f"({_number(each['cosine'])}, {_number(each['length'])})"])
            for each in others
        ]
        lines.append(f"| {row['states']} ({row['count']}) | {row['horizon']} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def trained(seconds: float) -> Policy:
    """Return a policy that PPO has trained under random friction for so many seconds of processor time."""
    params, key = RANDOM.params(), jax.random.key(0)
    learner = ppo.start(key, params)
    ppo.update(learner, key, params)  # compiles
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        key, update_key = jax.random.split(key)
        learner, _ = jax.block_until_ready(ppo.update(learner, update_key, params))
    return learner.policy


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=65536)
    parser.add_argument("--seconds", type=float, default=25.0, help="processor time of the policy's training by PPO")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    record = {}
    for name, policy in (("untrained", Policy(jax.random.key(1))), ("trained", trained(arguments.seconds))):
        record[name] = compare(policy, jax.random.key(2), RANDOM.params(), arguments.samples)
        print(f"{name} policy\n{table(record[name])}", flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(record))


if __name__ == "__main__":
    main()
