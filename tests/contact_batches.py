"""Batches of random contact problems, drawn by one compiled program for each degree, whatever their options."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from pushjax.problems import ContactsProblem, random_contacts_problem

# Compiling a program takes longer than any of them runs: so one size of batch everywhere.
BATCH = 2000
MOST = 8


@functools.cache
def problems(
    contacts: int, degree: int = 4, seed: int = 0, slots: int | None = None, condition: float = 1e3, gaps: float = 0.5
) -> ContactsProblem:
    """`BATCH` problems of so many contacts each; slots beyond these hold what does not count, anywhere among them
    where they are all eight, else at the end."""
    keys = jax.random.split(jax.random.key(seed), BATCH)
    surface, drawn = _program(degree)(keys, jnp.asarray(contacts), jnp.asarray(condition), jnp.asarray(gaps))
    if slots == MOST:
        return ContactsProblem(surface, drawn)
    order = jnp.argsort(~drawn.active, axis=1, stable=True)[:, : slots or contacts]
    row = np.arange(BATCH)[:, None]
    return ContactsProblem(surface, jax.tree.map(lambda leaf: leaf[row, order], drawn))


@functools.cache
def _program(degree: int):
    def draw(key, contacts, condition, gaps):
        return random_contacts_problem(
            key, contacts=contacts, degree=degree, slots=MOST, condition=condition, gaps=gaps
        )

    return jax.jit(jax.vmap(draw, in_axes=(0, None, None, None)))


def first(tree, count: int):
    return jax.tree.map(lambda leaf: leaf[:count], tree)
