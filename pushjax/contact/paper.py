"""The algorithms of Zhou et al. 2017 ("the paper"): `HessianIteration` for a sticking contact, `Projected` for several.

The defaults, `ScalarRoot` and `Exhaustive`, are faster or prove more. These two show what the paper does, and the tests
compare their answers with those of the defaults.

`Projected` is a sequence of projected problems. Each round linearizes grad H at the last wrench: grad H(F) = A F + c
(the Josephy-Newton method). Zhou et al. drop the constant c and damp, which converges linearly. Then the round sweeps
over the contacts: projected Gauss-Seidel on normal and tangential force in turn. The result of the sweeps only has to
show which cone edges carry the force. The systems of the edges with the largest forces are then solved exactly, as in
`exhaustive`, and checked against every condition. With many contacts this is less work than trying all sets of edges.
But finding no solution proves nothing: the status is then NOT_CONVERGED, also in a jam.

Reference: Zhou et al. 2017, section IV. Deviations: the damping, the line search and the rescaling of
`HessianIteration`; the constant term, the solver of the linear problems and the exact solution of the sets found.
"""

from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pushjax._internal.xla import compute_once
from pushjax._math.arrays import times
from pushjax._math.sums import summed
from pushjax._math.vec import Scalar, Vec2
from pushjax.contact.contact_plane import LimitCurve, by_normal, by_tangential
from pushjax.contact.edge_sets import Sets
from pushjax.contact.exhaustive import best_of_sets
from pushjax.contact.scaled_problem import ContactSolver, Found, ScaledProblem
from pushjax.contact.sticking import StickingSolver


class HessianIteration(StickingSolver):
    """The paper's iteration, reduced to the contact plane and damped so that it becomes Newton's method.

    The paper iterates F <- A_t^-1 D^-1 V_p with A_t = hess H(F_t), where V_p is the push and D the paper's 3 x 3
    matrix. With a sticking contact F stays in the plane F = J'f (J as in `contact_plane`), and A_t and D reduce to the
    2 x 2 Hessian J hess H J' of the limit curve's h. By Euler's identity the paper's step, damped by 1/(d - 1), is
    Newton's step on grad h(f) = v / (d - 1). It converges quadratically. The paper halves its step instead, which only
    halves the error in each iteration. Without damping the iteration diverges for d = 4.

    A line search makes the step safe. Each iteration ends with the best multiple of f (closed form by homogeneity),
    which makes the number of iterations independent of the scale of H.

    Attributes:
        max_rounds: Largest number of iterations.

    Reference: Zhou et al. 2017, section IV.A, corollary 1.
    """

    max_rounds: int = eqx.field(static=True, default=25)

    def iterate(self, curve: LimitCurve, v: Vec2, friction: Scalar) -> Scalar:
        f, _, _ = self.trace(curve, v)
        # where f_n <= 0 the contact does not stick, and any finite ratio will do
        forward = f.x > 0
        return jnp.where(forward, f.y / jnp.where(forward, f.x, 1.0), friction)

    def trace(self, curve: LimitCurve, v: Vec2) -> tuple[Vec2, Int[Array, ""], Scalar]:
        """Return the force (f_n, f_t) whose motion is along v, the iterations, and |sin| between motion and v."""
        # A friction cone does not limit the force.
        size = jnp.sqrt(v.dot(v))
        direction = v.scale(1 / jnp.where(size > 0, size, 1.0))
        # a sine that can be reached even for ill-conditioned limit surfaces: 3e-13 in float64, 3e-6 in float32
        tolerance = float(jnp.finfo(size.dtype).eps) ** 0.8

        def sine_of_angle(f: Vec2) -> Scalar:
            motion = _gradient(curve, f)
            scale = jnp.sqrt(motion.dot(motion))
            return jnp.abs(motion.cross(direction)) / jnp.where(scale > 0, scale, 1.0)

        def iterate(state):
            f, _, iterations = state
            # `compute_once`, so that the angle is that of the force that is kept
            next_force = compute_once(hessian_round(curve, direction, f), direction.x)
            return next_force, sine_of_angle(next_force), iterations + 1

        start_force = _rescaled(curve, direction, direction)
        state = (start_force, sine_of_angle(start_force), jnp.zeros((), jnp.int32))
        f, residual, iterations = jax.lax.while_loop(
            lambda state: (state[1] > tolerance) & (state[2] < self.max_rounds), iterate, state
        )
        return f, iterations, residual


