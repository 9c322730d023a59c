"""The contact problem as a user states it, in arrays, and `solve_contacts`, which solves it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    check_shape,
    check_type,
    common_dtype,
    concrete,
)
from pushjax._internal.jit import quick_jit
from pushjax._internal.xla import entry_at
from pushjax._math.vec import Scalar, Vec2, Vec3
from pushjax.contact.contact_plane import Contact
from pushjax.contact.exhaustive import Continuing
from pushjax.contact.scaled_problem import ContactSolver, EdgeSet
from pushjax.contact.single import solve_single
from pushjax.contact.solving import solve
from pushjax.contact.sticking import ScalarRoot, StickingSolver
from pushjax.friction.limit_surface import Form, LimitSurface

MAX_CONTACTS = 8
UNIT_TOLERANCE = 1e-5  # on a normal's length: a hundred times the roundoff of float32


class Contacts(eqx.Module):
    """Contacts between a hand and a slider, in the slider's body frame.

    Attributes:
        point: Contact points, (contacts, 2), m.
        normal: Unit normals into the slider, (contacts, 2).
        displacement: Displacement of the pusher's material point over the step, (contacts, 2), m.
        friction: Coefficient of friction mu, (contacts,), or one for all.
        gap: Distance still to close along the normal, m, (contacts,), or one for all; negative in penetration.
        active: False for a contact that is only padding, (contacts,), or one for all. Other entries of such a contact
            may be anything. But where `active` is traced, entries that are not traced are checked in every contact.

    Raises:
        ValueError: If shapes do not match, a number is not finite, a normal is not of unit length or a friction is
            negative.
    """

    point: Float[Array, "contacts 2"]
    normal: Float[Array, "contacts 2"]
    displacement: Float[Array, "contacts 2"]
    friction: Float[Array, "contacts"]
    gap: Float[Array, "contacts"]
    active: Bool[Array, "contacts"]

    def __init__(
        self,
        point: ArrayLike,
        normal: ArrayLike,
        displacement: ArrayLike,
        friction: ArrayLike,
        gap: ArrayLike = 0.0,
        active: ArrayLike = True,
    ):
        dtype = common_dtype(point, normal, displacement, friction, gap)
        self.point = as_float(point, dtype, "point")
        self.normal = as_float(normal, dtype, "normal")
        self.displacement = as_float(displacement, dtype, "displacement")
        check_shape("point", self.point, ("contacts", 2))
        num_contacts = self.point.shape[0]
        check_shape("normal", self.normal, (num_contacts, 2))
        check_shape("displacement", self.displacement, (num_contacts, 2))
        self.friction = _per_contact("friction", as_float(friction, dtype, "friction"), num_contacts)
        self.gap = _per_contact("gap", as_float(gap, dtype, "gap"), num_contacts)
        self.active = _per_contact("active", jnp.asarray(active, bool), num_contacts)
        known_active = concrete(self.active)
        # padding may hold anything; if `active` is traced, all contacts are checked
        used = slice(None) if known_active is None or known_active.all() else np.flatnonzero(known_active)
        for name in ("point", "normal", "displacement", "friction", "gap"):
            check_finite(name, getattr(self, name)[used])
        check_non_negative("friction", self.friction[used])
        known_normal = concrete(self.normal)
        if known_normal is not None and np.any(np.abs(np.linalg.norm(known_normal[used], axis=1) - 1) > UNIT_TOLERANCE):
            raise ValueError(
                f"normal must have unit length; got lengths {np.linalg.norm(known_normal, axis=1).tolist()}"
            )


def _per_contact(name: str, value: Array, contacts: int) -> Array:
    """The value for each contact, given one for each or one for all."""
    if value.ndim and value.shape != (contacts,):
        raise ValueError(f"{name} has shape {value.shape}; expected a scalar or ({contacts},), one per contact")
    return jnp.broadcast_to(value, (contacts,))


class Motion(eqx.Module):
    """The answer to a contact problem.

    Attributes:
        twist: Twist of the slider over the step, (3,), body frame, m and rad. Zero where the slider does not move.
        wrench: Wrench on H = 1, (3,), body frame, N and N m. Zero where the slider does not move.
        force: Contact forces along the normal and the tangent t = (-n_y, n_x), (contacts, 2), N. They sum to the
            wrench. Where several distributions do, this is the one of evenly soft fingers
            (`pushjax.contact.force_distribution`).
        mode: `ContactMode` of each contact, (contacts,). A contact that touches has the mode of its slip, also where
            its force is zero.
        status: `Status`. MOVING: every condition holds to 1e-9 of the fastest pusher and of the sum of the forces (1e-4
            in float32). Where the slider is some ten thousand times as fast as its pushers, the conditions hold to what
            roundoff leaves of that (1e-8 at most). FREE: nothing would be violated if the slider stayed. JAMMED: no
            twist satisfies every contact. NOT_CONVERGED: no twist was found, which proves nothing. In float32, an
            example is a slider that escapes from a wedge more than some 800 times as fast as its pushers: float32 has
            too few digits to represent that to 1e-4.
        margin: Minus the hand's squeeze power, m. The squeeze power is the most work, per unit of normal force, that
            the fingers do in a step on forces that cancel through the slider. A positive margin guarantees a motion,
            and is how far the fingers may still close on each other. Where the status is JAMMED the margin is negative,
            and its size is how far the fingers would have to open. It is infinite where no forces can cancel, as with
            one contact. It is seldom negative where there is a motion. The fingers can then also press on each other
            through the slider, so a real hand may jam there.
        unique: False where another twist satisfies every condition too. Only twists that the solver tries count;
            `Exhaustive` tries all.
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
    """Find the slider's motion under given displacements of its pushers.

    Friction is Coulomb's at each contact, and that of the limit surface under the slider. J maps a twist to the motion
    of a contact point, in (n, t). The motion is the twist V, with forces f, for which V = k grad H(sum J'f), k > 0,
    and, with the relative motion w = J V - displacement at each contact,

        0 <= f_n  _|_  w_n + gap >= 0,   |f_t| <= mu f_n,   f_t = +mu f_n where w_t < 0,  -mu f_n where w_t > 0.

    Of several solutions, the one with the largest power on H = 1 is returned; of those with equal power, the one with
    the smallest twist in the length metric. But where the slider may stay, it stays. The choice does not depend on the
    order of the contacts, the frame or a mirror.

    The motion is differentiable, in forward and reverse mode, in everything but `active`, within the contact modes of
    the solution. While a contact sticks, the derivative of the motion with respect to its friction is zero. Where
    forces are indeterminate, their derivatives are those of changes that keep them indeterminate. For example, there is
    no such derivative with respect to one of the two friction coefficients of a flat push. The margin is a maximum and
    has kinks.

    Args:
        surface: The slider's limit surface.
        contacts: One to eight contacts.
        solver: The contact solver. None for `ScalarRoot()` with one contact and `Exhaustive()` with more.
            `HessianIteration()` also solves one contact.

    Returns:
        The motion, with the contact forces and the status. Traced values that are not finite, or a traced negative
        friction, give `Status.INVALID` and no motion.

    Raises:
        ValueError: For no contact, for more than eight, or for more than one with a solver of one contact.
        TypeError: For a surface, contacts or a solver of another type.

    Examples:
        >>> import numpy as np, pushjax as pj
        >>> surface = pj.Ellipsoid(np.eye(3), length=0.03)
        >>> contacts = pj.Contacts([(0.02, -0.04)], [(0.0, 1.0)], displacement=[(0.0, 0.001)], friction=0.25)
        >>> motion = solve_contacts(surface, contacts)
        >>> print(pj.ContactMode(int(motion.mode[0])).name, (1e3 * np.asarray(motion.twist)).round(1))
        SLIDING_LEFT [-0.2  0.8  9.1]

    Reference: Zhou et al. 2017, sections IV.A and IV.B; the gap is that of Stewart & Trinkle 1996.
    """
    check_type("surface", surface, LimitSurface)
    check_type("contacts", contacts, Contacts)
    check_solver(solver)
    return _solved(surface, contacts, solver)


