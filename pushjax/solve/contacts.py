"""The contact problem as a user states it, in arrays."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._checks import Numeric, as_float, common_dtype, concrete, finite, non_negative, shaped
from pushjax._programs import quickly_compiled
from pushjax._vec import Vec2, Vec3, entries
from pushjax.limit_surface import Form, LimitSurface
from pushjax.solve._contact_plane import Contact, LimitCurve
from pushjax.solve._several import ContactSolver, SeveralMotion, assemble
from pushjax.solve.exhaustive import Exhaustive
from pushjax.solve.single import solve_single
from pushjax.solve.single_first import single_first
from pushjax.solve.sticking import ScalarRoot, StickingSolver

MAX_CONTACTS = 8
UNIT_TOLERANCE = 1e-5  # of a normal's length: a hundred roundings of float32


class Contacts(eqx.Module):
    """Contacts between a hand and a slider, in the slider's body frame.

    point, normal, displacement: (contacts, 2), m; `normal` is of unit length and points into the slider; `displacement`
    is that of the pusher's material point over the step. friction: mu, (contacts,) or one for all. gap: m still to
    close along the normal, negative in penetration. active: False for a contact that is only padding, whose other
    entries may be anything.

    Raises ValueError for arrays that do not match, are not finite, a normal not of unit length or negative friction.
    """

    point: Float[Array, "contacts 2"]
    normal: Float[Array, "contacts 2"]
    displacement: Float[Array, "contacts 2"]
    friction: Float[Array, "contacts"]
    gap: Float[Array, "contacts"]
    active: Bool[Array, "contacts"]

    def __init__(
        self,
        point: Numeric,
        normal: Numeric,
        displacement: Numeric,
        friction: Numeric,
        gap: Numeric = 0.0,
        active: Numeric = True,
    ):
        dtype = common_dtype(point, normal, displacement, friction, gap)
        self.point = as_float(point, dtype)
        shaped("point", self.point, ("contacts", 2))
        m = self.point.shape[0]
        self.normal, self.displacement = as_float(normal, dtype), as_float(displacement, dtype)
        shaped("normal", self.normal, (m, 2))
        shaped("displacement", self.displacement, (m, 2))
        self.friction = _each("friction", as_float(friction, dtype), m)
        self.gap = _each("gap", as_float(gap, dtype), m)
        self.active = _each("active", jnp.asarray(active, bool), m)
        counts = concrete(self.active)
        # padding may hold anything; where it is not known which contacts are, all are checked
        used = slice(None) if counts is None or counts.all() else np.flatnonzero(counts)
        for name in ("point", "normal", "displacement", "friction", "gap"):
            finite(name, getattr(self, name)[used])
        non_negative("friction", self.friction[used])
        known = concrete(self.normal)
        if known is not None and np.any(np.abs(np.linalg.norm(known[used], axis=1) - 1) > UNIT_TOLERANCE):
            raise ValueError(f"normal must have unit length; got lengths {np.linalg.norm(known, axis=1).tolist()}")


def _each(name: str, value: Array, contacts: int) -> Array:
    if value.ndim and value.shape != (contacts,):
        raise ValueError(f"{name} has shape {value.shape}; expected a scalar or ({contacts},), one per contact")
    return jnp.broadcast_to(value, (contacts,))


class Motion(eqx.Module):
    """The answer to a contact problem.

    twist: (3,), of the slider over the step (m, m, rad), zero where it does not move. wrench: (3,), N and N m, on
    H = 1, zero where it does not move. force: (contacts, 2), N, along normal and tangent t = (-n_y, n_x), summing to
    the wrench; where several distributions do, the one of evenly soft fingers (`pushjax.solve.share`). mode:
    (contacts,) of `ContactMode`; a contact that touches has the mode of its slip, also where its force is zero.

    status: `Status`. MOVING: every condition holds to 1e-9 of the fastest pusher and the forces' sum (1e-4 in float32),
    or where the slider is some ten thousand times as fast, to what rounding leaves of that (1e-8 at most). FREE:
    nothing would be violated if the slider stayed. JAMMED: no twist satisfies every contact. NOT_CONVERGED: none was
    found, which proves nothing; such is, in float32, a slider that squirts out of a wedge more than some 800 times as
    fast as its pushers, because the digits to write that down to 1e-4 are missing.

    margin: m, minus the hand's squeeze power: the most work, per unit of normal force, that the fingers do in a step on
    forces that cancel through the slider. A positive margin guarantees a motion, and is how far the fingers may still
    close on each other; where JAMMED it is negative, and its size is how far they would have to open. Infinite where
    no forces can cancel, as with one contact. Seldom is it negative where there is a motion: a jam is possible too.
    unique: False where another twist satisfies every condition too, of those that the solver tries: `Exhaustive` all.
    """

    twist: Float[Array, "3"]
    wrench: Float[Array, "3"]
    force: Float[Array, "contacts 2"]
    mode: Int[Array, "contacts"]
    status: Int[Array, ""]
    margin: Float[Array, ""]
    unique: Bool[Array, ""]


def solve_contacts(
    surface: LimitSurface, contacts: Contacts, *, solver: ContactSolver | StickingSolver | None = None
) -> Motion:
    """The slider's motion under given pusher displacements: Coulomb friction at each contact, the limit surface below.

    Finds the twist V and forces f with V = k grad H(sum J'f), k > 0, and, with the relative motion w = J V -
    displacement at each contact,

        0 <= f_n  _|_  w_n + gap >= 0,   |f_t| <= mu f_n,   f_t = +mu f_n where w_t < 0,  -mu f_n where w_t > 0.

    Of several solutions, the one with the largest power on H = 1, then with the smallest twist in the length metric;
    but where the slider may stay, it does. None of it depends on the order of the contacts, the frame or a mirror.

    Differentiable, forward and reverse, in everything but `active`, within the contact modes of the solution; while a
    contact sticks, the derivative of the motion by its friction is zero. Where forces are indeterminate their
    derivatives are those of changes that keep them so: by one of two frictions of a flat push, say, there is none. The
    margin is a maximum, with kinks.

    solver: default `ScalarRoot()` for one contact (also for one: `HessianIteration()`), `Exhaustive()` for more.

    Raises ValueError for no contact, more than eight, or more than one for a solver of one. Traced values that are not
    finite, or a negative friction, give `Status.INVALID` and no motion.

    Source: Zhou et al. 2017, sections IV.A and IV.B; the gap is that of Stewart & Trinkle 1996.

    >>> import numpy as np, pushjax as pj
    >>> surface = pj.Ellipsoid(np.eye(3), length=0.03)
    >>> contacts = pj.Contacts([(0.02, -0.04)], [(0.0, 1.0)], displacement=[(0.0, 0.001)], friction=0.25)
    >>> motion = solve_contacts(surface, contacts)
    >>> print(pj.ContactMode(int(motion.mode[0])).name, (1e3 * np.asarray(motion.twist)).round(1))
    SLIDING_LEFT [-0.2  0.8  9.1]
    """
    _countable(contacts.point.shape[0])
    return _solved(surface, contacts, solver)


def _countable(contacts: int) -> None:
    if not 1 <= contacts <= MAX_CONTACTS:
        raise ValueError(f"contacts: from one to {MAX_CONTACTS} are supported; got {contacts}")


@quickly_compiled
def _solved(surface: LimitSurface, contacts: Contacts, solver: ContactSolver | StickingSolver | None) -> Motion:
    form, friction = ground(surface, contacts.friction)
    each = _in_scalars(contacts, friction)
    result = motion_under(form, each, entries(contacts.active), solver, margin=True)
    wrench = Vec3(result.wrench.x, result.wrench.y, result.wrench.z * form.length)
    return Motion(
        twist=result.twist.array(),
        wrench=wrench.array(),
        force=jnp.stack([f.array() for f in result.force]),
        mode=jnp.stack(result.mode),
        status=result.status,
        margin=result.margin,
        unique=result.unique,
    )


def motion_under(
    form: Form,
    contacts: tuple[Contact, ...],
    active: tuple[Bool[Array, ""], ...],
    solver: ContactSolver | StickingSolver | None,
    *,
    margin: bool,
) -> SeveralMotion:
    """`solve_contacts` in scalars. One that is not active must be out of reach (`_in_scalars`). margin: whether it is
    asked for; else it is infinite wherever there is a motion, and takes no time, and several contacts are by default
    solved one first."""
    _countable(len(contacts))  # a hand's too
    if solver is None:
        if len(contacts) > 1 and not margin:
            return single_first(form, contacts, active)
        solver = ScalarRoot() if len(contacts) == 1 else Exhaustive()
    if not isinstance(solver, StickingSolver):
        return solver.solve(assemble(form, contacts, active, margin=margin))
    if len(contacts) != 1:
        raise ValueError(f"solver: {type(solver).__name__} solves one contact; got {len(contacts)}")
    one = solve_single(form, contacts[0], solver)
    far = jnp.full_like(one.twist.x, jnp.inf)
    return SeveralMotion(one.twist, one.wrench, (one.force,), (one.mode,), one.status, far, one.unique)


def ground(surface: LimitSurface, friction: Array) -> tuple[Form, Array]:
    """The surface in scalars, and the contacts' friction. A surface whose numbers cannot be computed with is replaced
    by one of ones, which keeps NaN out, and the friction by NaN, which makes every contact invalid."""
    form = surface.form()
    known = jnp.isfinite(sum(jax.tree.leaves(form))) & (form.length > 0)
    return jax.tree.map(lambda entry: jnp.where(known, entry, 1.0), form), jnp.where(known, friction, jnp.nan)


def _in_scalars(contacts: Contacts, friction: Array) -> tuple[Contact, ...]:
    """Each contact; one that is not active is out of reach, whatever its numbers are."""
    rows = (contacts.point, contacts.normal, contacts.displacement)
    found = []
    for point, normal, displacement, mu, gap, active in zip(
        *(entries(row) for row in (*rows, friction, contacts.gap, contacts.active)), strict=True
    ):
        n = Vec2.of(normal)
        unit = jnp.abs(n.dot(n) - 1) <= 2 * UNIT_TOLERANCE  # where traced, nothing has checked it yet
        mu = jnp.where(unit, mu, jnp.nan)
        found.append(Contact(Vec2.of(point), n, Vec2.of(displacement), mu, gap).where(active))
    return tuple(found)


def friction_cone(normal: Numeric, friction: Numeric) -> Float[Array, "2 2"]:
    """Left and right edge of the friction cone about the inward `normal` (2,): unit force directions, body frame.

    Raises ValueError as `Contacts` does.
    """
    dtype = common_dtype(normal, friction)
    contact = _at_rest(jnp.zeros(2, dtype), normal, friction, dtype)
    n, mu = contact.normal, contact.friction
    edges = jnp.stack([(n + n.perp().scale(s)).array() for s in (mu, -mu)])
    return edges / jnp.sqrt(jnp.sum(edges**2, axis=1, keepdims=True))


def motion_cone(surface: LimitSurface, point: Numeric, normal: Numeric, friction: Numeric) -> Float[Array, "2 2"]:
    """Left and right edge of the motion cone: unit velocities of the contact point under the friction cone's edges.

    A pusher at body point `point` (2,) m, with inward unit normal `normal` (2,), that moves between them sticks. The
    cone may open beyond 90 degrees from the normal. Raises ValueError as `Contacts` does. Source: Mason 1986; Zhou et
    al. 2017, section IV.A.

    >>> import numpy as np, pushjax as pj
    >>> surface = pj.Ellipsoid(np.eye(3), length=0.03)
    >>> print(np.asarray(motion_cone(surface, (0.02, -0.04), (0.0, 1.0), friction=0.25)).round(3))
    [[0.157 0.988]
     [0.689 0.725]]
    """
    contact = _at_rest(point, normal, friction, common_dtype(surface, point, normal))
    curve = LimitCurve.of(surface.form(), contact)
    edges = []
    for s in (contact.friction, -contact.friction):
        g = curve.motion(s)
        g = g.scale(1 / jnp.maximum(jnp.abs(g.x), jnp.abs(g.y)))  # squares of it may underflow
        g = g.scale(1 / jnp.sqrt(g.dot(g)))
        edges.append((contact.normal.scale(g.x) + contact.normal.perp().scale(g.y)).array())
    return jnp.stack(edges)


def _at_rest(point: Numeric, normal: Numeric, friction: Numeric, dtype: Any) -> Contact:
    """One contact, checked, under a pusher that does not move."""
    p, n, mu = (as_float(value, dtype) for value in (point, normal, friction))
    shaped("point", p, (2,))
    shaped("normal", n, (2,))
    shaped("friction", mu, ())
    contacts = Contacts(p[None], n[None], jnp.zeros((1, 2), dtype), mu)
    return _in_scalars(contacts, contacts.friction)[0]
