"""Squeezes that funnel a belief, against blocks between pads whose motion is known in closed form.

A disk is carried along the normal of the pads to the middle between them. A rectangle also turns until it is flat: to
the side that it would have turned to without friction, which is where the distance of the pads decreases (Goldberg).
"""

import jax
import numpy as np
import pytest

import pushjax as pj
from pushjax.planning import PlanStatus, Squeezes, plan_squeezes, squeezes
from pushjax.planning.squeezes import distances, entropy, most_likely, squeeze_outcomes

KEY = jax.random.key(0)
WIDTH, HEIGHT, RADIUS = 0.05, 0.035, 0.02
HAND = pj.Hand.parallel_jaw(0.07, 0.01)
RECTANGLE = pj.Slider(pj.Polygon.rectangle(WIDTH, HEIGHT), pj.Ellipsoid(np.eye(3), 0.018))
DISK = pj.Slider(pj.Disk(RADIUS), pj.Ellipsoid(np.eye(3), 0.013))
KNOWN = pj.FrictionModel(None, 0.05)
ROUND = np.linspace(0, 2 * np.pi, 60, endpoint=False)  # turns after which a disk looks the same
HALF_TURN = np.array([0.0, np.pi])


def uniform(count, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-0.008, 0.008, (count, 2)), rng.uniform(-np.pi, np.pi, count)])


def to_middle(poses, jaws):
    """Poses (..., 3) moved to the middle of a jaw (..., 3), along the normal of its pads."""
    normal = np.stack([-np.sin(jaws[..., 2]), np.cos(jaws[..., 2])], axis=-1)
    off = np.sum((poses[..., :2] - jaws[..., :2]) * normal, axis=-1, keepdims=True)
    return np.concatenate([poses[..., :2] - off * normal, poses[..., 2:]], axis=-1)


def flattened(poses, jaws):
    """The same for a rectangle, turned to where it is flat. The distance of the pads is largest at atan(w / h)."""
    relative = poses[..., 2] - jaws[..., 2]
    nearest = np.pi * np.round(relative / np.pi)
    beyond = np.abs(relative - nearest) > np.arctan2(WIDTH, HEIGHT)
    flat = np.where(beyond, nearest + np.sign(relative - nearest) * np.pi / 2, nearest)
    return np.concatenate([to_middle(poses, jaws)[..., :2], (jaws[..., 2] + flat)[..., None]], axis=-1)


@pytest.fixture
def closed_form(monkeypatch):
    """Replace the simulation by the closed form; count the rows that it is asked for."""
    asked = []

    def squeeze(slider, hand, settings, draws, poses, jaws):
        asked.append(len(poses))
        after = (to_middle if isinstance(slider.shape, pj.Disk) else flattened)(np.asarray(poses), np.asarray(jaws))
        return after, np.ones(len(poses), bool), np.zeros(len(poses), bool)

    monkeypatch.setattr(squeezes, "_squeeze_rows", squeeze)
    return asked


def test_entropy_counts_poses():
    spots = np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0, 0, 1.5)])
    none = np.zeros(1)
    np.testing.assert_allclose(entropy(np.zeros((9, 3)), none, 0.02, 0.002), 0, atol=1e-12)
    np.testing.assert_allclose(entropy(np.repeat(spots, 5, axis=0), none, 0.02, 0.002), np.log(4), rtol=1e-6)
    turned = np.array([(0, 0, 0.1), (0, 0, 0.1 + np.pi), (0, 0, 0.1 - 3 * np.pi)])
    np.testing.assert_allclose(entropy(turned, HALF_TURN, 0.02, 0.002), 0, atol=1e-12)
    assert entropy(turned, none, 0.02, 0.002) > 0.6
    one = np.random.default_rng(0).normal(size=(400, 3)) * [0.004, 0.0, 0.0]
    # a Gaussian blurred by its kernel: variance s^2 + 2 h^2 in place of 2 h^2, in the logarithm
    wanted = 0.5 * np.log((2 * 0.002**2 + 0.004**2) / (2 * 0.002**2)) + 0.5 * 0.004**2 / (2 * 0.002**2 + 0.004**2)
    np.testing.assert_allclose(entropy(one, none, 0.02, 0.002), wanted, rtol=0.1)