def check_solver(solver: Any) -> None:
    """Raise TypeError unless `solver` is a solver of contact problems or None."""
    if solver is not None:
        check_type("solver", solver, ContactSolver, StickingSolver)


@quick_jit
def _solved(surface: LimitSurface, contacts: Contacts, solver: ContactSolver | StickingSolver | None) -> Motion:
    """`solve_contacts`, compiled."""
    form, friction = form_and_friction(surface, contacts.friction)
    friction = jnp.where(_is_unit(contacts.normal), friction, jnp.nan)  # `Contacts` could not check a traced normal
    result = solve_problem(form, contacts_in_columns(contacts, friction), contacts.active, solver, None, margin=True)
    wrench = Vec3(result.wrench.x, result.wrench.y, result.wrench.z * form.length)
    twist, force = result.twist.array(), result.force.array().T
    return Motion(twist, wrench.array(), force, result.mode, result.status, result.margin, result.unique)


class ContactSolution(NamedTuple):
    """The answer to a contact problem."""

    twist: Vec3  # m, m, rad
    wrench: Vec3  # normalized, on H = 1
    force: Vec2  # along (normal, tangent), (contacts,) each, N
    mode: Int[Array, "contacts"]  # `ContactMode`
    status: Int[Array, ""]  # `Status`
    margin: Scalar  # minus the hand's squeeze power, m, as in `Motion`
    unique: Bool[Array, ""]  # False where the solver found another twist that satisfies every condition
    best: EdgeSet | None  # the cone edges that carry the force, or else the guess; None without a guess


