"""The BFGS method for a few dozen parameters, with NumPy or with JAX.

With NumPy nothing is compiled, which takes longer than the minimization. With JAX the method is part of a program, also
of a batch.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

ARMIJO = 0.1  # share of the decrease along the tangent that a step must give


class Minimum(NamedTuple):
    """Result of a minimization.

    Attributes:
        x: The parameters, (n,).
        steps: Number of evaluations of the objective.
        converged: Whether the last step changed parameters and value by less than the tolerance.
    """

    x: Any
    steps: Any
    converged: Any


class _State(NamedTuple):
    x: Any
    value: Any
    gradient: Any
    inverse: Any  # approximation of the inverse Hessian
    size: Any  # of the next step along -inverse @ gradient
    steps: Any
    converged: Any


def while_loop(xp: Any, condition: Callable[[Any], Any], body: Callable[[Any], Any], state: Any) -> Any:
    """Repeat `body` while `condition` holds, with NumPy (`xp` is numpy) or as `jax.lax.while_loop`."""
    if xp is not np:
        return jax.lax.while_loop(condition, body, state)
    while condition(state):
        state = body(state)
    return state


def minimize(xp: Any, objective: Callable[[Any], tuple[Any, Any]], start: Any, tolerance: float, max_steps: int):
    """Minimize an objective. A step is halved until it meets the condition of Armijo.

    Args:
        xp: numpy or jax.numpy.
        objective: Function from the parameters (n,) to the value and its gradient (n,).
        start: Parameters at the start, (n,).
        tolerance: The search ends when a step changes every parameter and the value by less than this, absolutely and
            relatively together.
        max_steps: Largest number of evaluations.

    Returns:
        The minimum, a `Minimum`.
    """
    dtype = start.dtype
    eps = xp.finfo(dtype).eps

    def is_small(change: Any, at: Any) -> Any:
        return xp.max(xp.abs(change) / (tolerance + tolerance * xp.abs(at))) < 1

    def step(state: _State) -> _State:
        trial = state.x - state.size * (state.inverse @ state.gradient)
        value, gradient = objective(trial)
        moved, bend, change = trial - state.x, gradient - state.gradient, value - state.value
        predicted = state.gradient @ moved
        accepted = (change <= ARMIJO * predicted) & (predicted <= 0)
        # the update keeps the matrix positive definite where the curvature along the step is positive
        curvature = bend @ moved
        updates = accepted & (curvature > eps)
        safe = xp.where(updates, curvature, 1)
        turned = state.inverse @ bend
        cross = xp.outer(turned, moved)
        stretch = (safe + bend @ turned) / safe**2
        update = stretch * xp.outer(moved, moved) - (cross + cross.T) / safe
        return _State(
            x=xp.where(accepted, trial, state.x),
            value=xp.where(accepted, value, state.value),
            gradient=xp.where(accepted, gradient, state.gradient),
            inverse=xp.where(updates, state.inverse + update, state.inverse),
            size=xp.where(accepted, xp.ones((), dtype), state.size / 2),
            steps=state.steps + 1,
            converged=accepted & is_small(moved, trial) & is_small(change, value),
        )

    one = xp.ones((), dtype)
    first = _State(
        start, *objective(start), xp.eye(len(start), dtype=dtype), one, xp.ones((), xp.int32), xp.zeros((), bool)
    )
    last = while_loop(xp, lambda state: ~state.converged & (state.steps < max_steps), step, first)
    return Minimum(last.x, last.steps, last.converged)
