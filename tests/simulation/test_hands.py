"""Fingers and the paths they follow."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax import Hand, line, resample, through
from pushjax.simulation.path import arc

ROUNDING = 1e-15  # of numbers of order 0.1


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_line_has_equal_steps_and_exact_ends(dtype):
    start, end = np.array([-0.06, 0.1], dtype), np.array([0.01, 0.3], dtype)
    path = line(start, end, 7)
    assert path.shape == (8, 2)
    assert path.dtype == dtype
    np.testing.assert_array_equal(path[0], start)
    np.testing.assert_array_equal(path[-1], end)
    hops = np.diff(path, axis=0)
    np.testing.assert_allclose(hops, np.tile((end - start) / 7, (7, 1)), rtol=1e-5 if dtype == np.float32 else 1e-13)


def test_line_takes_lists_and_any_number_of_coordinates():
    assert line([0, 0, 0, 1], [1, 0, 0, 1], 2).tolist() == [[0, 0, 0, 1], [0.5, 0, 0, 1], [1, 0, 0, 1]]
    assert line((0.5,), (0.5,), 1).tolist() == [[0.5], [0.5]]


def test_line_is_batched_and_differentiable():
    starts = jnp.array([[0.0, 0.0], [1.0, 2.0]])
    paths = jax.vmap(lambda a: line(a, jnp.zeros(2), 4))(starts)
    np.testing.assert_allclose(paths[1], line([1.0, 2.0], [0.0, 0.0], 4), rtol=0, atol=ROUNDING)
    gradient = jax.grad(lambda a: jnp.sum(line(a, jnp.zeros(2), 4)))(jnp.zeros(2))
    np.testing.assert_allclose(gradient, 1 + 0.75 + 0.5 + 0.25, rtol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.0, 0.0), (1.0, 0.0), 0), "steps must be a whole number, at least 1; got 0"),
        (((0.0, 0.0), (1.0, 0.0), -3), "steps must be a whole number, at least 1; got -3"),
        (((0.0, 0.0), (1.0, 0.0, 0.0), 5), "end has shape"),
        ((0.0, (1.0, 0.0), 5), "start has shape"),
        (([[0.0, 0.0]], (1.0, 0.0), 5), "start has shape"),
        (((np.nan, 0.0), (1.0, 0.0), 5), "start must be finite"),
        (((0.0, 0.0), (1.0, np.inf), 5), "end must be finite"),
    ],
)
def test_line_refuses_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        line(*arguments)


def test_through_meets_every_way_point():
    points = jnp.array([[0.0, 0.0, 0.1], [1.0, 0.0, 0.1], [1.0, 2.0, 0.0]])
    path = through(points, 4)
    assert path.shape == (9, 3)
    np.testing.assert_array_equal(path[::4], points)
    uneven = through(points, [1, 3])
    np.testing.assert_array_equal(uneven[jnp.array([0, 1, 4])], points)
    np.testing.assert_array_equal(uneven[1:], line(points[1], points[2], 3))
    gradient = jax.grad(lambda p: jnp.sum(through(p, 2)))(points)
    np.testing.assert_allclose(gradient.sum(), path[::2].size)


@pytest.mark.parametrize(
    ("points", "steps", "message"),
    [
        ([[0.0, 0.0]], 3, "at least one step, two configurations"),
        ([[0.0, 0.0], [1.0, 0.0]], [2, 2], "one for each of 1 stretches; got 2"),
        ([[0.0, 0.0], [1.0, 0.0]], 0, "steps must be a whole number, at least 1; got 0"),
        ([[0.0, 0.0], [np.nan, 0.0]], 1, "path must be finite"),
    ],
)
def test_through_refuses_bad_input(points, steps, message):
    with pytest.raises(ValueError, match=message):
        through(points, steps)


@pytest.mark.parametrize("steps", [2.5, "3"])
def test_steps_must_be_whole(steps):
    with pytest.raises(ValueError, match="steps must be a whole number"):
        line((0.0, 0.0), (1.0, 0.0), steps)
    with pytest.raises(ValueError, match="steps must be a whole number"):
        resample([[0.0, 0.0], [1.0, 0.0]], steps)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_resample_takes_steps_of_equal_length(dtype):
    recorded = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.3]], dtype)  # a pause, and unequal steps
    path = resample(recorded, 8)
    assert path.shape == (9, 2)
    assert path.dtype == dtype
    expected = [[min(s, 0.1), max(s - 0.1, 0.0)] for s in np.linspace(0, 0.4, 9)]
    np.testing.assert_allclose(path, expected, rtol=0, atol=1e-7 if dtype == np.float32 else ROUNDING)
    np.testing.assert_array_equal(path[0], recorded[0])
    np.testing.assert_array_equal(path[-1], recorded[-1])


def test_resampling_a_line_gives_it_back():
    path = line((-0.06, 0.1), (0.01, 0.3), 7)
    np.testing.assert_allclose(resample(path, 7), path, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(resample(path, 3), line((-0.06, 0.1), (0.01, 0.3), 3), rtol=0, atol=ROUNDING)


def test_resampling_a_path_that_stands_still():
    path = resample([[0.3, -0.2]] * 3, 5)
    np.testing.assert_array_equal(path, np.tile([0.3, -0.2], (6, 1)))


@pytest.mark.parametrize(
    "recorded",
    [[[0.0, 0.0], [0.1, 0.0], [0.1, 0.3]], [[0.0, 0.0], [0.1, 0.0], [0.1, 0.0], [0.1, 0.3]], [[0.3, 0.1]] * 3],
)
def test_resample_has_finite_derivatives(recorded):
    jacobian = jax.jacrev(lambda p: resample(p, 4))(jnp.array(recorded))
    assert np.isfinite(jacobian).all()
    np.testing.assert_allclose(np.sum(jacobian, axis=2)[..., 0, 0], 1, atol=1e-12)  # a shift moves every point


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.0, 0.0], [1.0, 0.0]], 0), "steps must be a whole number, at least 1; got 0"),
        (([[0.0, 0.0]], 5), "path needs at least one step, two configurations; got 1"),
        (([0.0, 0.0], 5), "path has shape"),
        (([[0.0, 0.0], [np.nan, 0.0], [1.0, 0.0]], 5), "path must be finite; 1 configuration.*first at index 1"),
    ],
)
def test_resample_refuses_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        resample(*arguments)


def test_finger():
    hand = Hand.finger(0.005)
    assert hand.dof == 2
    np.testing.assert_array_equal(hand.radius, [0.005])
    np.testing.assert_array_equal(hand.poses(jnp.array([0.1, -0.2])), [[0.1, -0.2]])
    np.testing.assert_array_equal(Hand.finger().radius, [0.0])


@pytest.mark.parametrize(
    ("radius", "message"),
    [
        (-0.001, "radius must not be negative"),
        (np.nan, "radius must be finite"),
        (np.inf, "radius must be finite"),
        ([0.001, 0.002], "radius has shape"),
    ],
)
def test_finger_refuses_bad_input(radius, message):
    with pytest.raises(ValueError, match=message):
        Hand.finger(radius)


def test_an_arc_turns_the_hand_like_a_rigid_body():
    path = np.asarray(arc((0.3, 0.1, 0.2, 0.05), (0.1, 0.1), -np.pi / 2, 4))
    assert path.shape == (5, 4)
    np.testing.assert_allclose(path[0], (0.3, 0.1, 0.2, 0.05), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(path[-1], (0.1, -0.1, 0.2 - np.pi / 2, 0.05), rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(np.hypot(*(path[:, :2] - 0.1).T), 0.2, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(np.diff(path[:, 2]), -np.pi / 8, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(arc((0.3, 0.1), (0.1, 0.1), -np.pi / 2, 4), path[:, :2], rtol=0, atol=ROUNDING)
    traced = jax.jit(arc, static_argnums=3)(path[0], np.array([0.1, 0.1]), -np.pi / 2, 4)
    np.testing.assert_allclose(traced, path, rtol=0, atol=ROUNDING)
    slope = jax.jacfwd(lambda angle: arc(path[0], (0.1, 0.1), angle, 4))(-np.pi / 2)
    np.testing.assert_allclose(slope[-1], (0.2, 0, 1, 0), rtol=0, atol=10 * ROUNDING)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0.1,), (0, 0), 1.0, 2), "start must hold at least x and y"),
        (((0.1, 0.0), (0, 0, 0), 1.0, 2), "center"),
        (((0.1, 0.0), (0, 0), np.nan, 2), "angle"),
        (((0.1, 0.0), (0, 0), 1.0, 0), "steps"),
    ],
)
def test_arc_refuses_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        arc(*arguments)
