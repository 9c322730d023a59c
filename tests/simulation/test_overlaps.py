"""No finger is inside a slider that reports MOVING: pushes and grasps checked by shapely, and a test for each cause.

`python -m benchmarks overlaps` is the same survey, for every shape and hand.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import pushjax as pj
from pushjax import plot
from pushjax._math.vec import Vec2, Vec3, cos_sin
from pushjax.plot.style import RED
from pushjax.simulation.candidate import FingerPose
from pushjax.simulation.detection import pair_of
from pushjax.simulation.finger_motion import finger_motions, max_penetration
from pushjax.simulation.hand import Pad, RoundFinger

shapely = pytest.importorskip("shapely")
from benchmarks import overlaps  # noqa: E402
from benchmarks import random_pushes as survey  # noqa: E402

STARTS = 60


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hand", "shape", "steps", "dtype"),
    [("jaw", "T", 300, np.float64), ("jaw", "U", 60, np.float32), ("two", "bean", 300, np.float32)],
)
def test_no_finger_is_inside(hand, shape, steps, dtype):
    pushes = survey.simulate(shape, hand, STARTS, steps, dtype)
    found = overlaps.checked(pushes, steps)
    assert found["wrong"] == 0, found["steps_wrong"]
    assert found["failed"] == 0, found["failures"]
    assert found["unconfirmed"] == []
    # the recorded depth is the one that the judge computes
    depth, own = overlaps.penetration_depths(pushes)[:, 1:], pushes.push.overlap
    deep = np.maximum(depth, own) > 1e-6
    assert deep.any()
    np.testing.assert_allclose(own[deep], depth[deep], atol=1e-6 if dtype == np.float64 else 2e-5, rtol=0.05)
    moved = np.any(pushes.push.status == pj.Status.MOVING, axis=1)
    assert moved.mean() > 0.3


# --- the depth ---


def random_polygon(rng, corners: int) -> np.ndarray:
    """Return a random polygon that does not cross itself, convex or not."""
    angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    while np.max(np.diff(np.append(angle, angle[0] + 2 * np.pi))) > 2.5:
        angle = np.sort(rng.uniform(0, 2 * np.pi, corners))
    return rng.uniform(0.02, 0.06, corners)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_depth_is_shapelys(rng):
    """The depth agrees with shapely's, for a round finger and a pad, apart, touching, or all the way through.

    It agrees to roundoff, or to a half where edges only cross.
    """
    finger, pad = RoundFinger(0.006), Pad(pj.Polygon.rectangle(0.05, 0.01))
    cases = 400
    vertices = np.stack([random_polygon(rng, 7) for _ in range(cases)])
    at, angle = rng.uniform(-0.07, 0.07, (cases, 2)), rng.uniform(-np.pi, np.pi, cases)

    @jax.jit
    @jax.vmap
    def depth(vertices, at, angle):
        outline = pj.Polygon(vertices).outline()
        there = FingerPose(Vec2.of(at), cos_sin(angle))
        return tuple(-pair_of(body, outline).distance(body, outline, there)[0] for body in (finger, pad))

    of_finger, of_pad = (np.asarray(each) for each in depth(vertices, at, angle))
    kinds = set()
    for k in range(cases):
        body, center = shapely.Polygon(vertices[k]), shapely.Point(at[k])
        signed = body.exterior.distance(center) * (-1 if body.contains(center) else 1)
        assert abs(of_finger[k] - (0.006 - signed)) < 1e-12
        c, s = np.cos(angle[k]), np.sin(angle[k])
        corners = at[k] + np.asarray(pad.shape.vertices) @ np.array([[c, s], [-s, c]])
        other = shapely.Polygon(corners)
        if not body.intersects(other):
            assert abs(of_pad[k] + body.distance(other)) < 1e-12
            kinds.add("apart")
            continue
        inside = [body.exterior.distance(shapely.Point(p)) for p in corners if body.contains(shapely.Point(p))]
        inside += [other.exterior.distance(shapely.Point(p)) for p in vertices[k] if other.contains(shapely.Point(p))]
        corner = max(inside, default=0.0)
        assert of_pad[k] >= corner - 1e-12
        if not inside:
            shared = body.intersection(other)
            width = shapely.maximum_inscribed_circle(shared, tolerance=1e-6).length
            assert of_pad[k] >= width / 2 - 1e-5
        kinds.add("corners" if inside else "across")
    assert kinds == {"apart", "corners", "across"}


# --- the causes ---

L = np.array([(0, 0), (120, 0), (120, 40), (40, 40), (40, 80), (0, 80)]) * 1e-3 - np.array([0.05, 0.03])
# two more vertices in the middle of edges: as many as the U has, so that they share programs
L8 = np.insert(L, [1, 6], [(L[0] + L[1]) / 2, (L[5] + L[0]) / 2], axis=0)
JAW = pj.Hand.parallel_jaw(width=0.05, thickness=0.01)


@eqx.filter_jit
def candidates(pad, outline, pose, displacement, length=0.04):
    """Return where a pad and an outline may touch, with a pad that moves as a whole."""
    found = pair_of(pad, outline).candidates(pad, outline, pose, lambda _: displacement, jnp.asarray(length))
    return found.touches


def surface(length: float = 0.04) -> pj.Ellipsoid:
    return pj.Ellipsoid(np.eye(3), length)


@pytest.mark.slow
def test_an_inner_corner_touches_no_pad():
    """An inner corner was taken for a contact deep in the pad above it, and pushed the slider half a pad away."""
    outline = pj.Polygon(L).outline()
    lower = FingerPose(Vec2(jnp.asarray(0.02), jnp.asarray(0.016)), cos_sin(jnp.asarray(-0.11)))
    pad = JAW.fingers[0]
    still = Vec2(jnp.zeros(()), jnp.zeros(()))
    touches = candidates(pad, outline, lower, still)
    inner = 4 + 3  # after the four corners of the pad, the fourth of the outline
    np.testing.assert_allclose([touches.point.x[inner], touches.point.y[inner]], (-0.01, 0.01))
    assert not touches.exists[inner]
    slider = pj.Slider(pj.Polygon(L), surface())
    path = pj.line((0, 0, 0, 0.18), (0, 0, 0, 0.03), 300)
    push = pj.rollout(slider, JAW, path, pose=(0, 0.005, np.radians(20)), friction=0.3)
    assert int(push.first_failure) == -1
    assert pj.Status(int(push.status[-1])) == pj.Status.GRASPED
    assert float(jnp.max(push.overlap)) <= 0.1 * 0.25e-3 + 1e-9
    assert float(jnp.max(jnp.abs(jnp.diff(push.pose[:, 2])))) < 0.1


def in_place(q):
    return q[None]


PAD, LONG_PAD = (pj.Hand((pj.Polygon.rectangle(*sides),), in_place, 3) for sides in ((0.03, 0.02), (0.05, 0.01)))


@pytest.mark.slow
@pytest.mark.parametrize("short", [0.0, 1e-9, -1e-9])
@pytest.mark.parametrize("way", [(-1, -1), (-1, -0.3), (-0.3, -1), (-0.05, -1)])
def test_a_pad_in_an_inner_corner_touches_both_edges(way, short):
    """A pad flat on both edges touches in four places, of which three bind: the slider follows without rotation."""
    corner = L[3] + np.array([0.015, 0.01]) + short
    path = pj.line((*corner, 0.0), (*(corner + 0.03 * np.array(way)), 0.0), 30)
    push = pj.rollout(pj.Slider(pj.Polygon(L8), surface()), PAD, path, pose=(0, 0, 0), friction=0.3)
    assert set(np.asarray(push.status).tolist()) == {pj.Status.MOVING}
    np.testing.assert_allclose(push.pose[-1], [*(0.03 * np.array(way)), 0], atol=1e-7)
    assert push.force.shape == (30, 3, 2)


@pytest.mark.slow
@pytest.mark.parametrize("aside", [-0.0042, 0.0, 0.0049])
def test_a_pad_across_two_arms_rests_on_its_outermost_places(aside):
    """The contacts were the two nearest places, next to each other on one arm, and the other arm penetrated."""
    slider = pj.Slider(survey.shape_of("U"), surface())
    top = float(np.max(slider.shape.vertices[:, 1]))
    path = pj.line((aside, top + 0.005, 0.0), (aside, top - 0.025, 0.0), 30)
    push = pj.rollout(slider, LONG_PAD, path, pose=(0, 0, 0), friction=0.3)
    np.testing.assert_allclose(push.pose[-1], [0, -0.03, 0], atol=1e-12)


def test_a_corner_beside_two_edges_of_an_arm_touches_one():
    """A pad's corner slightly inside an arm's end is deep behind the arm's side, which it does not touch."""
    outline, pad = survey.shape_of("U").outline(), Pad(pj.Polygon.rectangle(0.05, 0.01))
    end = np.max(np.asarray(survey.shape_of("U").vertices), axis=0)
    for inside in (1e-4, 1e-9, 0.0, -1e-9):
        at = FingerPose(Vec2(*jnp.asarray(end - [0.030, inside - 0.005])), cos_sin(jnp.asarray(0.0)))
        touches = candidates(pad, outline, at, Vec2(jnp.zeros(()), -jnp.ones(())))
        near = np.asarray(touches.exists) & (np.asarray(touches.distance) < 1e-3)
        assert near.any()
        np.testing.assert_allclose(np.asarray(touches.distance)[near], -inside, atol=1e-12)
        np.testing.assert_allclose(np.asarray(touches.normal.y)[near], -1)


