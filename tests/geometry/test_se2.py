"""Planar rigid motions and the distance of two poses: their laws, near and at the singular angles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pushjax import deviation
from pushjax.geometry import se2

# Closed forms of a few operations on numbers of order ten, in units of roundoff of the dtype.
ROUNDINGS = 200
# Central differences with a step of 1e-6 on numbers of order ten: truncation 1e-12, roundoff 1e-15 * 10 / 1e-6.
DIFFERENCE_STEP = 1e-6
DIFFERENCE_TOLERANCE = 1e-7
# An arc approximated by 2000 short chords, each with an error of the cube of its angle: (2 pi)^3 / 2000^2.
CHORDS = 2000
CHORD_TOLERANCE = 1e-4

DTYPES = [np.float32, np.float64]
number = st.floats(-10, 10, allow_subnormal=False)
vector = st.tuples(number, number, st.floats(-6, 6, allow_subnormal=False)).map(np.array)
seeded = settings(max_examples=50, derandomize=True, deadline=None)

compose, inverse, exp, log = (jax.jit(f) for f in (se2.compose, se2.inverse, se2.exp, se2.log))
transform, transport_twist, transport_wrench = map(jax.jit, (se2.transform, se2.transport_twist, se2.transport_wrench))


def close(a, b, size: float = 10.0) -> None:
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=ROUNDINGS * size * np.finfo(a.dtype).eps)


def matrix(pose) -> np.ndarray:
    x, y, theta = pose
    return np.array([[np.cos(theta), -np.sin(theta), x], [np.sin(theta), np.cos(theta), y], [0, 0, 1]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_group_axioms(rng, dtype):
    a, b, c = rng.uniform(-3, 3, (3, 200, 3)).astype(dtype)
    zero = np.zeros((200, 3), dtype)
    close(compose(compose(a, b), c), compose(a, compose(b, c)))
    close(compose(a, zero), a)
    close(compose(zero, a), a)
    close(compose(a, inverse(a)), zero)
    close(compose(inverse(a), a), zero)
    close(inverse(compose(a, b)), compose(inverse(b), inverse(a)))


@given(vector, vector)
@seeded
def test_compose_and_transform_are_those_of_homogeneous_matrices(a, b):
    close(matrix(np.asarray(compose(a, b))), matrix(a) @ matrix(b))
    close(matrix(np.asarray(inverse(a))) @ matrix(a), np.eye(3), 100)
    close(np.append(transform(a, b[:2]), 1.0), matrix(a) @ [*b[:2], 1])


def test_angles_are_not_wrapped():
    assert float(compose(np.array([0, 0, 6.0]), np.array([0, 0, 6.0]))[2]) == 12
    assert float(exp(np.array([0, 0, 50.0]))[2]) == 50


ANGLES = np.concatenate([[0.0], *([s * 10.0**e for e in range(-12, 1)] for s in (1, -1)), [0.000999, 0.001001, 3, -6]])


@pytest.mark.parametrize("dtype", DTYPES)
def test_exp_and_log_are_inverse(rng, dtype):
    twist = np.concatenate([rng.uniform(-1, 1, (len(ANGLES), 2)), ANGLES[:, None]], axis=1).astype(dtype)
    close(log(exp(twist)), twist)
    close(exp(log(twist)), twist)


def test_exp_follows_the_twist(rng):
    """`exp` of a constant body twist agrees with very many short steps."""
    twist = rng.uniform(-1, 1, (20, 3)) * [1, 1, 2 * np.pi]

    step = jnp.asarray(twist) / CHORDS
    half_turn = step * jnp.array([[0, 0, 0.5]])
    chord = se2.compose(half_turn, se2.compose(step * jnp.array([[1, 1, 0]]), half_turn))

    def advance(pose, _):
        return se2.compose(pose, chord), None

    reached, _ = jax.lax.scan(advance, jnp.zeros_like(twist), length=CHORDS)
    np.testing.assert_allclose(exp(twist), reached, atol=CHORD_TOLERANCE)


def test_exp_adds_along_one_twist(rng):
    """Twists along one direction form a one-parameter group, also beyond a full turn."""
    twist = rng.uniform(-1, 1, (50, 3)) * [1, 1, 20]
    close(compose(exp(0.3 * twist), exp(0.7 * twist)), exp(twist))


def test_exp_is_smooth_through_zero():
    """Value, first and second derivative on both sides of the switch to series agree with a longer series."""

    def series(w):
        a = 1 - w**2 / 6 + w**4 / 120 - w**6 / 5040
        b = w / 2 - w**3 / 24 + w**5 / 720 - w**7 / 40320
        return a * 0.3 - b * 0.7

    def x(w):
        return se2.exp(jnp.stack([0.3 * jnp.ones_like(w), 0.7 * jnp.ones_like(w), w]))[0]

    angle = np.array([0.0, 1e-9, 9.99e-4, 1.001e-3, -1.001e-3, 1e-2])
    for order, tolerance in ((0, 1e-15), (1, 1e-12), (2, 1e-9)):  # a derivative of sin(w)/w costs a factor 1/w
        f, g = x, series
        for _ in range(order):
            f, g = jax.grad(f), jax.grad(g)
        np.testing.assert_allclose(jax.jit(jax.vmap(f))(angle), jax.jit(jax.vmap(g))(angle), rtol=0, atol=tolerance)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("function", [se2.exp, se2.log])
def test_gradients(function, dtype):
    twist = np.stack([np.full(len(ANGLES), 0.4), np.full(len(ANGLES), -0.3), ANGLES], axis=1).astype(dtype)
    forward = jax.jit(jax.vmap(jax.jacfwd(function)))(twist)
    reverse = jax.jit(jax.vmap(jax.jacrev(function)))(twist)
    assert forward.dtype == dtype
    assert np.isfinite(forward).all()
    close(forward, reverse)
    if dtype == np.float64:
        shift = DIFFERENCE_STEP * np.eye(3)
        difference = (function(twist[:, None] + shift[None]) - function(twist[:, None] - shift[None])) / (
            2 * DIFFERENCE_STEP
        )
        np.testing.assert_allclose(forward, np.swapaxes(difference, 1, 2), atol=DIFFERENCE_TOLERANCE)


@given(vector, vector, vector)
@seeded
def test_power_is_the_same_in_every_frame(relative, twist, wrench):
    power = np.dot(transport_twist(relative, twist), transport_wrench(relative, wrench))
    close(power, np.dot(twist, wrench), 1e4)


@given(vector, vector, vector)
@seeded
def test_transport_is_a_group_action(a, b, v):
    for carry in (transport_twist, transport_wrench):
        close(carry(compose(a, b), v), carry(a, carry(b, v)), 1e3)


@given(vector, vector)
@seeded
def test_transport_of_a_twist_is_the_conjugate_motion(relative, twist):
    """T exp(V) T^-1 = exp(transport(T, V))."""
    moved = compose(compose(relative, exp(twist)), inverse(relative))
    close(exp(transport_twist(relative, twist)), moved, 1e3)


def test_transport_of_a_wrench_moves_its_line_of_action():
    """A force of 2 N along x' at the origin of a frame at (0, 1), rotated by 90 degrees, is 2 N along y."""
    carried = transport_wrench(np.array([3.0, 1.0, np.pi / 2]), np.array([2.0, 0.0, 0.5]))
    close(carried, [0.0, 2.0, 0.5 + 3.0 * 2.0])


