"""The motion as a function that JAX can differentiate, near a solution that is known.

What was found and decided is constant: the cone edges that carry the force, and who is loaded. The weights solve
R grad H(F) = b, where F is a combination of the edges (`finish`). Their derivatives follow from one linear system, by
the implicit function theorem, whatever found the solution. The unknowns are the components of F along orthonormal axes
of the edges, because edges that press against each other are nearly dependent.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._math.arrays import combined, dot, products
from pushjax._math.sums import repeated, summed
from pushjax.contact.finish import Answer, Equations, Solution, in_units
from pushjax.contact.force_distribution import of_chosen, shared_weights
from pushjax.contact.scaled_problem import ScaledProblem
from pushjax.contact.status import Status


def differentiable_solution(problem: ScaledProblem, answer: Answer) -> Solution:
    """The solution whose cone edges and twist are known; its values are right to roundoff."""
    best, solved, indeterminate = answer.best, answer.status == Status.MOVING, answer.indeterminate
    equations, _, basis = Equations.of(problem, best, solved)
    fixed, constant, basis = jax.lax.stop_gradient((problem, equations, basis))
    into_edges = jnp.where(constant.used[:, None], summed(basis[:, None] * constant.axes[None], 2), 0.0)  # (edge, axis)
    axes = summed(repeated(equations.edges, 1, 3) * into_edges[:, :, None], 0)
    # the wrench of the size at which grad H is the twist
    wrench = combined(constant.edges, best.weight)
    motion, length = fixed.surface.gradient(wrench), jnp.ones_like(fixed.length)
    squared = dot(motion, motion)
    along = dot(motion, answer.solution.twist * jnp.stack([length, length, fixed.length])) / fixed.unit
    factor = jnp.where(solved & (along > 0) & (squared > 0), along / jnp.where(squared > 0, squared, 1.0), 1.0)
    if problem.surface.degree == 4:
        factor = jnp.cbrt(factor)
    beta = _implicit(equations._replace(axes=axes), products(constant.axes, wrench) * factor[None])
    placeholder = jnp.zeros_like(beta).at[0].set(1)
    wrench = jnp.where(solved[None], combined(axes, beta), placeholder)
    own = of_chosen(problem.edges, best.edges, summed(into_edges * repeated(beta, 0, 3), 1))
    shared = shared_weights(problem.edges, answer.loaded & indeterminate[None], wrench, answer.dual)
    weights = jnp.where(indeterminate[None], shared, own)
    return in_units(problem, solved, problem.surface.gradient(wrench), wrench, weights)


@eqx.filter_custom_jvp
def _implicit(equations: Equations, beta: Float[Array, "3 *batch"]) -> Float[Array, "3 *batch"]:
    """The solution `beta` of the equations, with its derivatives by the implicit function theorem."""
    return beta


@_implicit.def_jvp
def _implicit_jvp(primals, tangents):
    equations, beta = primals
    beta = _implicit(equations, beta)
    # Equinox gives None as the tangent of what is not perturbed.
    changes = jax.tree.map(
        lambda d, x: jnp.zeros_like(x) if d is None and eqx.is_inexact_array(x) else d,
        tangents[0],
        equations,
        is_leaf=lambda d: d is None,
    )
    (hessian, _, _), (_, _, change) = eqx.filter_jvp(lambda e: e.evaluate(beta), (equations,), (changes,))
    return beta, equations.newton_step(hessian, change)