def solve_problem(
    form: Form,
    contacts: Contact,  # with an axis for the contacts
    active: Bool[Array, "contacts"],
    solver: ContactSolver | StickingSolver | None,
    guess: EdgeSet | None,  # edges that carried the force before; the default solver tries them after one contact alone
    *,
    margin: bool = False,
) -> ContactSolution:
    """Solve a contact problem."""
    count = len(active)
    if not 1 <= count <= MAX_CONTACTS:
        raise ValueError(f"contacts: from one to {MAX_CONTACTS} are supported; got {count}")
    if solver is None:
        solver = ScalarRoot() if count == 1 else Continuing()
    if isinstance(solver, StickingSolver):
        if count != 1:
            raise ValueError(f"solver: {type(solver).__name__} solves one contact; got {count}")
        one = solve_single(form, entry_at(contacts.where(active), 0), solver)
        infinite = jnp.full_like(one.twist.x, jnp.inf)
        force = Vec2(one.force.x[None], one.force.y[None])
        return ContactSolution(one.twist, one.wrench, force, one.mode[None], one.status, infinite, one.unique, guess)
    answer = solve(((form, contacts, active), guess), (solver, margin))
    twist, wrench, force = answer.solution
    best = None if guess is None else answer.best
    return ContactSolution(
        Vec3.of(twist), Vec3.of(wrench), Vec2.of(force), answer.mode, answer.status, answer.margin, answer.unique, best
    )


def form_and_friction(surface: LimitSurface, friction: Array) -> tuple[Form, Array]:
    """H of the limit surface, and the friction of contacts or fingers, both without invalid numbers."""
    form = surface.form()
    # A surface with numbers that cannot be computed with is replaced by one with all numbers one, which keeps NaN out.
    # The friction is then NaN, which makes every contact invalid.
    usable = surface.is_valid()
    return jax.tree.map(lambda entry: jnp.where(usable, entry, 1.0), form), jnp.where(usable, friction, jnp.nan)


def _is_unit(normal: Float[Array, "contacts 2"]) -> Bool[Array, "contacts"]:
    """Whether normals have unit length."""
    return jnp.abs(jnp.sum(normal**2, axis=1) - 1) <= 2 * UNIT_TOLERANCE


def contacts_in_columns(contacts: Contacts, friction: Array) -> Contact:
    """The contacts with one axis, the inactive ones out of reach whatever their numbers are."""
    point, normal, displacement = (Vec2.of(rows.T) for rows in (contacts.point, contacts.normal, contacts.displacement))
    return Contact(point, normal, displacement, friction, contacts.gap).where(contacts.active)