def hessian_round(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """One iteration of `HessianIteration`.

    Args:
        curve: Limit curve of the contact.
        v: Displacement (n, t) of the pusher.
        f: The force (f_n, f_t) before the iteration.

    Returns:
        The force after it.
    """
    by_n, by_t = by_normal(curve.c), by_tangential(curve.c)
    h_nn, h_nt, h_tt = (_value(c, f) for c in (by_normal(by_n), by_tangential(by_n), by_tangential(by_t)))
    residual = v - _gradient(curve, f)
    det = h_nn * h_tt - h_nt * h_nt
    singular = det <= 0
    inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
    step = compute_once(
        Vec2(h_tt * residual.x - h_nt * residual.y, h_nn * residual.y - h_nt * residual.x).scale(inverse), v.x
    )
    # v - grad h is minus the gradient of the convex function h(f) - v . f. The line search tries the step and its
    # halvings down to 1/512, and takes the one where the slope of this function along the step is nearest to zero. It
    # compares slopes because near the solution the differences of the function itself are lost in roundoff.
    halvings = jnp.asarray([0.5**k for k in range(10)], det.dtype)
    slopes = jnp.abs((_gradient(curve, f + step.scale(halvings)) - v).dot(step))
    return _rescaled(curve, v, compute_once(f + step.scale(halvings[jnp.argmin(slopes)]), v.x))


def _rescaled(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """The multiple of f at which h(f) - v . f is lowest."""
    d = curve.degree
    power, h = jnp.maximum(v.dot(f), 0), d * _value(curve.c, f)
    return f.scale((power / jnp.where(h > 0, h, 1.0)) ** (1 / (d - 1)))


def _value(c: Sequence[Scalar], f: Vec2) -> Scalar:
    """The value at f of the form with coefficients c."""
    d = len(c) - 1
    return sum((each * f.x ** (d - k) * f.y**k for k, each in enumerate(c)), jnp.zeros_like(f.x))


def _gradient(curve: LimitCurve, f: Vec2) -> Vec2:
    """grad h at f."""
    return Vec2(_value(by_normal(curve.c), f), _value(by_tangential(curve.c), f))


class Projected(ContactSolver):
    """Projected Gauss-Seidel on successive linearizations of grad H, finished exactly.

    Attributes:
        rounds: Number of rounds. Each linearizes once.
        sweeps: Number of sweeps over the contacts in each round.
    """

    rounds: int = eqx.field(static=True, default=8)
    sweeps: int = eqx.field(static=True, default=20)
    proves_jams: ClassVar[bool] = False

    def search(self, problem: ScaledProblem) -> Found:
        return best_of_sets(problem, *_heaviest_sets(problem, self._forces(problem)))

    def _forces(self, problem: ScaledProblem) -> Float[Array, "2 contacts batch"]:
        """Contact forces (n, t) in the scale in which the twist is grad H, by all rounds."""
        start = jnp.where(problem.active & (problem.goal[0] > 0), problem.goal[0], 0.0)

        def iterate(_, forces: Array) -> Array:
            wrench = summed(problem.normal * forces[:1] + problem.tangent * forces[1:], 1)
            nonzero = summed(wrench * wrench, 0) > 0
            along_x = jnp.zeros_like(wrench).at[0].set(1)
            return self._sweep(problem, jnp.where(nonzero[None], wrench, along_x), forces)

        return jax.lax.fori_loop(0, self.rounds, iterate, jnp.stack([start, jnp.zeros_like(start)]))

    def _sweep(self, problem: ScaledProblem, wrench: Array, forces: Array) -> Array:
        """All projected Gauss-Seidel sweeps of one round, with grad H linearized at a wrench."""
        surface, m = problem.surface, problem.count
        rows = jnp.stack([problem.normal, problem.tangent], axis=1)  # (3, (n, t), contacts, batch)
        moved = times(surface.hessian(wrench)[:, :, None, None], rows)
        compliance = summed(rows * moved, 0)  # how far a unit force moves its own contact point
        per_motion = jnp.where(compliance > 0, 1 / jnp.where(compliance > 0, compliance, 1.0), 0.0)
        # c = grad H - hess H F, and hess H F = (d - 1) grad H by Euler's identity
        constant = surface.gradient(wrench) * (2 - surface.degree)

        def sweep(_, state: tuple[Array, Array]) -> tuple[Array, Array]:
            return jax.lax.fori_loop(0, m, update, state)

        def update(i: Int[Array, ""], state: tuple[Array, Array]) -> tuple[Array, Array]:
            forces, twist = state
            (row, along), goal, scale = ((x[:, :, i] for x in (rows, moved)), problem.goal[:, i], per_motion[:, i])
            normal = forces[0, i] - scale[0] * (summed(row[:, 0] * twist, 0) - goal[0])
            normal = jnp.where(problem.active[i], jnp.maximum(normal, 0), 0.0)
            twist = twist + along[:, 0] * (normal - forces[0, i])[None]
            tangential = forces[1, i] - scale[1] * (summed(row[:, 1] * twist, 0) - goal[1])
            bound = problem.friction[i] * normal
            tangential = jnp.clip(tangential, -bound, bound)
            twist = twist + along[:, 1] * (tangential - forces[1, i])[None]
            return forces.at[:, i].set(jnp.stack([normal, tangential])), twist

        twist = constant + summed(moved * forces[None], (1, 2))
        return jax.lax.fori_loop(0, self.sweeps, sweep, (forces, twist))[0]


def _heaviest_sets(problem: ScaledProblem, forces: Array) -> tuple[Sets, Sets, Int[Array, "3 sets batch"]]:
    """The sets of the edges that carry the most force: one of one edge, two of two, and contacts of two of three."""
    mu = problem.friction
    # without friction both edges are the normal, and the left one gets the whole force
    tangential = jnp.where(mu > 0, forces[1] / jnp.where(mu > 0, mu, 1.0), forces[0])
    left, right = jnp.maximum((forces[0] + tangential) / 2, 0), jnp.maximum((forces[0] - tangential) / 2, 0)
    weights = jnp.stack([left, right], axis=1).reshape(-1, *mu.shape[1:])
    heaviest = jax.lax.top_k(weights.T, 2)[1].T
    sticking = jnp.argmax(jnp.minimum(left, right), axis=0).astype(jnp.int32)
    pairs = jnp.stack([jnp.sort(heaviest, axis=0), jnp.stack([2 * sticking, 2 * sticking + 1])], axis=1)
    of_contact, is_sticking = left + right, jnp.arange(problem.count)[:, None] == sticking[None]
    other = jnp.argmax(jnp.where(is_sticking, -1.0, of_contact), axis=0).astype(jnp.int32)
    triples = [jnp.stack([sticking, sticking, other])]
    if problem.count > 2:
        triples.append(jax.lax.top_k(of_contact.T, 3)[1].T)
    three = jnp.stack(triples, axis=1)[:, : problem.count - 1]  # one contact has none
    return Sets.of(heaviest[:1, None]), Sets.of(pairs), three
