"""Contact problems for tests: random batches, sampled by one compiled program for each degree, and a square."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.testing.problems import ContactsProblem, random_contacts_problem

# Compiling a program takes longer than any of them runs, so all batches have the same size.
BATCH = 2000
MOST = 8


@functools.cache
def problems(
    contacts: int, degree: int = 4, seed: int = 0, slots: int | None = None, condition: float = 1e3, gaps: float = 0.5
) -> ContactsProblem:
    """Return `BATCH` problems with this number of contacts, and padding in the other slots.

    With all eight slots, the padding is anywhere among the contacts; with fewer, it is at the end.
    """
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


def flat_push(displacement=((0.001, 0.0), (0.001, 0.0))) -> pj.Contacts:
    """Two points flat against the left side of a square, 40 mm apart."""
    point = jnp.array([[-0.045, 0.02], [-0.045, -0.02]])
    return pj.Contacts(point, jnp.array([[1.0, 0.0], [1.0, 0.0]]), jnp.asarray(displacement), 0.5)


@functools.cache
def square(degree: int) -> pj.LimitSurface:
    """Return the limit surface of that square under uniform pressure."""
    support = pj.Support.uniform(pj.Polygon.rectangle(0.09, 0.09), points=64)
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(1), 300), degree=degree)