BINARY = [se2.compose, se2.transport_twist, se2.transport_wrench]


@pytest.mark.parametrize("function", BINARY)
def test_batches_broadcast(rng, function):
    one, many = rng.normal(size=3), rng.normal(size=(4, 5, 3))
    for a, b in ((one, many), (many, one), (many, many[0]), (many[:, :1], many[:1])):
        wide = np.broadcast_shapes(a.shape, b.shape)
        each = jax.vmap(jax.vmap(function))(np.broadcast_to(a, wide), np.broadcast_to(b, wide))
        close(function(a, b), each)
    close(
        se2.transform(one, many[..., :2]), jax.vmap(jax.vmap(se2.transform, (None, 0)), (None, 0))(one, many[..., :2])
    )


@pytest.mark.parametrize("function", BINARY)
def test_dtype_is_the_arrays(function):
    single = np.ones(3, np.float32)
    assert function(single, single).dtype == np.float32
    assert function(single, [0.0, 0.0, 1.0]).dtype == np.float32  # Python numbers do not change it to float64
    assert function([0, 0, 1], single).dtype == np.float32
    assert function(single, np.ones(3)).dtype == np.float64
    assert function([0, 0, 1], (0, 0, 1)).dtype == np.float64
    for unary in (se2.exp, se2.log, se2.inverse):
        assert unary(single).dtype == np.float32
    assert se2.transform(single, (1, 2)).dtype == np.float32


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda: se2.compose(np.zeros(2), np.zeros(3)), "pose"),
        (lambda: se2.compose(np.zeros(3), np.zeros((3, 4))), "relative"),
        (lambda: se2.inverse(1.0), "pose"),
        (lambda: se2.transform(np.zeros(3), np.zeros(3)), "point"),
        (lambda: se2.exp(np.zeros((3, 2))), "twist"),
        (lambda: se2.log(np.zeros(4)), "relative"),
        (lambda: se2.transport_twist(np.zeros(3), np.zeros(2)), "twist"),
        (lambda: se2.transport_wrench(np.zeros(3), np.zeros(2)), "wrench"),
        (lambda: se2.compose(np.zeros((4, 3)), np.zeros((5, 3))), "pose.*relative.*broadcast"),
        (lambda: deviation(np.zeros(2), np.zeros(3), 0.1), "pose_a"),
        (lambda: deviation(np.zeros(3), np.zeros((5, 2)), 0.1), "pose_b"),
        (lambda: deviation(np.zeros(3), np.zeros(3), 0.0), "length"),
        (lambda: deviation(np.zeros(3), np.zeros(3), -1.0), "length"),
        (lambda: deviation(np.zeros(3), np.zeros(3), np.nan), "length"),
        (lambda: deviation(np.zeros(3), np.zeros(3), np.inf), "length"),
    ],
)
def test_wrong_input_is_named(call, name):
    with pytest.raises(ValueError, match=name):
        call()