@pytest.mark.parametrize("past", [1e-4, 1e-6])
@pytest.mark.parametrize("shape", ["rectangle", "T"])
def test_a_corner_that_is_past_the_other_side_touches_no_side(shape, past):
    """A corner past the back of a pad, or past the other side of an arm, touches no side.

    Beside a pad's end and slightly past its back, a corner is not a pad's thickness behind the front. Nor is a pad's
    corner that juts out over an arm's end an arm's width behind the arm's other side.
    """
    outline, pad = survey.shape_of(shape).outline(), Pad(pj.Polygon.rectangle(0.05, 0.01))
    right, top = np.max(np.asarray(survey.shape_of(shape).vertices), axis=0)
    at = {
        "rectangle": [-right - 0.025, -top + 0.005 + past],  # at the slider's left side, its lower corner behind it
        "T": [0.015 + past - 0.025, top + 0.005],  # on the stem's end
    }[shape]
    there = FingerPose(Vec2(*jnp.asarray(at)), cos_sin(jnp.asarray(0.0)))
    for far in (0.0, 1e-5):
        away = there._replace(
            center=there.center + Vec2(*jnp.asarray([-far, 0.0] if shape == "rectangle" else [0.0, far]))
        )
        touches = candidates(pad, outline, away, Vec2(*jnp.zeros(2)), 0.1)
        near = np.asarray(touches.exists) & (np.asarray(touches.distance) < 1e-3)
        assert near.any()
        np.testing.assert_allclose(np.asarray(touches.distance)[near], far, atol=1e-12)


