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

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from pushjax._internal.xla import compute_once
from pushjax._math.arrays import times
from pushjax._math.sums import summed
from pushjax._math.vec import Scalar, Vec2
from pushjax.contact.contact_plane import LimitCurve
from pushjax.contact.edge_sets import Sets
from pushjax.contact.exhaustive import best_of_sets
from pushjax.contact.scaled_problem import ContactSolver, Found, ScaledProblem
from pushjax.contact.sticking import StickingSolver


def finest_tolerance(dtype) -> float:
    """Sine of the angle at which `HessianIteration` stops: 3e-13 in float64, 3e-6 in float32."""
    # It can be reached even for ill-conditioned limit surfaces.
    return float(jnp.finfo(dtype).eps) ** 0.8


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
        tolerance: Sine of the angle between motion and push at which the iteration stops; None for `finest_tolerance`.

    Reference: Zhou et al. 2017, section IV.A, corollary 1.
    """

    max_rounds: int = eqx.field(static=True, default=25)
    tolerance: float | None = eqx.field(static=True, default=None)

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
        tolerance = finest_tolerance(size.dtype) if self.tolerance is None else self.tolerance

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
    gradient = _gradient(curve, f)
    h_nn, h_nt, h_tt = _hessian(curve, f)
    residual = v - gradient
    det = h_nn * h_tt - h_nt * h_nt
    singular = det <= 0
    inverse = jnp.where(singular, 0.0, 1.0 / jnp.where(singular, 1.0, det))
    step = compute_once(
        Vec2(h_tt * residual.x - h_nt * residual.y, h_nn * residual.y - h_nt * residual.x).scale(inverse), v.x
    )
    # v - grad h is minus the gradient of the convex function h(f) - v . f. The line search tries the step and its
    # halvings down to 1/512, and takes the one where the slope of this function along the step is nearest to zero. It
    # compares slopes because near the solution the differences of the function itself are lost in roundoff.
    halvings = [0.5**k for k in range(10)]
    slopes = [jnp.abs((_gradient(curve, f + step.scale(t)) - v).dot(step)) for t in halvings]
    best, lowest = halvings[0] * jnp.ones_like(det), slopes[0]
    for t, slope in zip(halvings[1:], slopes[1:], strict=True):
        best = jnp.where(slope < lowest, t, best)
        lowest = jnp.minimum(lowest, slope)
    return _rescaled(curve, v, compute_once(f + step.scale(best), v.x))


def _rescaled(curve: LimitCurve, v: Vec2, f: Vec2) -> Vec2:
    """The multiple of f at which h(f) - v . f is lowest."""
    d = curve.degree
    power, h = jnp.maximum(v.dot(f), 0), d * _value(curve, f)
    return f.scale((power / jnp.where(h > 0, h, 1.0)) ** (1 / (d - 1)))


def _powers(f: Vec2, degree: int) -> tuple[list, list]:
    """Powers 0 to `degree` of each component."""
    one = jnp.ones_like(f.x)
    xs, ys = [one], [one]
    for _ in range(degree):
        xs.append(xs[-1] * f.x)
        ys.append(ys[-1] * f.y)
    return xs, ys


def _value(curve: LimitCurve, f: Vec2) -> Scalar:
    """h(f)."""
    d = curve.degree
    xs, ys = _powers(f, d)
    return sum((c * xs[d - k] * ys[k] for k, c in enumerate(curve.c)), jnp.zeros_like(f.x))


def _gradient(curve: LimitCurve, f: Vec2) -> Vec2:
    """grad h at f."""
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    return Vec2(
        sum(((d - k) * c * xs[d - k - 1] * ys[k] for k, c in enumerate(curve.c) if k < d), zero),
        sum((k * c * xs[d - k] * ys[k - 1] for k, c in enumerate(curve.c) if k > 0), zero),
    )


def _hessian(curve: LimitCurve, f: Vec2) -> tuple[Scalar, Scalar, Scalar]:
    """Second derivatives (nn, nt, tt) of h at f."""
    d = curve.degree
    xs, ys = _powers(f, d)
    zero = jnp.zeros_like(f.x)
    terms = list(enumerate(curve.c))
    return (
        sum(((d - k) * (d - k - 1) * c * xs[d - k - 2] * ys[k] for k, c in terms if k < d - 1), zero),
        sum((k * (d - k) * c * xs[d - k - 1] * ys[k - 1] for k, c in terms if 0 < k < d), zero),
        sum((k * (k - 1) * c * xs[d - k] * ys[k - 2] for k, c in terms if k > 1), zero),
    )


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
        """Find the cone edges that carry the force.

        Args:
            problem: Dimensionless contact problems, with an axis for the batch.

        Returns:
            The best set of cone edges of each problem.
        """
        return best_of_sets(problem, *_heaviest_sets(problem, self.iterate(problem)))

    def iterate(self, problem: ScaledProblem) -> Float[Array, "2 contacts batch"]:
        """Compute contact forces (n, t) in the scale in which the twist is grad H, by all rounds.

        Args:
            problem: Dimensionless contact problems, with an axis for the batch.

        Returns:
            The forces of all contacts.
        """
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
    edge1 = _heaviest(weights, ())
    edge2 = _heaviest(weights, (edge1,))
    sticking = _heaviest(jnp.minimum(left, right), ())
    pairs = [
        jnp.stack([jnp.minimum(edge1, edge2), jnp.maximum(edge1, edge2)]),
        jnp.stack([2 * sticking, 2 * sticking + 1]),
    ]
    triples = []
    if problem.count > 1:
        triples.append(jnp.stack([sticking, sticking, _heaviest(left + right, (sticking,))]))
    if problem.count > 2:
        contacts: tuple[Array, ...] = ()
        for _ in range(3):
            contacts += (_heaviest(left + right, contacts),)
        triples.append(jnp.stack(contacts))
    three = jnp.stack(triples, axis=1) if triples else jnp.zeros((3, 0, *edge1.shape), jnp.int32)
    return Sets.of(edge1[None, None]), Sets.of(jnp.stack(pairs, axis=1)), three


def _heaviest(weights: Float[Array, "n batch"], excluded: tuple[Int[Array, " batch"], ...]) -> Int[Array, " batch"]:
    """Index of the largest weight, the indices in `excluded` left out."""
    numbers = jnp.arange(len(weights), dtype=jnp.int32)[:, None]
    for index in excluded:
        weights = jnp.where(numbers == index[None], -1.0, weights)
    return jnp.argmax(weights, axis=0).astype(jnp.int32)
