"""Pushes along walls, into corners and against fixed bodies."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj

LENGTH = 0.04
HALF = (0.05, 0.03)  # m, of the rectangle
FINGER = 0.01
STEPS = 12
TOUCH = -HALF[0] - FINGER  # x of a finger that touches the rectangle from the left
slider = pj.Slider(pj.Polygon.rectangle(2 * HALF[0], 2 * HALF[1]), pj.Ellipsoid(np.eye(3), LENGTH))
hand = pj.Hand.finger(FINGER)
FLOOR, RIGHT = pj.Wall((0.0, -HALF[1]), (0.0, 1.0)), pj.Wall((0.06, 0.0), (-1.0, 0.0))
FAR = pj.Wall((3.0, 0.0), (-1.0, 0.0))


@jax.jit
def push(path, pose, friction, fixtures):
    return pj.rollout(slider, hand, path, pose=pose, friction=friction, fixtures=fixtures)


def straight(start, end):
    return pj.line(start, end, STEPS)


@pytest.mark.slow
def test_a_slider_pivots_on_the_corner_that_a_wall_supports():
    """One small step in closed form: a frictionless finger above the center, on a slider that lies on a wall."""
    a, h, way = HALF[0], 0.02, 1e-6
    path = straight((TOUCH, h), (TOUCH + STEPS * way, h))
    found = push(path, jnp.zeros(3), 0.0, (FLOOR, RIGHT))
    # The twist is k (f, n, (a n - h f) / L^2). The corner does not rise, and the finger does not enter the slider.
    support = a * h / (LENGTH**2 + a**2)  # n / f
    spin = (a * support - h) / LENGTH**2
    twist = np.array([1.0, support, spin]) * way / (1 - h * spin)
    np.testing.assert_allclose(found.twist[0], twist, rtol=2e-3, atol=1e-12)
    assert found.force[0, 0, 0] * support == pytest.approx(float(jnp.sum(found.force[0, 1:3, 0])), rel=1e-3)
    assert np.all(np.asarray(found.status) == pj.Status.MOVING)


def test_a_slider_pushed_flat_along_a_wall_slides():
    """Pushed through the center and into the wall, it moves along the wall, and friction at the wall opposes it."""
    wall = pj.Wall((0.0, -HALF[1]), (0.0, 1.0), friction=0.2)
    found = push(straight((TOUCH, 0.001), (TOUCH + 0.01, -0.001)), jnp.zeros(3), 0.4, (wall, RIGHT))
    np.testing.assert_allclose(found.pose[-1], [0.01, 0, 0], atol=1e-9)
    normal, tangent = np.sum(np.asarray(found.force[:, 1:3]), axis=1).T
    assert np.all(normal > 0.1)
    # the tangent of a contact with normal (0, 1) is (-1, 0)
    np.testing.assert_allclose(tangent, 0.2 * normal, rtol=1e-9)


def test_a_slider_in_a_corner_jams_and_is_not_grasped():
    found = push(straight((TOUCH, 0.0), (TOUCH + 0.024, 0.0)), jnp.zeros(3), 0.3, (FLOOR, RIGHT))
    assert found.status[-1] == pj.Status.JAMMED
    assert int(found.stopped) == 5  # of 2 mm each, the first five take the slider to the wall
    np.testing.assert_allclose(found.pose[-1], [0.01, 0, 0], atol=2e-3 / 16)


def test_a_slider_that_rests_against_a_wall_stays_free():
    """Roundoff of the contact with a wall is no push."""
    away = straight((-0.2, 0.0), (-0.3, 0.0))
    for height in (0.0, -1e-8):
        found = push(away, jnp.array([0.0, height, 0.0]), 0.3, (FLOOR, RIGHT))
        assert np.all(np.asarray(found.status) == pj.Status.FREE)
        assert float(found.pose[-1, 1]) == height


def test_a_slider_that_starts_in_a_wall_is_pushed_out():
    found = push(straight((-0.2, 0.0), (-0.3, 0.0)), jnp.array([0.0, -1e-3, 0.0]), 0.3, (FLOOR, RIGHT))
    assert found.overlap[-1] < 1e-5 * LENGTH
    assert found.pose[-1, 1] == pytest.approx(0, abs=1e-9)


def test_pushes_far_from_fixtures_are_those_without():
    path = straight((-0.07, 0.004), (0.0, 0.004))
    with_walls = push(path, jnp.zeros(3), 0.3, (pj.Wall((0.0, -3.0), (0.0, 1.0)), FAR))
    without = pj.rollout(slider, hand, path, pose=jnp.zeros(3), friction=0.3)
    np.testing.assert_allclose(with_walls.pose, without.pose, atol=1e-12)
    np.testing.assert_array_equal(with_walls.status, without.status)


@pytest.mark.slow
def test_a_body_that_is_not_convex_is_its_convex_parts():
    """Pushed into the notch of a U, a slider moves as among the three bars that the U consists of."""
    bars = [((0.0, -0.024), (0.06, 0.012)), ((-0.024, 0.006), (0.012, 0.048)), ((0.024, 0.006), (0.012, 0.048))]
    corners = [(-30, -30), (30, -30), (30, 30), (18, 30), (18, -18), (-18, -18), (-18, 30), (-30, 30)]
    u = pj.Polygon(1e-3 * np.array(corners))
    own, finger = pj.Slider(pj.Polygon.rectangle(0.03, 0.02), pj.Ellipsoid(np.eye(3), 0.015)), pj.Hand.finger(0.004)
    place = jnp.array([0.1, 0.05])

    def last(fixtures, way):
        start = place + jnp.array([0.0, 0.0235])
        path = pj.line(start, start + way, 24)
        found = pj.rollout(own, finger, path, pose=(0.1, 0.055, 0.0), friction=0.2, fixtures=fixtures)
        return found.pose, found.status

    rng = np.random.default_rng(0)
    ways = np.column_stack([rng.uniform(-0.02, 0.02, 40), rng.uniform(-0.045, -0.02, 40)])
    whole = pj.Fixture(u, (*place, 0.0), friction=0.3)
    parts = [pj.Fixture(pj.Polygon.rectangle(*size), place_of(place, at), friction=0.3) for at, size in bars]
    found, expected = (jax.jit(jax.vmap(lambda way, f=f: last(f, way)))(ways) for f in ((whole,), tuple(parts)))
    np.testing.assert_array_equal(found[1], expected[1])
    jams = np.asarray(found[1]) == pj.Status.JAMMED
    difference = np.abs(found[0] - expected[0])[:, 1:] / np.array([1.0, 1.0, 1 / 0.015])
    assert np.max(difference[~jams]) < 1e-6
    assert np.max(difference) < np.linalg.norm(ways, axis=1).max() / 24 / 16  # a jam is located to a sixteenth
    assert 0.2 < np.mean(jams) < 0.8


def place_of(place, at):
    return (place[0] + at[0], place[1] + at[1], 0.0)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_by_a_wall_are_those_of_differences(mode):
    """A slider that is pushed flat along a wall and turns on its corner: by place, direction and friction of a wall."""
    path = straight((TOUCH, 0.012), (TOUCH + 0.02, 0.012))

    def last(numbers):
        wall = pj.Wall(numbers[:2], numbers[2:4], numbers[4])
        return push(path, jnp.array([0.0, 0.0, -0.05]), 0.3, (wall, FAR)).pose[-1]

    numbers = jnp.array([0.0, -HALF[1] - 1e-3, 0.0, 1.0, 0.25])
    found = mode(last)(numbers)
    size = 1e-6
    differences = [(last(numbers + size * e) - last(numbers - size * e)) / (2 * size) for e in np.eye(5)]
    np.testing.assert_allclose(found, np.stack(differences, axis=1), rtol=1e-4, atol=1e-6)
    assert float(jnp.max(jnp.abs(found[:, 1]))) > 0.1


def test_traced_walls_that_are_not_valid_are_invalid():
    path = straight((-0.07, 0.0), (0.0, 0.0))
    wrong = [((0.0, jnp.nan), (0.0, 1.0), 0.1), ((0.0, -0.03), (0.0, 0.0), 0.1), ((0.0, -0.03), (0.0, 1.0), -0.1)]
    for point, normal, friction in wrong:
        wall = jax.jit(lambda *numbers: pj.Wall(*(jnp.asarray(n) for n in numbers)))(point, normal, friction)
        found = push(path, jnp.zeros(3), 0.3, (wall, RIGHT))
        assert np.all(np.asarray(found.status) == pj.Status.INVALID)
        assert np.all(np.isfinite(found.pose))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pj.Wall((0.0, 0.0), (0.0, 0.0)), "normal must not be zero"),
        (lambda: pj.Wall((0.0, 0.0), (0.0, 1.0), -0.1), "friction"),
        (lambda: pj.Wall((0.0, np.inf), (0.0, 1.0)), "point"),
        (lambda: pj.Fixture(pj.Ellipse(0.1, 0.2)), "shape: expected a Polygon or Disk; got a Ellipse"),
        (lambda: pj.Fixture(pj.Disk(0.1), (0.0, 0.0)), "pose"),
    ],
)
def test_wrong_fixtures_are_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_wrong_arguments_are_refused():
    path = straight((-0.07, 0.0), (0.0, 0.0))
    settings = {"pose": (0.0, 0.0, 0.0), "friction": 0.3}
    with pytest.raises(TypeError, match=r"fixtures: expected a sequence of Wall and Fixture; got one Wall"):
        pj.rollout(slider, hand, path, **settings, fixtures=FLOOR)
    with pytest.raises(TypeError, match=r"fixtures\[1\]: expected a Wall or Fixture; got a Disk"):
        pj.rollout(slider, hand, path, **settings, fixtures=(FLOOR, pj.Disk(0.1)))
    with pytest.raises(ValueError, match="pose: the slider starts inside a fixture, by 20 mm"):
        pj.rollout(slider, hand, path, **settings, fixtures=(pj.Wall((0.0, -0.01), (0.0, 1.0)),))


MODEL = pj.FrictionModel(dof=200, friction=(0.2, 0.3))
TOWARD_FLOOR = straight((-0.07, 0.004), (0.0, -0.02))


def many_pushes():
    return pj.monte_carlo(
        jax.random.key(0),
        8,
        slider,
        hand,
        TOWARD_FLOOR,
        pose=jnp.zeros(3),
        model=MODEL,
        fixtures=(FLOOR,),
        batch_size=8,
    )


@pytest.mark.slow
def test_monte_carlo_takes_fixtures():
    corners = np.asarray(slider.shape.vertices)
    for x, y, angle in np.asarray(many_pushes().pose):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        assert np.min((corners @ turn.T + [x, y])[:, 1]) > -HALF[1] - 1e-4


@pytest.mark.slow
def test_random_pushes_are_those_of_monte_carlo():
    key = jax.random.fold_in(jax.random.key(0), 3)
    one = pj.random_rollout(key, slider, hand, TOWARD_FLOOR, pose=jnp.zeros(3), model=MODEL, fixtures=(FLOOR,))
    np.testing.assert_allclose(many_pushes().pose[3], one.push.pose[-1], atol=1e-9)


def test_a_normal_of_length_zero_has_the_derivative_zero():
    derivative = jax.jacobian(lambda normal: pj.Wall((0.0, 0.0), normal).normal)
    np.testing.assert_array_equal(jax.jit(derivative)(jnp.zeros(2)), np.zeros((2, 2)))


@pytest.mark.slow
def test_one_step_takes_fixtures():
    ends = (TOUCH, 0.001), (TOUCH + 1e-3, 0.0009)
    moved = pj.step(slider, hand, *ends, pose=(0.0, 0.0, 0.0), friction=0.3, fixtures=(FLOOR,))
    np.testing.assert_allclose(moved.pose, [1e-3, 0, 0], atol=1e-9)


@pytest.mark.slow
def test_a_thin_wedge_squirts_out_and_then_rests():
    """A frictionless finger presses a wedge against a wall, in a single step.

    The wedge moves by the way of the finger over the tangent of its angle, as long as the finger is on its slope.
    """
    squirt = jax.jit(
        lambda shape, wall, path: pj.rollout(
            pj.Slider(shape, pj.Ellipsoid(np.eye(3), LENGTH)),
            hand,
            path,
            pose=jnp.zeros(3),
            friction=0.0,
            fixtures=(wall,),
        )
    )
    for angle in (0.2, 0.05, 0.01, 0.001):
        half = 0.1 * np.tan(angle)
        wedge = pj.Polygon(np.array([[-0.1, -half], [0.1, -half], [-0.1, half]]))
        wall = pj.Wall((0.0, -half), (0.0, 1.0))
        start = FINGER * np.array([np.sin(angle), np.cos(angle)])  # it touches the middle of the slope
        for way in (0.5, 1.6):  # in units of `half`: with 1 the finger is at the tip
            push = squirt(wedge, wall, pj.line(start, start - (0, way * half), 1))
            assert push.status[0] == pj.Status.MOVING
            x, turn = np.asarray(push.pose[-1])[[0, 2]]
            if way < 1:
                np.testing.assert_allclose(push.pose[-1], [-0.1 * way, 0, 0], atol=1e-12)
            else:  # the round finger turns the tip away as it passes
                assert -0.11 < x <= -0.1
                assert -0.02 < turn <= 0
            assert push.overlap[0] < 2e-4