# --- deviation ---

distance = jax.jit(deviation)


@given(vector, vector, vector, st.floats(0.01, 2))
@seeded
def test_deviation_is_a_metric(a, b, c, length):
    ab = float(distance(a, b, length))
    assert ab >= 0
    close(ab, distance(b, a, length))
    assert float(distance(a, a, length)) == 0
    assert ab <= float(distance(a, c, length)) + float(distance(c, b, length)) + 1e-12  # roundoff of 20 m


@given(vector, vector, vector)
@seeded
def test_deviation_does_not_depend_on_the_world_frame(a, b, frame):
    close(distance(compose(frame, a), compose(frame, b), 0.7), distance(a, b, 0.7), 100)


def test_deviation_takes_the_smaller_angle():
    turn = np.array([0.0, 1.0, np.pi, np.pi + 1, 2 * np.pi, -3.5, 7.0, 1 + 20 * np.pi])
    smaller = np.array([0.0, 1.0, np.pi, np.pi - 1, 0.0, 2 * np.pi - 3.5, 7 - 2 * np.pi, 1.0])
    poses = np.stack([np.zeros(8), np.zeros(8), turn], axis=1)
    close(deviation(poses, np.zeros(3), 0.5), 0.5 * smaller)


def test_deviation_adds_meters():
    close(deviation([0.3, 0.4, 0.2], [0, 0, 0], 0.1), 0.5 + 0.1 * 0.2)
    close(deviation([300.0, 400.0, 0.2], [0, 0, 0], 100.0), 500 + 100 * 0.2)  # the same in mm


def test_gradient_of_deviation():
    pose, other = np.array([0.3, -0.2, 1.0]), np.array([0.1, 0.5, 0.4])
    slope = jax.jit(jax.grad(deviation))
    gradient = slope(pose, other, 0.3)
    delta = pose - other
    close(gradient, np.append(delta[:2] / np.hypot(*delta[:2]), 0.3))
    for dtype in DTYPES:
        same = pose.astype(dtype)
        np.testing.assert_array_equal(slope(same, same, np.float32(0.3)), np.zeros(3, dtype))
        opposite = same + np.array([0, 0, np.pi], dtype)
        assert np.isfinite(slope(same, opposite, 0.3)).all()


def test_dtype_of_deviation():
    single = np.ones(3, np.float32)
    assert deviation(single, single, 0.3).dtype == np.float32
    assert deviation(single, [0, 0, 1], 0.3).dtype == np.float32
    assert deviation(single, np.ones(3), 0.3).dtype == np.float64


def test_traced_length_does_not_raise():
    assert float(jax.jit(deviation)(np.zeros(3), np.array([3.0, 4.0, 1.0]), -1.0)) == 4