@pytest.mark.slow
def test_a_pad_whose_end_lies_flush_with_an_arms_end():
    """Corner on corner, each is past the other's edge or not, by roundoff, and touches it in either case."""
    slider = pj.Slider(survey.shape_of("T"), surface())
    tip = float(np.max(slider.shape.vertices[:, 1]))
    jaw = pj.Hand.parallel_jaw(width=0.05, thickness=0.01)
    path = pj.line((0, tip - 0.025, np.pi / 2, 0.08), (0, tip - 0.025, np.pi / 2, 0.02), 60)
    ends = jax.vmap(lambda off: pj.rollout(slider, jaw, path + off[None], pose=(0, 0, 0), friction=0.3))(
        jnp.asarray([[0, off, 0, 0] for off in (-1e-6, -1e-9, -1e-12, 0.0, 1e-12, 1e-9, 1e-6)])
    )
    assert np.all(ends.status[:, -1] == pj.Status.GRASPED)
    np.testing.assert_allclose(ends.pose[:, -1], ends.pose[:1, -1].repeat(7, 0), atol=1e-5)
    assert float(jnp.max(ends.overlap)) < 1e-5


@pytest.mark.slow
def test_a_rake_of_five_fingers_touches_in_ten_places():
    """More contacts than are solved together: those that the answer violates join the set."""
    rake = pj.Hand((0.005,) * 5, lambda q: q[None] + jnp.array([[0.022 * k, 0.0] for k in range(-2, 3)]), 2)
    starts = np.random.default_rng(3).uniform([-0.02, -0.02, -np.pi], [0.02, 0.02, np.pi], (40, 3))
    slider = pj.Slider(survey.shape_of("comb"), surface())
    path = np.asarray(pj.line((0.0, 0.09), (0.0, 0.0), 90))
    push = jax.jit(jax.vmap(lambda pose: pj.rollout(slider, rake, path, pose=pose, friction=0.3)))(starts)
    assert push.force.shape == (40, 90, 10, 2)
    depth = overlaps.penetration_depths(survey.Survey(rake, slider, path, starts, None, jax.tree.map(np.asarray, push)))
    fine = ~np.asarray(push.failed)
    assert np.mean(fine) > 0.999
    assert np.max(depth[:, 1:][fine]) < 1e-4 + 1e-9
    assert np.max(np.sum(np.asarray(push.mode) > 0, axis=-1)) >= 3