def test_the_most_likely_pose():
    poses = np.array([(0, 0, 0), (0.001, 0, np.pi), (0.5, 0, 0), (0.002, 0, 0.01), (0.003, 0, 1.0)])
    best, near = most_likely(poses, HALF_TURN, 0.0021, 0.05)
    assert best in (0, 1, 3)
    np.testing.assert_array_equal(near, [True, True, False, True, False])
    apart, turned = distances(poses, HALF_TURN, 2.0)
    np.testing.assert_allclose(apart[0], [0, 0.001, 0.5, 0.002, 0.003])
    np.testing.assert_allclose(turned[0], [0, 0, 0, 0.02, 2.0], atol=1e-12)


def test_a_disk_is_squeezed_from_two_sides(closed_form):
    """Only a second squeeze across the first brings it to one place."""
    plan = plan_squeezes(
        KEY, DISK, HAND, uniform(150), model=KNOWN, squeezes=Squeezes(0.08, angles=12), count=2, symmetry=ROUND
    )
    assert plan.status is PlanStatus.FOUND
    assert plan.success == 1
    first, second = plan.jaws[:, 2]
    assert abs(np.sin(second - first)) == pytest.approx(1)
    assert np.all(np.diff(plan.entropy) < 0)
    assert np.ptp(plan.outcomes.poses[:, -1, :2], axis=0).max() < 1e-6
    assert set(closed_form) == {squeezes.ROWS}


@pytest.mark.parametrize("beam", [1, 3])
def test_a_rectangle_is_oriented(closed_form, beam):
    """One squeeze leaves two angles, long side or short side flat. The next ones make one of them."""
    settings = {"model": KNOWN, "squeezes": Squeezes(0.08), "symmetry": 2, "beam": beam}
    one = plan_squeezes(KEY, RECTANGLE, HAND, uniform(200), count=1, **settings)
    assert one.status is PlanStatus.UNLIKELY
    assert one.success < 0.9
    three = plan_squeezes(KEY, RECTANGLE, HAND, uniform(200), count=3, **settings)
    assert three.status is PlanStatus.FOUND
    assert three.success == 1
    assert three.entropy[-1] < 0.05
    unseen = squeeze_outcomes(
        jax.random.key(5), RECTANGLE, HAND, uniform(300, 1), three.jaws, model=KNOWN, squeezes=settings["squeezes"]
    )
    off = np.abs(unseen.poses[:, -1] - three.pose)
    assert off[:, :2].max() < 0.005
    assert np.abs(np.sin(off[:, 2])).max() < 0.05
    again = plan_squeezes(KEY, RECTANGLE, HAND, uniform(200), count=3, **settings)
    np.testing.assert_array_equal(again.jaws, three.jaws)


def test_a_slider_that_is_not_held_costs(monkeypatch):
    """Of equal entropies the search takes the squeeze that holds."""

    def squeeze(slider, hand, settings, draws, poses, jaws):
        held = np.abs(np.asarray(jaws)[:, 2] - np.pi / 2) < 0.01
        return np.asarray(poses), held, np.zeros(len(poses), bool)

    monkeypatch.setattr(squeezes, "_squeeze_rows", squeeze)
    plan = plan_squeezes(
        KEY, DISK, HAND, np.zeros((4, 3)), model=KNOWN, squeezes=Squeezes(0.08, angles=8), count=1, samples=4
    )
    assert plan.jaws[0, 2] == pytest.approx(np.pi / 2)
    assert plan.success == 1


def test_a_squeeze_that_fails_is_no_success(monkeypatch):
    """It costs more than any other, and what fails on the way is not known at the end."""

    def squeeze(slider, hand, settings, draws, poses, jaws):
        failed = (np.asarray(jaws)[:, 2] < 0.1) | (np.asarray(poses)[:, 0] > 0.004)
        return 0 * np.asarray(poses), np.ones(len(poses), bool), failed

    monkeypatch.setattr(squeezes, "_squeeze_rows", squeeze)
    start = np.array([[0.0, 0, 0]] * 3 + [[0.005, 0, 0]])
    plan = plan_squeezes(KEY, DISK, HAND, start, model=KNOWN, squeezes=Squeezes(0.08, angles=8), count=2, samples=4)
    assert np.all(plan.jaws[:, 2] > 0.1)
    assert plan.success == 0.75
    assert plan.status is PlanStatus.UNLIKELY


