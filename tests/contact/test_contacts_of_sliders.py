"""Several sliders in contact: the conditions of random scenes, judged by other code; jams; derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS
from contact_batches import first, problems

import pushjax as pj
from benchmarks.scenes_of_sliders import Scenes, grid, pile, scenes, violations
from benchmarks.sliders import jam_power, problem_of
from pushjax.contact import near_contacts
from pushjax.contact.near_contacts import solve_sliders
from pushjax.contact.problem import contacts_in_columns
from pushjax.contact.scaled_problem import ContactArrays, nondimensionalize
from pushjax.contact.several_sliders import differentiable_motion
from pushjax.contact.sliders_problem import SlidersProblem
from pushjax.contact.status import Status
from pushjax.friction.polynomial import Polynomial

SCENES = 300
SLOW = pytest.mark.slow
solve = jax.jit(solve_sliders, compiler_options=AS_USERS)


def moving(given: Scenes, dtype=jnp.float64, missing: float = 0.0) -> np.ndarray:
    """Check that the motion of every scene in which something pushes is found and right; return their status."""
    motion = solve(problem_of(given, dtype))
    status, error = np.asarray(motion.status), violations(given, np.asarray(motion.twist), np.asarray(motion.force))
    pushed = np.any(given.active & (given.goal[0] > 0), axis=0)
    np.testing.assert_array_equal(status == Status.FREE, ~pushed)
    assert np.mean((status != Status.MOVING) & pushed) <= missing, np.unique(status, return_counts=True)
    assert np.max(error[status == Status.MOVING], initial=0) < (1e-8 if dtype == jnp.float64 else 1e-3)
    return status


@pytest.mark.parametrize(
    ("kind", "sliders", "contacts", "degree", "alike"),
    [
        (pile, 3, 8, 2, False),
        pytest.param(pile, 2, 8, 2, True, marks=SLOW),
        pytest.param(pile, 5, 12, 4, False, marks=SLOW),
        pytest.param(pile, 8, 20, 2, False, marks=SLOW),
        pytest.param(grid, 4, 20, 2, True, marks=SLOW),
        pytest.param(grid, 5, 24, 4, False, marks=SLOW),
    ],
)
def test_every_condition_holds(kind, sliders, contacts, degree, alike):
    moving(scenes(kind, sliders, contacts, SCENES, degree=degree, seed=1, alike=alike))


@pytest.mark.parametrize("kind", [pile, pytest.param(grid, marks=SLOW)])
def test_float32(kind):
    moving(scenes(kind, 3, 14, SCENES, degree=2, seed=2), jnp.float32, missing=0.02)


@SLOW
def test_contacts_that_are_left_out_are_not_missed(monkeypatch):
    """Half of the contacts are open, by more than is looked at first; many of them close."""
    monkeypatch.setattr(near_contacts, "FAR", 0.05)
    given = scenes(pile, 3, 9, SCENES, degree=2, seed=5)
    rng, goal = np.random.default_rng(0), given.goal.copy()
    opened = given.active & (rng.random(goal.shape[1:]) < 0.5)
    goal[0] -= np.where(opened, rng.uniform(0, 1, opened.shape), 0)
    given = given._replace(goal=goal)
    motion = jax.jit(lambda given: solve_sliders(given), compiler_options=AS_USERS)(problem_of(given))
    status = np.asarray(motion.status)
    assert set(status) <= {Status.MOVING, Status.FREE}
    error = violations(given, np.asarray(motion.twist), np.asarray(motion.force))
    assert np.max(error[status == Status.MOVING]) < 1e-8
    closed = np.any((goal[0] < -0.05) & (np.asarray(motion.force[0]) > 0), axis=0)
    assert np.sum(closed) > 10


def row_between(sliders: int, speeds: np.ndarray, friction: float = 0.3) -> Scenes:
    """Squares in a row, face to face, between two pads with these speeds along the row: (2, scenes)."""
    faces = [(0, -1, 1.0), *((k + 1, k, 1.0) for k in range(sliders - 1)), (sliders - 1, -1, -1.0)]
    rows, goal = (
        np.zeros((2, 3, sliders, 2 * len(faces), speeds.shape[1])),
        np.zeros((2, 2 * len(faces), speeds.shape[1])),
    )
    for f, (one, other, direction) in enumerate(faces):
        for side in (0, 1):
            for body, sign in ((one, 1), (other, -1)):
                if body >= 0:
                    offset = -direction * sign, (side - 0.5) * 2
                    rows[0, :, body, 2 * f + side] += sign * np.array([[direction], [0.0], [-offset[1] * direction]])
                    rows[1, :, body, 2 * f + side] += sign * np.array([[0.0], [direction], [offset[0] * direction]])
            goal[0, 2 * f + side] = {0: speeds[0], len(faces) - 1: -speeds[1]}.get(f, 0.0)
    batch = speeds.shape[1]
    matrix = np.broadcast_to(np.eye(3)[None, :, :, None, None], (1, 3, 3, sliders, batch))
    mu = np.full((2 * len(faces), batch), friction)
    return Scenes(matrix, 2, rows, goal, mu, np.ones(mu.shape, bool))


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_pads_that_close_on_a_row_jam(dtype):
    # closing, both ahead at the same speed, the front one faster, the rear one leaving, and both apart
    speeds = np.array([[1.0, 1.0, 1.0, -0.5, -1.0], [0.9, 1.0, 1.1, -0.5, 1.0]])
    given = row_between(3, speeds)
    motion = solve(problem_of(given, dtype))
    assert [jam_power(given, k) > 1e-9 for k in range(5)] == [True, False, False, False, False]
    expected = [Status.JAMMED, Status.MOVING, Status.MOVING, Status.MOVING, Status.FREE]
    np.testing.assert_array_equal(motion.status, expected)
    np.testing.assert_allclose(motion.twist[0, :, 1:4], np.broadcast_to([1.0, 1.0, -0.5], (3, 3)), atol=1e-5)
    np.testing.assert_allclose(motion.twist[1:, :, 1:4], 0, atol=1e-5)


def test_bad_numbers_make_one_example_invalid():
    given = problem_of(scenes(pile, 3, 8, 6, degree=2, seed=3))
    good = solve(given)
    bad = given._replace(
        rows=given.rows.at[0, 0, 0, 0, 1].set(jnp.nan),
        friction=given.friction.at[0, 2].set(-0.1),
        surface=Polynomial(given.surface.table.at[0, 0, 0, 0, 3].set(jnp.inf)),
    )
    motion = solve(bad)
    np.testing.assert_array_equal(motion.status[1:4], Status.INVALID)
    assert not np.any(motion.twist[..., 1:4])
    for one, other in zip(jax.tree.leaves(motion), jax.tree.leaves(good), strict=True):
        np.testing.assert_array_equal(one[..., [0, 4, 5]], other[..., [0, 4, 5]])


@pytest.mark.parametrize("degree", [2, pytest.param(4, marks=SLOW)])
def test_one_slider_moves_as_by_the_solver_of_one(degree):
    batch = first(problems(2, degree), SCENES)
    alone = jax.jit(jax.vmap(pj.solve_contacts))(batch.surface, batch.contacts)

    def of_one(surface, contacts):
        form, contact = surface.form(), contacts_in_columns(contacts, contacts.friction)
        vectors = (each.array() for each in (contact.point, contact.normal, contact.displacement))
        table = Polynomial.of(form.table())
        return nondimensionalize(
            ContactArrays(table, form.length, *vectors, contact.gap, contact.friction, contacts.active)
        )

    scaled = jax.vmap(of_one, out_axes=-1)(batch.surface, batch.contacts)
    rows = jnp.stack([scaled.normal, scaled.tangent])[:, :, None]
    table = scaled.surface.table[:, :, :, None]
    motion = solve(SlidersProblem(Polynomial(table), rows, scaled.goal, scaled.friction, scaled.active))
    same = (np.asarray(alone.status) == motion.status) | (np.asarray(alone.status) == Status.JAMMED)
    assert np.all(same | (motion.status == Status.JAMMED))
    both = (np.asarray(alone.status) == Status.MOVING) & (motion.status == Status.MOVING) & np.asarray(alone.unique)
    assert np.mean(both) > 0.5
    length = jnp.stack([jnp.ones(SCENES), jnp.ones(SCENES), batch.surface.length])
    np.testing.assert_allclose(
        (motion.twist[:, 0] * scaled.unit[None])[:, both], (alone.twist.T * length)[:, both], rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("degree", [2, pytest.param(4, marks=SLOW)])
def test_derivatives_are_those_of_the_motion(degree):
    given = problem_of(scenes(pile, 3, 8, 40, degree=degree, seed=4))
    keys = jax.random.split(jax.random.key(0), 4)
    changes = [jax.random.normal(key, x.shape) for key, x in zip(keys, jax.tree.leaves(given)[:4], strict=True)]
    change = given._replace(
        surface=Polynomial(changes[0] + jnp.swapaxes(changes[0], 0, 1)),
        rows=changes[1],
        goal=changes[2],
        friction=changes[3],
    )
    change = jax.tree.map(lambda d, x: jnp.where(x != 0, d, 0) if x.dtype != bool else x, change, given)
    if degree == 4:  # a quartic's table is not free: keep it
        change = change._replace(surface=jax.tree.map(jnp.zeros_like, change.surface))

    def at(step):
        moved = jax.tree.map(lambda x, d: x if x.dtype == bool else x + step * d, given, change)
        motion = solve_sliders(moved)
        near = differentiable_motion(moved, motion)
        # the wrench of a slider that moves is determined, though forces may not be
        return (near.twist, jnp.where(motion.dissipation > 0, near.wrench, 0.0)), motion

    step = 1e-6
    (twist, _), derivative, motion = jax.jvp(at, (0.0,), (1.0,), has_aux=True)
    (ahead, _), (behind, _) = jax.jit(at)(step), jax.jit(at)(-step)
    same = np.all(np.asarray(motion.basic) == np.asarray(jax.jit(at)(step)[1].basic), axis=0)
    same &= np.all(np.asarray(motion.basic) == np.asarray(jax.jit(at)(-step)[1].basic), axis=0)
    assert np.mean(same) > 0.7
    for plus, minus, slope in zip(ahead, behind, derivative, strict=True):
        slope = np.asarray(slope)[..., same]
        size = 1 + np.max(np.abs(slope), axis=tuple(range(slope.ndim - 1)))
        np.testing.assert_allclose(np.asarray((plus - minus) / (2 * step))[..., same] / size, slope / size, atol=1e-5)
    weight = jax.random.normal(keys[0], twist.shape)
    reverse = jax.grad(lambda step: jnp.sum(weight * at(step)[0][0]))(0.0)
    np.testing.assert_allclose(reverse, np.sum(weight * derivative[0]), rtol=1e-9)