# Two fingers rotate a rectangle so far in the last of these steps that its corner would enter one of them.
SLIDER = pj.Slider(pj.Polygon.rectangle(0.09, 0.06), surface(0.03))
TWO = pj.Hand.two_fingers(0.008)
TURNING = pj.line((0, 0, 0, 0.105), (0, 0, 0, 0.0772), 4)
START = (0.012, 0.002, 0.6)
CLOSED = 0.0761  # opening at which a rectangle from there is held before the step ends


def turned(x) -> pj.Trajectory:
    """Simulate the push; x holds friction, pose, and how far the hand closes."""
    path = TURNING.at[-1, 3].set(x[4])
    return pj.rollout(SLIDER, TWO, path, pose=x[1:4], friction=x[0])


def whole_step(push: pj.Trajectory, path, friction: float) -> pj.Trajectory:
    """Divide the last step into many small ones, to find where it should end."""
    fine = pj.line(path[-2], path[-1], 128)
    return pj.rollout(SLIDER, TWO, fine, pose=push.pose[-2], friction=friction)


@pytest.mark.slow
def test_a_step_that_is_too_long_is_divided():
    """The last step closes until the rectangle is held, and turns it by 0.27 rad."""
    path = TURNING.at[-1, 3].set(CLOSED)
    push = turned(jnp.array([0.2, *START, CLOSED]))
    assert np.asarray(push.status).tolist() == [pj.Status.MOVING] * 3 + [pj.Status.GRASPED]
    fine = whole_step(push, path, 0.2)
    assert fine.status[-1] == pj.Status.GRASPED
    off = pj.deviation(push.pose[-1], fine.pose[-1], 0.03)
    # the hand stops at most a sixteenth of the step of 8 mm before the jam, and the slider may turn past it by as much
    assert abs(float(push.configuration[-1, 3] - fine.configuration[-1, 3])) < 5e-4
    assert float(off) < 3e-4
    assert float(jnp.max(push.overlap)) < 1e-4
    # the twist is that of the whole step, the chords of the turns of its parts
    turn = float(push.pose[-1, 2] - push.pose[-2, 2])
    assert 2 * np.sin(abs(turn) / 2) <= abs(float(push.twist[-1, 2])) <= abs(turn)
    np.testing.assert_allclose(2 * np.arcsin(push.twist[1, 2] / 2), push.pose[2, 2] - push.pose[1, 2], rtol=1e-12)
    alone = pj.step(SLIDER, TWO, path[-2], path[-1], pose=push.pose[-2], friction=0.2)
    np.testing.assert_allclose(alone.pose, push.pose[-1], atol=1e-12)
    np.testing.assert_allclose(alone.overlap, push.overlap[-1], atol=1e-12)