def test_offsets_are_along_the_pads():
    around = Squeezes(0.08, angles=2, offsets=(-0.01, 0.02)).around(np.array([0.1, 0.2]))
    np.testing.assert_allclose(
        around, [(0.09, 0.2, 0), (0.1, 0.19, np.pi / 2), (0.12, 0.2, 0), (0.1, 0.22, np.pi / 2)], atol=1e-9
    )


def test_bad_input():
    def plan(hand=HAND, belief=((0, 0, 0),), **settings):
        return plan_squeezes(KEY, DISK, hand, belief, **{"model": KNOWN, "squeezes": Squeezes(0.08)} | settings)

    with pytest.raises(ValueError, match="count must be a whole number, at least 1; got 0"):
        plan(count=0)
    with pytest.raises(ValueError, match=r"belief has shape \(3,\); expected \(poses, 3\)"):
        plan(belief=(0, 0, 0))
    with pytest.raises(ValueError, match="number of poses in belief must be a whole number, at least 1; got 0"):
        plan(belief=np.zeros((0, 3)))
    with pytest.raises(ValueError, match="this one has 2 coordinates"):
        plan(hand=pj.Hand.finger(0.005))
    with pytest.raises(ValueError, match="success must be a probability; got 2"):
        plan(success=2)
    with pytest.raises(ValueError, match="width must be positive; got 0"):
        plan(width=0.0)
    with pytest.raises(ValueError, match="opening must be larger than closed"):
        Squeezes(0.001, closed=0.002)
    with pytest.raises(ValueError, match=r"offsets must be a whole number, at least 1; got 0"):
        Squeezes(0.08, offsets=())


@pytest.mark.slow
def test_a_simulated_disk_moves_as_in_closed_form():
    start, jaws = uniform(64), np.array([(0.001, 0, 0.4), (0, 0.002, 1.2)])
    done = squeeze_outcomes(KEY, DISK, HAND, start, jaws, model=KNOWN, squeezes=Squeezes(0.07, closed=0.02))
    assert done.held.all()
    assert not done.failed.any()
    for k, jaw in enumerate(jaws):
        wanted = to_middle(done.poses[:, k], jaw)
        np.testing.assert_allclose(done.poses[:, k + 1, :2], wanted[:, :2], atol=1e-4)


@pytest.mark.slow
def test_a_simulated_rectangle_is_oriented():
    """With little friction it turns as in closed form, unless it starts near the edge between two outcomes."""
    settings = {"model": pj.FrictionModel(100, (0.02, 0.05)), "squeezes": Squeezes(0.09, closed=0.02)}
    jaw = np.array([(0.0, 0.0, 0.3)])
    done = squeeze_outcomes(KEY, RECTANGLE, HAND, uniform(200), jaw, **settings)
    wanted = flattened(uniform(200), jaw)
    edge = np.abs(np.abs(np.sin(uniform(200)[:, 2] - 0.3)) - np.sin(np.arctan2(WIDTH, HEIGHT))) < 0.06
    off = np.abs(done.poses[:, 1] - wanted)[~edge]
    assert len(off) > 150
    assert np.quantile(np.abs(np.sin(off[:, 2])), 0.97) < 0.02
    plan = plan_squeezes(KEY, RECTANGLE, HAND, uniform(200), symmetry=2, **settings)
    assert plan.status is PlanStatus.FOUND
    assert np.all(np.diff(plan.entropy) < 0)
    # where a block really is, from a pose and with friction that the plan has not seen, it says beforehand
    real = squeeze_outcomes(jax.random.key(9), RECTANGLE, HAND, uniform(200, 2), plan.jaws, **settings)
    off = np.abs(real.poses[:, -1] - plan.pose)
    near = (np.hypot(off[:, 0], off[:, 1]) < 0.005) & (np.abs(np.sin(off[:, 2])) < np.sin(np.radians(5)))
    np.testing.assert_allclose(np.mean(near & real.held[:, -1]), plan.success, atol=4 * np.sqrt(2 * 0.1 * 0.9 / 200))
