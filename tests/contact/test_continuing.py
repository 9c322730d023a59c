"""Contact problems in which the cone edges that carried the force before are tried first."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from slopes import slopes

import pushjax as pj
from pushjax.contact.problem import contacts_in_columns, form_and_friction, solve_problem
from pushjax.contact.scaled_problem import EdgeSet
from pushjax.testing.problems import random_contacts_problem


def solved(problem, solver, displacement, guess):
    """Solve as a rollout does: without a margin, with the cone edges that carried the force before."""
    form, mu = form_and_friction(problem.surface, problem.contacts.friction)
    given = problem.contacts
    contacts = pj.Contacts(given.point, given.normal, displacement, given.friction, given.gap, given.active)
    return solve_problem(form, contacts_in_columns(contacts, mu), contacts.active, solver, guess)


@pytest.mark.slow
@pytest.mark.parametrize(("contacts", "with_derivatives"), [(2, False), (4, True)])
def test_the_same_motion_or_a_second_one(contacts, with_derivatives):
    """Answer and derivative are those of `Exhaustive`, unless the motion is not unique: whatever the guess is."""
    count = 400
    keys = jax.random.split(jax.random.key(4), count)
    problems = jax.jit(jax.vmap(lambda key: random_contacts_problem(key, contacts=contacts, degree=4)))(keys)

    @jax.jit
    @jax.vmap
    def answers(problem, key):
        given = problem.contacts.displacement
        before = solved(problem, pj.Exhaustive(), given, EdgeSet.none(given[0, 0])).best
        # a few of the guesses say nothing
        guess = jax.tree.map(
            lambda x, none: jnp.where(jax.random.uniform(key) < 0.1, none, x), before, EdgeSet.none(given[0, 0])
        )
        changed = given * (1 + 0.05 * jax.random.normal(key, given.shape))
        found = []
        for solver in (None, pj.Exhaustive()):
            answer = solved(problem, solver, changed, guess)
            slope = jnp.zeros((3, 1, 1))
            if with_derivatives:
                slope = jax.jacfwd(lambda d, s=solver: solved(problem, s, d, guess).twist.array())(changed)
            same = jnp.all(answer.best.edges == before.edges)
            found.append((answer.twist.array(), answer.status, answer.unique, slope, same))
        return found

    (twist, status, _, slope, same), (wanted, exact_status, unique, wanted_slope, _) = jax.tree.map(
        np.asarray, answers(problems, keys)
    )
    moves = exact_status == pj.Status.MOVING
    assert np.mean(same[moves]) > 0.7
    np.testing.assert_array_equal(status[unique], exact_status[unique])
    size = np.linalg.norm(wanted, axis=1)
    apart = np.linalg.norm(twist - wanted, axis=1) > 1e-3 * size
    assert not np.any(apart & unique & moves)
    assert 0 < np.sum(moves & ~apart) < count
    alike = moves & ~apart & (status == pj.Status.MOVING)
    assert np.all(np.isfinite(slope))
    error = np.abs(slope - wanted_slope).max(axis=(1, 2, 3))
    error = error / np.maximum(np.abs(wanted_slope).max(axis=(1, 2, 3)), 1)
    assert np.mean(error[alike] < 1e-2) > 0.99


OPEN, CLOSED = 0.32, 0.02  # m


@pytest.fixture(scope="module")
def grasps():
    """Two fingers close on a rectangle: a function from steps and solver to final poses and openings."""
    slider = pj.Slider(pj.Polygon.rectangle(0.09, 0.06), pj.Ellipsoid(np.diag([1.0, 1.0, 1.2]), length=0.03))
    hand = pj.Hand.two_fingers(0.008)
    keys = jax.random.split(jax.random.key(1), 2)
    friction = jax.random.uniform(keys[0], (200,), minval=0.05, maxval=0.6)
    pose = jax.random.uniform(keys[1], (200, 3), minval=-1, maxval=1) * jnp.array([[0.02, 0.02, np.pi]])

    @cache
    def final(steps, solver=None):
        path = pj.line((0, 0, 0, OPEN), (0, 0, 0, CLOSED), steps)
        push = jax.vmap(lambda p, mu: pj.rollout(slider, hand, path, pose=p, friction=mu, solver=solver))
        ends = jax.jit(push)(pose, friction)
        return np.asarray(ends.pose[:, -1]), np.asarray(ends.configuration[:, -1, 3])

    return final


@pytest.mark.slow
def test_a_coarse_grasp_goes_on_as_a_fine_one(grasps):
    """In a coarse grasp, the motion that continues is nearer to fine steps than the motion of largest power.

    With steps of 3 mm one finger pushes before the other arrives. There an explicit `Exhaustive` takes the motion of
    largest power, which often is another one, and the slider ends farther from the result of fine steps.
    """
    continuing, largest, fine = (grasps(*given)[0] for given in ((100,), (100, pj.Exhaustive()), (1600,)))
    differs = np.abs(continuing - largest).max(axis=1) > 1e-4
    assert 2 <= np.sum(differs) <= 40
    error, other = (np.abs(end - fine)[differs].max(axis=1) for end in (continuing, largest))
    assert np.median(error) < np.median(other) / 4


@pytest.mark.slow
def test_a_coarse_grasp_stops_where_a_fine_one_does(grasps):
    """A coarse grasp locates its jam to a sixteenth of a step; the earlier steps move the jam a little."""
    step = (OPEN - CLOSED) / 100
    apart = np.abs(grasps(100)[1] - grasps(1600)[1])
    assert np.median(apart) < step / 16
    assert np.quantile(apart, 0.9) < step / 8


def pair(displacement, friction):
    """A disk between two fingers: the contacts, on its left and right."""
    point, normal = jnp.array([[-0.03, 0.0], [0.03, 0.0]]), jnp.array([[1.0, 0.0], [-1.0, 0.0]])
    return pj.Contacts(point, normal, displacement, friction)


@jax.jit
def motion_of_pair(displacement, along, guess):
    """Return the answer for two frictionless fingers, and derivatives in both modes by the displacements."""

    def outcome(displacement):
        form, mu = form_and_friction(pj.Ellipsoid(np.eye(3), 0.02), jnp.zeros(2))
        contacts = pair(displacement, mu)
        found = solve_problem(form, contacts_in_columns(contacts, mu), contacts.active, None, guess)
        return jnp.concatenate([found.twist.array(), found.wrench.array(), found.force[0]]), found

    return slopes(outcome, displacement, along, jnp.ones(8))


def test_a_guess_whose_edges_cancel_is_not_taken():
    """Two frictionless fingers that move together leave no wrench of their own, whatever motion fits both."""
    numbers = (jnp.array(x, jnp.int32) for x in ([0, 3, -1], [0, 1, -1]))
    both = EdgeSet(*numbers, jnp.array([1.0, 1.0, 0.0]))
    for off in (0.0, 1e-15, 1e-14):
        push = jnp.array([[0.001, 0.0], [0.001 - off, 0.0002]])
        wanted, found = (motion_of_pair(push, push, guess)[1] for guess in (EdgeSet.none(jnp.zeros(())), both))
        assert found.status == wanted.status
        np.testing.assert_allclose(found.twist.array(), wanted.twist.array(), atol=1e-9)


def test_a_central_push_without_friction_has_its_derivatives():
    """Both cone edges are the normal there, and the contact does not slip: derivatives must not divide by zero."""
    at = jnp.array([[0.001, 0.0], [0.002, 0.0]])  # the other finger moves away
    value, _, forward, reverse = motion_of_pair(at, jnp.array([[1.0, 0.0], [0.0, 0.0]]), EdgeSet.none(jnp.zeros(())))
    np.testing.assert_allclose(value[:3], [0.001, 0, 0], atol=1e-15)
    np.testing.assert_allclose(forward[:3], [1.0, 0, 0], atol=1e-12)
    assert np.all(np.isfinite(reverse))


@pytest.mark.slow
def test_second_derivatives():
    """Two fingers push a face at different depths, so that it turns: the curvature of the motion by both."""
    problem = jax.jit(lambda key: random_contacts_problem(key, contacts=2, degree=4))(jax.random.key(11))
    given, size = problem.contacts, jnp.max(jnp.abs(problem.contacts.displacement))

    def value(x):
        contacts = pj.Contacts(given.point + x, given.normal, given.displacement, given.friction, given.gap)
        twist = pj.solve_contacts(problem.surface, contacts).twist
        return jnp.sum(twist * jnp.array([1.0, 0.7, 0.01])) / size

    curved = jax.jit(lambda x, along: jax.jvp(jax.grad(value), (x,), (along,)))
    x, h = jnp.zeros((1, 2)), 1e-5 * float(problem.surface.length)
    directions = jnp.eye(2).reshape(2, 1, 2)
    curvature = np.stack([curved(x, along)[1].ravel() for along in directions])
    ends = [[curved(x + t * along, along)[0].ravel() for t in (h, -h)] for along in directions]
    differences = np.stack([(ahead - behind) / (2 * h) for ahead, behind in ends])
    assert np.abs(curvature).max() > 1
    np.testing.assert_allclose(curvature, differences, atol=1e-5 * np.abs(curvature).max())


def test_empty_batches_and_mixed_dtypes():
    disk, empty = pj.Ellipsoid(np.eye(3), 0.02), jnp.zeros((0, 2, 2))
    solve = jax.vmap(lambda displacement: pj.solve_contacts(disk, pair(displacement, jnp.ones(2))).twist)
    assert solve(empty).shape == (0, 3)
    contacts = pj.Contacts(
        *(np.float32(x) for x in ([[-0.03, 0], [0.03, 0]], [[1, 0], [-1, 0]], [[1e-3, 0], [0, 0]], 0.3))
    )
    assert pj.solve_contacts(disk, contacts).status == pj.Status.JAMMED
