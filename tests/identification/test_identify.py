"""Identification from pushes: known parameters are recovered."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from pushjax.geometry.se2 import compose, inverse
from pushjax.identification.model import Problem, Scene, correct_path
from pushjax.identification.prior import Layout, Prior

HALF, RADIUS, TRAVEL, STEPS = 0.045, 0.005, 0.03, 15
MU = 0.3


def turned(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def planned(rng, count):
    """Return starts (count, 3) and paths of random pushes of a square, anywhere on its sides, from 1 mm away."""
    starts, paths = [], []
    for _ in range(count):
        pose = np.array([*rng.uniform(-0.1, 0.1, 2), rng.uniform(-3, 3)])
        place = turned(pose[2] + rng.integers(4) * np.pi / 2)
        along = place @ turned(rng.uniform(-0.6, 0.6)) @ [1.0, 0.0]
        begin = pose[:2] + place @ [-HALF - RADIUS - 0.001, rng.uniform(-0.8, 0.8) * HALF]
        starts.append(pose)
        paths.append(begin + np.linspace(0, TRAVEL, STEPS + 1)[:, None] * along)
    return np.array(starts), np.array(paths)


@pytest.fixture(scope="module")
def square():
    return pj.Polygon.rectangle(2 * HALF, 2 * HALF)


@pytest.fixture(scope="module")
def hand():
    return pj.Hand.finger(RADIUS)


@pytest.fixture(scope="module")
def expected(square):
    return pj.Slider.uniform(square).surface


@pytest.fixture(scope="module")
def real(expected):
    """Return the surface of twelve points with unequal loads, 20 degrees from the prior."""
    rng = np.random.default_rng(0)
    support = pj.Support.points(rng.uniform(-0.04, 0.04, (12, 2)), rng.uniform(0.2, 1.0, 12))
    return pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(1), 400, length=expected.length))


@jax.jit
def pushed(slider, hand, friction, starts, paths):
    return jax.vmap(lambda start, path: pj.rollout(slider, hand, path, pose=start, friction=friction).pose[-1])(
        starts, paths
    )


@pytest.fixture(scope="module")
def pushes(square, real, hand):
    starts, paths = planned(np.random.default_rng(1), 50)
    return pj.Pushes(starts, paths, pushed(pj.Slider(square, real), hand, MU, jnp.asarray(starts), jnp.asarray(paths)))


UNKNOWNS = pj.Unknowns((0.0, 1.0), surface_dof=50, pressure_center=0.005)


def angles(one, other):
    """Return the angles, rad, between the wrenches of 500 twists."""
    twist = np.random.default_rng(2).normal(size=(500, 3)) / [1, 1, float(one.length)]

    def unit(surface):
        w = np.asarray(jax.vmap(surface.wrench)(jnp.asarray(twist))) / [1, 1, float(one.length)]
        return w / np.linalg.norm(w, axis=1)[:, None]

    return np.arccos(np.clip(np.sum(unit(one) * unit(other), axis=1), -1, 1))


def test_recovers_friction_and_surface(pushes, square, expected, real, hand):
    """Without noise, mu is recovered to a hundred-thousandth, and every wrench to a hundredth of a degree."""
    assert np.degrees(angles(expected, real).max()) > 15
    found = pj.identify(pushes, pj.Slider(square, expected), hand, UNKNOWNS)
    assert found.converged
    assert abs(float(found.friction) / MU - 1) < 1e-5
    assert np.degrees(angles(found.surface, real).max()) < 0.01
    assert found.surface.is_convex()
    assert float(jnp.abs(found.residual).max()) < 1e-6
    again = found.predict(pushes, pj.Slider(square, expected), hand).pose[:, -1] - pushes.end
    np.testing.assert_allclose(found.residual, again * jnp.stack([1.0, 1.0, expected.length])[None], atol=1e-12)
    # the result predicts other pushes of the same slider
    starts, paths = planned(np.random.default_rng(3), 50)
    ends = pushed(pj.Slider(square, real), hand, MU, jnp.asarray(starts), jnp.asarray(paths))
    others = pj.Pushes(starts, paths, ends)
    predicted = found.predict(others, pj.Slider(square, expected), hand)
    assert not predicted.failed.any()
    # one of them, predicted directly
    slider, finger, path = found.corrected(pj.Slider(square, expected), hand, jnp.asarray(paths[0]))
    alone = pj.rollout(slider, finger, path, pose=jnp.asarray(starts[0]), friction=found.friction)
    np.testing.assert_allclose(alone.pose, predicted.pose[0], atol=1e-12)
    np.testing.assert_allclose(predicted.pose[:, -1], others.end, atol=2e-6)


@pytest.mark.slow
def test_known_parameters(square, hand, tmp_path):
    """Friction is recovered from paths as logged if it is known how far off the robot was."""
    starts, paths = planned(np.random.default_rng(6), 12)
    surface = pj.Ellipsoid(np.eye(3), 0.03)
    true_paths = jax.vmap(lambda path: correct_path(path, 0.002, 0.0, jnp.array([0.001, -0.001])))(jnp.asarray(paths))
    slider = pj.Slider(square, surface)
    logged = pj.Pushes(starts, paths, pushed(slider, hand, MU, jnp.asarray(starts), true_paths))
    known = {"overshoot": 0.002, "hand_offset": [0.001, -0.001]}
    found = pj.identify(logged, slider, hand, pj.Unknowns(surface_dof=None), known=known, sigma=1e-4)
    assert found.labels == ("friction",)
    assert float(found.friction) == pytest.approx(MU, rel=1e-4)
    assert float(jnp.abs(found.residual).max()) < 1e-6
    found.save(tmp_path / "found.json")
    again = pj.Identified.load(tmp_path / "found.json")
    for name, value in known.items():
        np.testing.assert_array_equal(getattr(again.parameters, name), value)
    elsewhere = again.with_known(overshoot=0.0)
    assert float(elsewhere.parameters.overshoot) == 0
    np.testing.assert_array_equal(elsewhere.parameters.hand_offset, again.parameters.hand_offset)
    for wrong, message in (
        ({"overshot": 0.0}, "known: 'overshot' is not one of pressure_center, inset, overshoot"),
        ({"friction": 0.2}, "known: 'friction' is not one of .*; there is the argument friction"),
        ({"hand_offset": 0.001}, r"known\['hand_offset'\] has shape \(\); expected \(2,\), or \(1, 2\)"),
        ({"overshoot": np.nan}, r"known\['overshoot'\]"),
    ):
        with pytest.raises(ValueError, match=message):
            pj.identify(logged, slider, hand, known=wrong)
    with pytest.raises(ValueError, match="known: 'inset' is also estimated"):
        pj.identify(logged, slider, hand, pj.Unknowns(inset=0.001), known={"inset": 0.001})
    two_fingers = pj.Hand.two_fingers(0.002)
    with pytest.raises(ValueError, match="overlap is for a single round finger"):
        pj.identify(pj.Pushes(starts, np.zeros((12, 3, 4)), starts), slider, two_fingers, known={"overlap": 1.0})


def test_noise_and_outliers(pushes, square, expected, real, hand, tmp_path):
    """Noise of half a millimeter is identified, intervals contain the truth, and three outliers have no effect."""
    rng = np.random.default_rng(4)
    noise = 0.0005 * rng.normal(size=(50, 3)) / [1, 1, float(expected.length)]
    slider = pj.Slider(square, expected)
    found = pj.identify(pj.Pushes(pushes.start, pushes.path, pushes.end + noise), slider, hand, UNKNOWNS)
    assert 0.35e-3 < float(found.sigma) < 0.65e-3
    low, high = found.interval(0.99)["friction"]
    assert 0 < low < MU < high < 1
    assert high - low < 0.1
    narrow = found.interval(0.5)["friction"]
    assert low < narrow[0] < found.friction < narrow[1] < high
    assert set(found.interval()) == {"friction", "pressure_center"}
    assert np.degrees(np.median(angles(found.surface, real))) < 3
    # pushes inform about friction only where the finger slides, and about the surface everywhere
    share_of_push = np.asarray(found.information_share("friction"))
    assert share_of_push.sum() == pytest.approx(1)
    assert np.sum(share_of_push < 1e-9) > 5
    assert np.all(np.asarray(found.information_share("surface")) > 0)
    determined = found.variance_reduction
    assert set(determined) == set(found.labels)
    assert determined["friction"] > 0.99
    assert min(determined.values()) < 0.5 < max(determined.values())
    # saved and loaded, the bits are the same
    found.save(tmp_path / "found.json")
    again = pj.Identified.load(tmp_path / "found.json")
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    assert jax.tree.structure(again) == jax.tree.structure(found)
    np.testing.assert_array_equal(again.surface.coefficients, found.surface.coefficients)
    (tmp_path / "other.json").write_text('{"format": "pushjax limit surface"}')
    with pytest.raises(ValueError, match="is not an identification file: its format is another"):
        pj.Identified.load(tmp_path / "other.json")
    with pytest.raises(ValueError, match="name must be one of friction, surface, pressure_center; got 'inset'"):
        found.information_share("inset")
    noise[:3] += [0.02, -0.02, 0.3]
    wild = pj.identify(pj.Pushes(pushes.start, pushes.path, pushes.end + noise), slider, hand, UNKNOWNS)
    assert abs(float(wild.friction) - float(found.friction)) < high - low
    # samples scatter as the covariance says
    draws = np.asarray(found.sample(jax.random.key(0), 2000).friction)
    share = np.mean((draws > low) & (draws < high))
    assert abs(share - 0.99) < 4 * np.sqrt(0.99 * 0.01 / 2000)


@pytest.mark.slow
def test_float32_where_float64_is_enabled(square, expected, hand):
    """Float32 converges on noisy pushes whose minimum is at a change of mode, or where roundoff hides the descent."""
    slider, single = pj.Slider(square, expected), lambda tree: jax.tree.map(lambda leaf: leaf.astype(jnp.float32), tree)
    for seed in (1, 6):
        rng = np.random.default_rng(seed)
        starts, paths = planned(rng, 40)
        ends = pushed(slider, hand, MU, jnp.asarray(starts), jnp.asarray(paths))
        noisy = np.asarray(ends) + rng.normal(size=(40, 3)) * [2e-4, 2e-4, 5e-3]
        found = pj.identify(single(pj.Pushes(starts, paths, noisy)), single(slider), single(hand))
        assert found.friction.dtype == jnp.float32
        assert found.converged
        assert abs(float(found.friction) - MU) < 0.005


@pytest.mark.slow
def test_conditions_share_the_calibration(square, hand):
    """Two sliders on two tables share one robot, which goes farther than logged, with a finger thinner than stated."""
    rng = np.random.default_rng(5)
    length = 0.03
    inset, end, mu = 0.0008, 0.0012, (0.2, 0.45)
    each = []
    for k, count in enumerate((20, 15)):
        starts, paths = planned(rng, count)
        really = jax.vmap(lambda path: correct_path(path, end, 0.0, jnp.zeros(2)))(jnp.asarray(paths))
        slider = pj.Slider(square.inset(inset), pj.Ellipsoid(np.eye(3), length))
        each.append(pj.Pushes(starts, paths, pushed(slider, hand, mu[k], jnp.asarray(starts), really)))
    many = pj.Pushes.conditions(each)
    assert many.weight.shape == (2, 20)
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=None, inset=0.002, overshoot=0.002)
    found = pj.identify(many, pj.Slider(square, pj.Ellipsoid(np.eye(3), length)), hand, unknowns, sigma=1e-5)
    assert found.labels == ("friction[0]", "friction[1]", "inset", "overshoot")
    np.testing.assert_allclose(found.friction, mu, rtol=1e-3)
    with pytest.raises(ValueError, match="corrected is for what was found of one condition"):
        found.corrected(pj.Slider(square, pj.Ellipsoid(np.eye(3), length)), hand, many.path[0, 0])
    np.testing.assert_allclose(found.parameters.inset, [inset, inset], atol=2e-6)
    np.testing.assert_allclose(found.parameters.overshoot, [end, end], atol=2e-6)
    # the padding of the shorter condition has no influence
    other = pj.Pushes(many.start, many.path, many.end.at[1, 15:].add(0.1), many.weight)
    again = pj.identify(other, pj.Slider(square, pj.Ellipsoid(np.eye(3), length)), hand, unknowns, sigma=1e-5)
    np.testing.assert_allclose(again.z, found.z, atol=1e-9)

    # derivatives of the residuals
    surface = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), pj.Ellipsoid(np.eye(3), length))
    prior = Prior.of(unknowns, surface, {"friction": jnp.full(2, 0.25)}, jnp.zeros(2))
    problem = Problem(Scene(square, hand, prior.origin), surface, prior, jnp.asarray(0.05))
    z, h = jnp.asarray([-1.0, 0.3, 0.2, -0.4]), 1e-6
    at = eqx.filter_jit(problem.linearize)(z, many)
    value, jacobian = at.value.poses, problem.jacobian(z, at).poses
    np.testing.assert_array_equal(problem.linear_residuals(z, at).poses, value)
    residuals = eqx.filter_jit(lambda z, pushes: problem.residuals(z, pushes).poses)
    np.testing.assert_allclose(value, residuals(z, many), atol=1e-15)
    for k in range(4):
        step = h * jnp.eye(4)[k]
        off = jacobian[..., k] - (residuals(z + step, many) - residuals(z - step, many)) / (2 * h)
        # except where a push changes its mode between the two
        assert np.mean(np.abs(off) < 1e-8) > 0.97


def test_layout_of_the_vector():
    shared = ("pressure_center", "overshoot")
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=20, pressure_center=0.001, overshoot=0.001, shared=shared)
    layout = Layout.of(unknowns, 6, 3)
    assert layout.size == 3 * 1 + 3 * 6 + 2 + 1
    assert layout.positions.shape == (3, 10)
    assert layout.labels[:5] == ("friction[0]", "friction[1]", "friction[2]", "surface[0].0", "surface[0].1")
    assert layout.labels[-3:] == ("pressure_center.0", "pressure_center.1", "overshoot")
    assert layout.has_normal_prior.sum() == layout.size - 3


def test_moved_paths():
    """Paths are extended, delayed and shifted; a hand that rests, or reverses, has finite derivatives."""
    given = np.linspace((0.0, 0.0), (0.03, 0.04), 6)
    path = jnp.asarray(given)
    ahead = np.array([0.6, 0.8])
    np.testing.assert_allclose(correct_path(path, 0.01, 0.0, jnp.zeros(2))[-1], given[-1] + 0.01 * ahead)
    np.testing.assert_allclose(correct_path(path, 0.01, 0.0, jnp.zeros(2))[0], path[0])
    np.testing.assert_allclose(
        correct_path(path, 0.0, 0.002, jnp.asarray([0.001, 0.0])), given - 0.002 * ahead + [0.001, 0]
    )
    # a recording with zigzags of roundoff is extended straight nevertheless
    rounded = jnp.asarray(np.round(np.linspace((0.0, 0.0), (0.03, 0.04), 101), 4))
    np.testing.assert_allclose(correct_path(rounded, 0.01, 0.0, jnp.zeros(2))[-1], given[-1] + 0.01 * ahead, atol=1e-4)
    shorter = correct_path(rounded, -0.01, 0.0, jnp.zeros(2))
    np.testing.assert_allclose(shorter, np.linspace((0.0, 0.0), 0.04 * ahead, 101), atol=1e-4)
    for still in (jnp.zeros((4, 2)), jnp.asarray([(0.0, 0), (0.01, 0), (0.01, 0), (0, 0)])):
        slopes = jax.jacrev(lambda p: correct_path(p, 0.01, 0.001, jnp.zeros(2)))(still)
        assert jnp.isfinite(slopes).all()


def test_polygon_inset():
    triangle = pj.Polygon([(0, 0), (0.15, 0), (0, 0.15)])
    smaller = triangle.inset(0.002)
    middle = np.asarray(smaller.vertices).mean(axis=0)
    for corner in np.asarray(smaller.vertices):
        # every corner is 2 mm from two sides
        assert float(triangle.signed_distance(corner)) == pytest.approx(-0.002)
    assert float(triangle.signed_distance(middle)) + 0.002 == pytest.approx(float(smaller.signed_distance(middle)))
    assert float(smaller.inset(-0.002).area) == pytest.approx(float(triangle.area))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: pj.Unknowns(friction=(0.3, 0.2)), r"friction must be \(lowest, highest\)"),
        (lambda: pj.Unknowns(friction=0.3), r"friction has shape \(\); expected \(2,\)"),
        (lambda: pj.Unknowns(inset=-0.001), "inset must be positive"),
        (lambda: pj.Unknowns(shared=("mu",)), "shared: 'mu' is not one of friction, surface"),
        (
            lambda: pj.Unknowns(friction=None, surface_dof=None),
            "give a prior for at least one of friction, surface_dof, pressure_center",
        ),
        (lambda: pj.Pushes(np.zeros((2, 3)), np.zeros((2, 4, 2)), np.zeros((3, 3))), "end has shape"),
        (lambda: pj.Pushes(np.zeros((2, 3)), np.zeros((2, 1, 2)), np.zeros((2, 3))), "at least one step"),
        (lambda: pj.Pushes(np.full((2, 3), np.nan), np.zeros((2, 4, 2)), np.zeros((2, 3))), "start must be finite"),
        (lambda: pj.Pushes(np.zeros((2, 3)), np.zeros((2, 4, 2)), np.zeros((2, 3)), [1, -1]), "weight must not be neg"),
        (lambda: pj.Pushes.conditions([]), "at least one condition"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_bad_arguments(pushes, square, expected, hand):
    slider = pj.Slider(square, expected)
    for arguments, message in (
        ({"friction": -0.1}, "friction must not be negative"),
        ({"friction": [0.1, 0.2]}, "friction has shape"),
        ({"length": 0.0}, "length must be positive"),
        ({"sigma": np.nan}, "sigma must be finite"),
        ({"robust": -1.0}, "robust must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            pj.identify(pushes, slider, hand, **arguments)
    with pytest.raises(ValueError, match="path has 2 columns"):
        pj.identify(pushes, slider, pj.Hand.two_fingers(0.002))


@pytest.mark.slow
def test_contact_at_end_determines_offsets(square, real, expected, hand, tmp_path):
    """The condition that finger and slider touch reveals the offset of the tip and of the frame.

    The final poses are off by millimeters along the side, but by only about a tenth of a millimeter across it. Fingers
    that have lost the slider do not matter.
    """
    rng = np.random.default_rng(8)
    starts, paths = planned(rng, 60)
    hand_offset, frame_offset = np.array([0.0012, -0.0008]), np.array([-0.0006, 0.0009, 0.01])
    slider = pj.Slider(square, real)

    @jax.jit
    @jax.vmap
    def ends(start, path):
        run = pj.rollout(slider, hand, path + hand_offset[None], pose=compose(start, frame_offset), friction=MU)
        return run.pose[-1]

    really = np.array(ends(jnp.asarray(starts), jnp.asarray(paths)))
    # 3 mm along the side that is touched, 0.1 mm across it
    for k, pose in enumerate(really):
        tip = paths[k, -1] + hand_offset
        _, point, normal = square.closest(pj.se2.transform(pj.se2.inverse(pose), tip))
        tangent = np.array([-normal[1], normal[0]])
        rest = 0.02 - abs(float(point @ tangent))  # the finger stays on its side
        shift = np.clip(0.003 * rng.normal(), -max(rest, 0), max(rest, 0)) * tangent + 1e-4 * rng.normal() * normal
        really[k] = compose(pose, np.array([*shift, 0.0]))
    really[:4, :2] += 0.02  # lost the finger
    measured = compose(really, inverse(frame_offset))
    pushes = pj.Pushes(starts, paths, measured)
    unknowns = pj.Unknowns((0.0, 1.0), surface_dof=50, inset=1e-3, hand_offset=2e-3, frame_offset=1e-3)
    mean = pj.Slider(square, expected)
    found = pj.identify(pushes, mean, hand, unknowns, contact_at_end=True)
    assert 0.5e-4 < float(found.gap_sigma) < 3e-4
    own = found.parameters
    assert own.frame_offset is not None
    off = [*(own.hand_offset - hand_offset), *(own.frame_offset[:2] - frame_offset[:2])]
    assert np.linalg.norm(off) < 2.5e-4
    low, high = found.interval(0.99)["hand_offset"]
    assert np.all((low < hand_offset) & (hand_offset < high))
    found.save(tmp_path / "found.json")
    again = pj.Identified.load(tmp_path / "found.json")
    assert jax.tree.structure(again) == jax.tree.structure(found)
    np.testing.assert_array_equal(again.gap_sigma, found.gap_sigma)
    # profile and bootstrap use the condition too
    profile = found.profile(pushes, mean, hand, "hand_offset.0", points=1)
    assert profile.log_posterior_drop[1] < profile.log_posterior_drop[0]
    samples = found.bootstrap(jax.random.key(0), pushes, mean, hand, 4)
    assert np.all(np.linalg.norm(np.asarray(samples.hand_offset) - hand_offset, axis=1) < 5e-4)
    with pytest.raises(ValueError, match="condition 0 has no push with a weight"):
        found.bootstrap(jax.random.key(0), pushes.weighted(0 * pushes.weight), mean, hand, 4)
    two = pj.Hand.two_fingers(RADIUS)
    wide = pj.Pushes(starts, jnp.zeros((*paths.shape[:2], two.dof)), starts)
    with pytest.raises(ValueError, match="contact_at_end is for a single round finger; the hand has 2 fingers"):
        pj.identify(wide, mean, two, contact_at_end=True)