@pytest.mark.slow
def test_pushes_of_a_batch_divide_their_own_steps():
    """Some pushes divide a step, some end early, some never touch: each is the same in a batch of batches as alone."""
    rows = np.array([[0.2, *START, CLOSED], [0.2, *START, 0.1], [0.5, 0, 0, 0, 0.06], [0.3, 0.5, 0, 0, 0.0772]])
    nested = jax.jit(jax.vmap(jax.vmap(turned)))(jnp.asarray(rows).reshape(2, 2, -1))
    together = jax.tree.map(lambda leaf: leaf.reshape(4, *leaf.shape[2:]), nested)
    for k, row in enumerate(rows):
        alone = jax.tree.map(lambda leaf, k=k: leaf[k], together)
        for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(turned(jnp.asarray(row))), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
    assert pj.Status.GRASPED in np.asarray(together.status[2])


@pytest.mark.slow
def test_derivatives_of_a_divided_step():
    """Forward and reverse derivatives by friction, start and hand agree with central differences."""
    x, h = jnp.array([0.2, *START, 0.0772]), 1e-6
    final = lambda x: turned(x).pose[-1]  # noqa: E731
    forward, reverse = jax.jit(jax.jacfwd(final))(x), jax.jit(jax.jacrev(final))(x)
    ends = jax.jit(jax.vmap(final))(x[None] + h * jnp.concatenate([jnp.eye(5), -jnp.eye(5)]))
    central = (ends[:5] - ends[5:]).T / (2 * h)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, central, rtol=1e-5, atol=1e-6 * np.abs(central).max())
    assert np.abs(forward[:, 0]).max() > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "opening", "poses", "friction", "status"),
    [
        # the waist is 64 mm wide between the outer sides of the fingers
        (
            "peanut",
            0.065,
            [(-8.0375e-4, -5.0178e-4, 0.01843504), (2.2443e-3, 3.7954e-4, 0.0471798)],
            (0.07139, 0.07072),
            pj.Status.GRASPED,
        ),
        ("comb", 0.07, [(-0.01244619, -0.00076171, -0.2869193)], (0.11646,), pj.Status.MOVING),
    ],
)
def test_parts_of_a_step_that_come_near_a_jam(shape, opening, poses, friction, status):
    """When squeezed, the slider rotates faster the nearer it is to where it jams or slips out."""
    outline, hand, end = survey.shape_of(shape), survey.hand_of("two"), opening - 0.005
    slider = pj.Slider(outline, survey.surface_of(outline, jax.random.key(0)))
    path = pj.line((0, 0, 0, opening), (0, 0, 0, end), 1)
    push = jax.jit(jax.vmap(lambda pose, mu: pj.rollout(slider, hand, path, pose=pose, friction=mu)))
    found = push(np.array(poses), np.array(friction))
    np.testing.assert_array_equal(found.status[:, -1], status)
    assert float(jnp.max(found.overlap)) <= 0.1 * 0.0025
    wanted = 0.064 if status == pj.Status.GRASPED else end
    np.testing.assert_allclose(found.configuration[:, -1, 3], wanted, atol=2e-5)


# In the second step two fingers push the slider 30 m along a rail, which no part of it makes short enough.
RAIL = pj.Fixture(pj.Polygon.rectangle(100, 0.01), (0.0, -0.036, 0.0))
TOO_FAR = np.array([(-0.2, 0, 0, 0.04), (-0.19, 0, 0, 0.04), (30, 0, 0, 0.04), (30.01, 0, 0, 0.04)])


def pushed_too_far(pose, friction=0.0) -> pj.Trajectory:
    return pj.rollout(SLIDER, TWO, TOO_FAR, pose=pose, friction=friction, fixtures=(RAIL,))


def test_a_step_that_cannot_be_divided_is_the_first_failure():
    """The slider stays where that step began, also in the figure, and the hand moves on into it."""
    start = jnp.array([0.002, 0, 0.01])
    push = pushed_too_far(start)
    assert push.status.tolist() == [pj.Status.FREE, pj.Status.NOT_CONVERGED, pj.Status.FREE]
    assert int(push.first_failure) == 1
    assert np.all(np.asarray(push.pose) == np.asarray(start))
    assert bool(jnp.all(jnp.isfinite(push.overlap)))


@pytest.mark.slow
def test_a_step_that_cannot_be_divided_has_finite_derivatives():
    assert np.all(np.isfinite(jax.jacrev(lambda pose: pushed_too_far(pose).pose[-1])(jnp.array([0.002, 0, 0.01]))))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["disk", "bean"])
