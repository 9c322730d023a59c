"""The answer to a problem of several contacts: a guess or a search for the edges that carry the force, then the finish.

In rollouts mostly one contact does all the work. So the contact that is pressed most is solved first, as if there were
no other (`single`), for every example. The result is a solution of the whole problem if every other contact separates:
the other contacts then bear no force, and no condition requires one. Where it does not suffice, the cone edges that
carried the force in the stage before mostly carry it again: their equations are solved and every condition is checked
(`finish`). A search follows where they do not solve the problem. In a batch, guess and search are done only for the
examples that need them (`in_tiles`). Where there are several motions, the one that continues is then the answer,
although another may have larger power, which `solve_contacts` gives.

Derivatives are those of the solution (`derivative`), whatever found it.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from pushjax._internal.autodiff import search_result
from pushjax._internal.tiles import in_search_tiles, in_tiles
from pushjax._internal.trailing_batch import with_batch_last
from pushjax._internal.xla import compute_once, tree_where
from pushjax._math.sums import summed
from pushjax.contact.contact_plane import Contact
from pushjax.contact.derivative import differentiable_solution
from pushjax.contact.exhaustive import Continuing
from pushjax.contact.finish import Answer, Solution, check, in_units, refine
from pushjax.contact.force_distribution import distribute_force, of_chosen
from pushjax.contact.frictionless import Frictionless, least_violation
from pushjax.contact.jam_certificate import Squeeze, search_squeeze, squeeze_power
from pushjax.contact.scaled_problem import (
    NO_EDGE,
    ContactArrays,
    ContactSolver,
    EdgeSet,
    Found,
    ScaledProblem,
    nondimensionalize,
)
from pushjax.contact.single import SingleSolution, solve_single
from pushjax.contact.status import ContactMode, Status
from pushjax.contact.sticking import ScalarRoot
from pushjax.contact.tolerances import relative_tolerance
from pushjax.friction.limit_surface import Form
from pushjax.friction.polynomial import Polynomial

# How far a contact has to separate to be left out, in units of the distance that passes as touching.
CLEARANCE = 4


# H, the contacts, with one axis, and whether each takes part.
Problem = tuple[Form, Contact, Bool[Array, "contacts"]]


@eqx.filter_custom_jvp
def solve(arguments: tuple[Problem, EdgeSet | None], settings: tuple[ContactSolver, bool]) -> Answer:
    """Solve a problem of several contacts, of one example, given a guess; the settings are a solver and `margin`."""
    # `Continuing` tries one contact alone and then the guess. Without `margin`, the margin is infinite where there is a
    # motion, which saves time.
    (problem, guess), (solver, _) = arguments, settings
    form, contacts, active = problem
    attempt = _without_friction if isinstance(solver, Frictionless) else partial(_attempt, *settings)
    arrays = _arrays(problem)
    if not isinstance(solver, Continuing) or guess is None:
        return in_tiles(attempt, jnp.ones((), bool), jnp.zeros((), bool), arrays, None)
    contacts = contacts.where(active)
    suffices, one, is_own = _most_pressed(form, contacts)
    together = in_tiles(attempt, ~suffices, guess.exists(), arrays, guess)
    # computed once, or each entry of the answer would compute all of it again
    modes = one.mode == ContactMode.STICKING, one.mode == ContactMode.SLIDING_LEFT
    floats = one.twist, one.wrench, one.force
    (twist, wrench, force), (sticks, slides_left) = compute_once((floats, modes), contacts.gap[0])
    own_friction = jnp.sum(jnp.where(is_own, contacts.friction, 0.0))
    own = _edges_of_one(is_own, sticks, slides_left, force.array(), own_friction)
    moves = one.status == Status.MOVING
    alone = together._replace(
        solution=Solution(twist.array(), wrench.array(), jnp.where(is_own[None], force.array()[:, None], 0.0)),
        mode=jnp.where(is_own, one.mode, ContactMode.SEPARATED).astype(jnp.int8),
        status=one.status,
        margin=jnp.full_like(together.margin, jnp.inf),
        unique=one.unique,
        best=tree_where(moves, own, guess),
        loaded=jnp.any((own.edges[:, None] == jnp.arange(2 * active.size)[None]) & moves, axis=0),
        indeterminate=jnp.zeros((), bool),
    )
    return tree_where(suffices, alone, together)


@solve.def_jvp
def _solve_jvp(primals, tangents):
    (arguments, settings), change = primals, tangents[0][0]
    answer = search_result(solve(arguments, settings))
    near, known = partial(_near, *settings), jax.lax.stop_gradient(answer)
    _, (solution, margin) = eqx.filter_jvp(
        lambda problem: with_batch_last(near, _arrays(problem), known), (arguments[0],), (change,)
    )
    unchanged = jax.tree.map(lambda leaf: jnp.zeros_like(leaf) if eqx.is_inexact_array(leaf) else None, answer)
    return answer, unchanged._replace(solution=solution, margin=margin)


def _near(solver: ContactSolver, margin: bool, given: ContactArrays, answer: Answer) -> tuple[Solution, Array]:
    """The solution and the margin as functions that JAX can differentiate; their values are right to roundoff."""
    if isinstance(solver, Frictionless):
        given = given._replace(friction=jnp.zeros_like(given.friction))
    scaled = nondimensionalize(given)
    near = differentiable_solution(scaled, answer)
    power = jnp.zeros_like(scaled.unit)
    if margin and scaled.count > 1:
        power = jnp.where(jnp.isfinite(answer.margin), squeeze_power(scaled, answer.squeeze_edges) * scaled.unit, power)
    return jax.tree.map(lambda value: jnp.where(jnp.isfinite(value), value, 0.0), (near, -power))


def _arrays(problem: Problem) -> ContactArrays:
    """The contacts of one example in arrays."""
    form, contacts, active = problem
    point, normal, displacement = contacts.point.array(), contacts.normal.array(), contacts.displacement.array()
    surface, friction = Polynomial.of(form.table()), contacts.friction
    arrays = ContactArrays(surface, form.length, point, normal, displacement, contacts.gap, friction, active)
    dtype = jnp.result_type(*jax.tree.leaves(arrays[:-1]))
    return jax.tree.map(lambda x: x if x.dtype == bool else x.astype(dtype), arrays)


def _most_pressed(form: Form, contacts: Contact) -> tuple[Bool[Array, ""], SingleSolution, Bool[Array, "contacts"]]:
    """Whether the most pressed contact alone gives an answer, its motion, and which contact it is."""
    approach = contacts.approach().x
    is_main = jnp.arange(approach.size) == jnp.argmax(approach)
    one = solve_single(
        form, jax.tree.map(lambda column: jnp.sum(jnp.where(is_main, column, 0.0)), contacts), ScalarRoot()
    )
    twist, length, contacts, approach = jax.lax.stop_gradient((one.twist, form.length, contacts, approach))
    displacement = jnp.abs(contacts.displacement.x) + jnp.abs(contacts.displacement.y)
    size = jnp.abs(twist.x) + jnp.abs(twist.y) + length * jnp.abs(twist.z)
    size = jnp.maximum(size, jnp.max(jnp.maximum(displacement, -contacts.gap)))
    normal_motion = contacts.normal.dot(twist.xy + contacts.point.perp().scale(twist.z))
    # an answer if it moves the slider away from all other contacts, or if no contact is pressed
    clear = normal_motion - approach > CLEARANCE * relative_tolerance(approach.dtype) * size
    answers = jnp.all(clear | is_main) & (one.status == Status.MOVING)
    suffices = jnp.all(contacts.friction >= 0) & (answers | jnp.all(approach <= 0))
    return compute_once(suffices, contacts.gap[0]), one, is_main


def _edges_of_one(
    is_own: Bool[Array, "contacts"], sticks: Array, slides_left: Array, force: Array, mu: Array
) -> EdgeSet:
    """The cone edges of the one contact that carries the force."""
    contact = jnp.argmax(is_own).astype(jnp.int32)
    sticks &= mu > 0  # without friction, both edges are the same
    first = 2 * contact + jnp.where(sticks | slides_left | (mu <= 0), 0, 1).astype(jnp.int32)
    none = jnp.full((), NO_EDGE, jnp.int32)
    tangential = force[1] / jnp.where(mu > 0, mu, 1.0)
    left, right = (force[0] + tangential) / 2, (force[0] - tangential) / 2
    weight = jnp.stack([jnp.where(sticks, left, force[0]), jnp.where(sticks, right, 0.0), jnp.zeros_like(left)])
    second = jnp.where(sticks, 2 * contact + 1, NO_EDGE)
    return EdgeSet(jnp.stack([first, second, none]), jnp.stack([2 * contact, second, none]), weight)


def _attempt(
    solver: ContactSolver, margin: bool, again: Int[Array, ""], given: ContactArrays, guess: EdgeSet | None
) -> tuple[Answer, Bool[Array, " batch"]]:
    """Solve a batch of problems by the guess, or in the second attempt by the search."""
    if guess is not None:  # a batch of guesses alone is a batch, too
        batch = jnp.broadcast_shapes(given.length.shape, guess.weight.shape[1:])
        given = given._replace(length=jnp.broadcast_to(given.length, batch))
    problem = nondimensionalize(given)
    like, size = problem.unit, problem.unit.shape[0]
    nothing = EdgeSet.none(like) if guess is None else jax.tree.map(lambda x: jnp.broadcast_to(x, (3, size)), guess)
    blank = Found.guessed(nothing), Squeeze.none(like)
    found, squeeze = in_search_tiles(partial(_search, solver, margin), again, problem, blank)
    best, searched = found.best, jnp.arange(size) < again
    moves = best.exists() & problem.pushes
    refined = refine(problem, best, moves)
    solved, admissible, mode = check(problem, best, moves, refined)
    weights, indeterminate, dual = distribute_force(
        problem.edges, admissible & solved[None], best.edges, refined.weight, refined.wrench, refined.start
    )
    # If the search found a set that the check then rejects, this is no proof of a jam. The same holds if the search
    # found a twist that is too fast to be represented.
    unsolved = problem.pushes & ~best.exists() & ~found.too_fast & searched
    unmoved = jnp.where(solver.proves_jams & squeeze.presses & unsolved, Status.JAMMED, Status.NOT_CONVERGED)
    status = jnp.where(problem.pushes, jnp.where(solved, Status.MOVING, unmoved), Status.FREE)
    status = jnp.where(problem.valid, status, Status.INVALID).astype(jnp.int8)
    # If nothing pushes, the answer is that the slider stays. Any set found is then a second solution, in which a pusher
    # drags the slider along.
    unique = ~jnp.where(problem.pushes, found.second_found & solved, best.exists() & searched)
    known = best._replace(weight=refined.weight)
    answer = Answer(
        in_units(problem, solved, refined.twist, refined.wrench, weights),
        mode,
        status,
        jnp.where(unsolved | margin, -squeeze.power * problem.unit, jnp.inf),
        unique,
        jax.tree.map(lambda new, old: jnp.where(solved[None], new, old), known, nothing),
        weights > 0,
        indeterminate & solved,
        dual,
        squeeze.edges,
    )
    return answer, problem.pushes & ~solved


def _without_friction(again: Array, given: ContactArrays, guess: None) -> tuple[Answer, Bool[Array, " batch"]]:
    """Solve a batch of problems without friction in closed form, with contacts without force SEPARATED."""
    problem = nondimensionalize(given)
    problem, none = problem._replace(friction=jnp.zeros_like(problem.friction)), jnp.zeros(problem.unit.shape, bool)
    best, twist, solved = least_violation(problem)
    weights = of_chosen(problem.edges, best.edges, best.weight)
    status = jnp.where(problem.pushes, jnp.where(solved, Status.MOVING, Status.JAMMED), Status.FREE)
    status = jnp.where(problem.valid, status, Status.INVALID).astype(jnp.int8)
    loaded = solved[None] & (weights[::2] > 0)
    slides = jnp.where(problem.slips(twist)[1] < 0, ContactMode.SLIDING_LEFT, ContactMode.SLIDING_RIGHT)
    wrench, squeeze = summed(problem.normal * weights[None, ::2], 1), Squeeze.none(problem.unit)
    answer = Answer(
        in_units(problem, solved, twist, wrench, weights),
        jnp.where(loaded, slides, ContactMode.SEPARATED).astype(jnp.int8),
        status,
        jnp.full_like(problem.unit, jnp.inf),
        ~none,
        best,
        weights > 0,
        none,
        jnp.zeros_like(wrench),
        squeeze.edges,
    )
    return answer, none


def _search(solver: ContactSolver, margin: bool, problem: ScaledProblem) -> tuple[Found, Squeeze]:
    """Search the cone edges that carry the force, and the squeeze power where there are none or where it is wanted."""
    found, none = solver.search(problem), Squeeze.none(problem.unit)
    wanted = margin | (problem.pushes & ~found.best.exists() & ~found.too_fast)
    return found, jax.lax.cond(jnp.any(wanted), search_squeeze, lambda _: none, problem)