def test_hands_of_ones_own_and_smooth_sliders(name):
    """A pad with custom kinematics rotates onto a disk and a curve, which have no corners."""

    def swinging(q):
        return jnp.stack([jnp.stack([q[0], q[1], q[2]])])

    hand = pj.Hand((pj.Polygon.rectangle(0.05, 0.01),), swinging, 3)
    angle = 2 * np.pi * np.arange(16) / 16
    radius = 0.045 + 0.014 * np.cos(2 * angle) - 0.012 * np.sin(angle)
    bean = pj.Curve.through(radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    shape = bean if name == "bean" else pj.Disk(0.04)
    slider = pj.Slider(shape, surface())
    push = pj.rollout(slider, hand, pj.line((0, 0.08, 0), (0.01, 0.0, 1.0), 40), pose=(0, 0, 0.3), friction=0.3)
    body = survey.outline_of(shape)
    pushes = survey.Survey(hand, slider, None, None, None, jax.tree.map(lambda leaf: np.asarray(leaf)[None], push))
    assert body.is_valid
    assert int(push.first_failure) == -1
    assert pj.Status.MOVING in np.asarray(push.status)
    assert np.max(overlaps.penetration_depths(pushes)) < 0.1 * 0.0022


@pytest.mark.slow
def test_a_jam_is_confirmed_in_a_part_of_the_step():
    """To first order the whole step jams, but within it the slider rotates on, as it does in many small steps."""
    shape = survey.shape_of("L")
    slider, pose = pj.Slider(shape, survey.surface_of(shape, jax.random.key(0))), (0.01948941, 0.0082125, 3.0487692)
    begin, end = jnp.array([0.0, 0.0, 0.0, 0.085]), jnp.array([0.0, 0.0, 0.0, 0.080])
    whole = pj.step(slider, JAW, begin, end, pose=pose, friction=0.09509535)
    fine = pj.rollout(slider, JAW, pj.line(begin, end, 256), pose=pose, friction=0.09509535)
    assert pj.Status(int(whole.status)) == pj.Status.MOVING
    assert pj.Status(int(fine.status[-1])) == pj.Status.MOVING
    np.testing.assert_allclose(whole.pose, fine.pose[-1], atol=2e-3)
    assert float(whole.pose[2]) - pose[2] > 0.03


def deepest_of(push, friction):
    """Return the depth of the last pose, computed as for the check of a step."""
    where = TWO.poses(push.configuration[-1])
    ends = tuple(tuple(row) for row in where)
    return max_penetration(
        SLIDER.shape.outline(), finger_motions(TWO, friction, ends, ends), Vec3.of(push.pose[-1]), 1.0
    )


@pytest.mark.slow
def test_overlap_is_no_variable():
    x = jnp.array([0.2, *START, 0.0772])
    assert not np.any(jax.jacfwd(lambda x: turned(x).overlap)(x))
    push = turned(x)
    np.testing.assert_allclose(deepest_of(push, jnp.array([0.2, 0.2])), push.overlap[-1], atol=1e-12)


def test_pictures_name_the_step_that_failed():
    path, far = pj.line((0, 0, 0, 0.1), (0, 0, 0, 0.05), 32), pj.Fixture(RAIL.shape, (0.0, -1.0, 0.0))
    failing = pushed_too_far((0.002, 0, 0.01), 0.3)
    # far from the rail, with the program of the other
    fine = pj.rollout(SLIDER, TWO, path, pose=(0.002, 0, 0.1), friction=0.3, fixtures=(far,))
    figure = plot.push_figure(SLIDER.shape, TWO, {"slippery": failing, "rough": fine})
    titles = [axes.get_title() for axes in figure.axes]
    assert titles == [f"slippery\nNOT_CONVERGED from step {int(failing.first_failure)}", "rough"]
    moving = plot.animate(SLIDER.shape, TWO, {"slippery": failing, "rough": fine}, frames=3)
    moving.draw(2)
    words = [axes.texts[0] for axes in moving.figure.axes]
    assert words[0].get_text() == f"not converged at step {int(failing.first_failure)}"
    assert words[0].get_color() == RED
    assert words[1].get_text().startswith("held by every finger")
    plt.close("all")
