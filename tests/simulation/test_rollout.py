"""Pushes: recorded answers, and the laws that every push obeys."""

import itertools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pushjax import (
    ContactMode,
    Contacts,
    Disk,
    Ellipsoid,
    Hand,
    HessianIteration,
    Polygon,
    Quartic,
    Slider,
    Status,
    Trajectory,
    line,
    rollout,
    solve_contacts,
    step,
)
from pushjax.friction.sum_of_squares import squared_quadratics
from pushjax.testing.problems import random_surface

# The error of the recorded rollouts is below 1e-6 m. This is the error of our scheme with 100 steps of 0.5 mm.
RECORDED_DISTANCE, RECORDED_ANGLE = 5e-5, np.deg2rad(0.05)
# Largest difference between steps of 1 mm and the converged push.
STEP_DISTANCE, STEP_ANGLE = 3e-5, np.deg2rad(0.03)
# Largest remaining overlap, by step: second order where the contact moves around the finger.
PENETRATION = {1e-3: 1e-5, 5e-3: 2e-4}
# Sums of about a hundred roundings of numbers of order 0.1 m.
ROUNDING = 1e-12
# Largest remaining overlap after many steps: that of one step, not the sum of all before it.
LEFT_OVER = 1e-7
FLOAT32_DISTANCE = 2e-5

SQUARE = 0.045 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
RADIUS = 0.00475
LENGTH = 0.03
# Every push is padded to this many steps and every batch to this many rows, so that one compiled program serves them
# all. Steps after a push's own are dropped.
STEPS, ROWS = 400, 64
LONE = 33  # configurations of plain calls, which are compiled for 32 steps
SURFACE = np.asarray(cast(Quartic, random_surface(jax.random.key(5), condition=10.0, length=LENGTH)).coefficients)


class Push(NamedTuple):
    """One push in arrays; `path` is (steps + 1, 2)."""

    path: Any
    pose: Any = np.zeros(3)
    friction: Any = 0.25
    radius: Any = RADIUS
    vertices: Any = SQUARE
    surface: Any = SURFACE
    length: Any = LENGTH


class Pushed(NamedTuple):
    """Results of a push, without the padding."""

    path: Any
    pose: Any
    twist: Any
    wrench: Any
    force: Any
    mode: Any
    status: Any
    gap: Any  # (steps + 1,), of the finger
    finger: Any  # (steps + 1, 2), its center in the body frame


def run(p: Push):
    convex = True if p.vertices.shape[-2] <= 4 else None  # if traced, it would be treated as possibly not convex
    surface = (Quartic if p.surface.ndim == 1 else Ellipsoid)(p.surface, p.length)
    slider = Slider(Polygon(p.vertices, convex=convex), surface)
    push = rollout(slider, Hand.finger(p.radius), p.path, pose=p.pose, friction=p.friction)
    c, s = jnp.cos(push.pose[:, 2]), jnp.sin(push.pose[:, 2])
    d = p.path - push.pose[:, :2]
    finger = jnp.stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1)
    gap = jax.vmap(slider.shape.signed_distance)(finger) - p.radius
    return Pushed(p.path, push.pose, push.twist, push.wrench, push.force, push.mode, push.status, gap, finger)


run_batch = jax.jit(jax.vmap(run))


def run_all(pushes: list[Push], dtype: Any = np.float64) -> list[Pushed]:
    """Run every push by the one compiled program."""
    results = []
    for at in range(0, len(pushes), ROWS):
        some = pushes[at : at + ROWS]
        rows = some + [some[-1]] * (ROWS - len(some))
        padded = [
            p._replace(path=np.concatenate([p.path, np.repeat(p.path[-1:], STEPS + 1 - len(p.path), axis=0)]))
            for p in rows
        ]
        stacked = Push(*(jnp.asarray(np.stack(column), dtype) for column in zip(*padded, strict=True)))
        out = jax.tree.map(np.asarray, run_batch(stacked))
        for row, p in enumerate(some):
            n = len(p.path)
            own = Pushed(*(field[row][: n if field.shape[1] == STEPS + 1 else n - 1] for field in out))
            results.append(own)
    return results


def straight(start, direction: float, length: float, steps: int, **kwargs) -> Push:
    """Return a straight push from `start`, with `direction` in degrees."""
    a = np.deg2rad(direction)
    path = np.asarray(start) + np.linspace(0, length, steps + 1)[:, None] * np.array([np.cos(a), np.sin(a)])
    return Push(path, **kwargs)


def distance(a: np.ndarray, b: np.ndarray) -> tuple[float, float]:
    """Return the distance of two poses, m and rad."""
    return float(np.linalg.norm(a[:2] - b[:2])), float(abs(a[2] - b[2]))


def fan(steps: int, **kwargs) -> list[Push]:
    """Return 50 mm pushes over one side of the square, from everywhere along it and in all directions."""
    return [
        straight((-0.045 - RADIUS, offset), direction, 0.05, steps, **kwargs)
        for offset in np.linspace(-0.04, 0.04, 8)
        for direction in np.linspace(-60, 60, 8)
    ]


# --- recorded answers ---


def eight_corners(vertices: np.ndarray) -> np.ndarray:
    """Return the same polygon with its longest edges split, so that all but the square share one program."""
    while len(vertices) < 8:
        edge = np.roll(vertices, -1, axis=0) - vertices
        longest = np.argmax(np.hypot(edge[:, 0], edge[:, 1]))
        vertices = np.insert(vertices, longest + 1, vertices[longest] + edge[longest] / 2, axis=0)
    return vertices


@pytest.fixture(scope="module")
def recorded(oracle):
    d = dict(np.load(oracle / "rollouts_push.npz"))
    assert len(d["mu"]) == 70
    assert d["ode_completed_ref_tight"].all()
    return d


def recorded_push(d, row: int, start: int = 0, squared: bool = True) -> Push:
    """Return the push of row `row` from its recorded sample `start` of 20, in steps of 0.5 mm.

    An ellipsoid is given by its square, with the same level set and twists, so that all share a program.
    """
    surface = d["A"][row] if d["ls_type"][row] == 0 else d["coeffs"][row]
    if squared and surface.ndim == 2:
        surface = np.asarray(squared_quadratics(jnp.asarray(surface)[None]))
    t = np.linspace(start / 20, 1, 101 - 5 * start)[:, None]
    return Push(
        path=d["hand_q0"][row, :2] * (1 - t) + d["hand_q1"][row, :2] * t,
        pose=d["obj_ref_tight"][row, start],
        friction=d["mu"][row],
        radius=d["finger_radius"][row],
        vertices=eight_corners(d["vertices"][row, : d["n_vertices"][row]]),
        surface=surface,
        length=d["rho"][row],
    )


KINKED = 19


@pytest.mark.parametrize("squared", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["quartic", "ellipsoid"])
def test_recorded_pushes(recorded, squared):
    rows = np.flatnonzero((squared | (recorded["ls_type"] == 0)) & (np.arange(70) != KINKED))
    given = [recorded_push(recorded, row, squared=squared) for row in rows.tolist()]
    for row, push in zip(rows, run_all(given), strict=True):
        far, turned = distance(push.pose[-1], recorded["final_pose_ref_tight"][row])
        assert far < RECORDED_DISTANCE, row
        assert turned < RECORDED_ANGLE, row
        assert np.isin(push.status, [Status.FREE, Status.MOVING]).all()


def test_recorded_push_with_a_kink(recorded):
    """One recorded path has a kink, between samples 10 and 11 of a push that sticks throughout.

    Ours is smooth there and does not depend on the step, so each side of the kink is compared separately.
    """
    path = recorded["obj_ref_tight"][KINKED]
    whole, rest, fine = run_all(
        [
            recorded_push(recorded, KINKED),
            recorded_push(recorded, KINKED, start=11),
            recorded_push(recorded, KINKED)._replace(
                path=line(recorded["hand_q0"][KINKED, :2], recorded["hand_q1"][KINKED, :2], 400)
            ),
        ]
    )

    def jumps(poses):
        """Return changes of theta's second difference, rad, between samples 3 and 4, ... (contact is made by 2)."""
        return np.abs(np.diff(poses[2:, 2], 3))

    theirs, ours = jumps(path), jumps(whole.pose[::5])
    at_kink = np.isin(np.arange(3, 19), [9, 10, 11])
    assert theirs[at_kink].min() > 7e-4
    assert theirs[~at_kink].max() < 2e-5
    assert ours.max() < 2e-5
    pressed = whole.mode[10:, 0]
    assert (pressed == ContactMode.STICKING).all()
    assert distance(whole.pose[-1], fine.pose[-1])[0] < 1e-6
    assert distance(whole.pose[-1], fine.pose[-1])[1] < np.deg2rad(1e-3)

    for ours, theirs in ((whole.pose[50], path[10]), (rest.pose[-1], path[-1])):
        far, turned = distance(ours, theirs)
        assert far < RECORDED_DISTANCE
        assert turned < RECORDED_ANGLE


# --- accuracy ---


def arc(start, direction: float, length: float, turn: float, steps: int, **kwargs) -> Push:
    """Return a push whose direction rotates by `turn` degrees on the way."""
    t = np.linspace(0, 1, steps + 1)
    a = np.deg2rad(direction + turn * (t[1:] + t[:-1]) / 2)
    chord = 2 * np.sin(np.deg2rad(turn) / 2 / steps) / (np.deg2rad(turn) / steps) * length / steps
    hops = chord * np.stack([np.cos(a), np.sin(a)], axis=1)
    return Push(np.asarray(start) + np.concatenate([np.zeros((1, 2)), np.cumsum(hops, axis=0)]), **kwargs)


@pytest.mark.parametrize(
    ("mode", "arguments"),
    [
        (ContactMode.STICKING, {"direction": 5.0, "turn": 10.0, "friction": 2.0}),
        (ContactMode.STICKING, {"direction": -10.0, "turn": 20.0, "friction": 2.0, "radius": 0.0}),
        (ContactMode.SLIDING_LEFT, {"direction": 30.0, "turn": 5.0, "friction": 0.05}),
        (ContactMode.SLIDING_RIGHT, {"direction": -35.0, "turn": -5.0, "friction": 0.0}),
    ],
)
def test_second_order_within_a_mode(mode, arguments):
    radius = arguments.get("radius", RADIUS)
    start = (-0.045 - radius, -0.01 if mode == ContactMode.SLIDING_LEFT else 0.012)
    counts = (12, 24, 48, 400)
    pushes = run_all([arc(start, length=0.03, steps=n, **arguments) for n in counts])
    for push in pushes:
        assert (push.mode == mode).all()
    errors = [np.linalg.norm((push.pose[-1] - pushes[-1].pose[-1]) * [1, 1, LENGTH]) for push in pushes[:-1]]
    assert errors[-1] > 1e-9  # well above roundoff
    for coarse, fine in itertools.pairwise(errors):
        assert coarse / fine >= 3.5


def test_fan_at_one_millimeter_steps():
    """Pushes with every mode, mode changes and slips off the corner: 1 mm steps agree with the converged push."""
    coarse, fine = run_all(fan(50)), run_all(fan(400))
    modes = np.concatenate([push.mode[:, 0] for push in coarse])
    assert np.isin(list(ContactMode), modes).all()
    errors = np.array([distance(a.pose[-1], b.pose[-1]) for a, b in zip(coarse, fine, strict=True)])
    assert errors[:, 0].max() < STEP_DISTANCE
    assert errors[:, 1].max() < STEP_ANGLE


@pytest.mark.parametrize("radius", [RADIUS, 0.001])
@pytest.mark.parametrize("size", [1e-3, 5e-3])
def test_penetration(radius, size):
    for friction in (0.0, 0.25, 2.0):
        pushes = run_all(fan(round(0.05 / size), radius=radius, friction=friction))
        assert min(push.gap.min() for push in pushes) > -PENETRATION[size]


def test_penetration_does_not_accumulate():
    """The penetration does not accumulate over a 400 mm push."""
    pushes = run_all([straight((-0.045 - RADIUS, y), d, 0.4, 400) for y in (-0.01, 0.01) for d in (-5.0, 0.0, 8.0)])
    for push in pushes:
        assert push.gap.min() > -PENETRATION[1e-3]
        assert push.gap[200:].min() > -LEFT_OVER


# --- contact laws ---


def test_thin_bars_are_not_tunnelled_through():
    bar = np.array([[-0.0015, -0.045], [0.0015, -0.045], [0.0015, 0.045], [-0.0015, 0.045]])
    pushes = run_all([straight((-0.02, y), 0, 0.06, 2, radius=0.001, vertices=bar) for y in (-0.01, 0.0, 0.02)])
    for push in pushes:
        assert (push.status == Status.MOVING).all()
        assert (push.finger[:, 0] < 0).all()  # still on its own side
        assert push.pose[-1, 0] > 0.02


def test_no_contact_with_the_extension_of_an_edge():
    """A finger passes just beside a corner, along the extension of an edge or across it, in long and short steps."""
    past = 0.045 + RADIUS + 1e-9
    still = np.array([0.0, 0.0, 0.0])
    pushes = []
    for steps in (1, 2, 7, 400):
        pushes += [
            straight((-0.1, past), 0, 0.2, steps),
            straight((-past, -0.1), 90, 0.2, steps),
            straight((-0.045 - RADIUS * 0.8, 0.1), 180, 0.2, steps),
            # 45 degrees past the corner (-45, 45) mm
            straight(np.array([-0.045, 0.045]) + (RADIUS + 1e-9) * np.array([-1, 1]) / 2**0.5 - 0.06, 45, 0.17, steps),
        ]
    for push in run_all(pushes):
        assert (push.status == Status.FREE).all()
        np.testing.assert_array_equal(push.pose, np.tile(still, (len(push.pose), 1)))
        assert not push.twist.any()
        assert not push.force.any()


ANGLE = eight_corners(np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.03], [0.03, 0.03], [0.03, 0.1], [0.0, 0.1]]) - 0.035)


def test_from_one_wall_to_another_within_a_step():
    """The finger leaves one wall of a concave corner and hits the other in the same step."""
    start = np.array([0.03 + RADIUS, 0.09]) - 0.035
    end = start + np.array([0.01, -0.09 + 0.03 + RADIUS - 0.002])  # 2 mm past the other wall
    pushes = [Push(start + np.linspace(0, 1, n + 1)[:, None] * (end - start), vertices=ANGLE) for n in (1, 3, 400)]
    once, thrice, fine = run_all(pushes)
    assert once.status[0] == Status.MOVING
    assert abs(once.gap[-1]) < 1e-5
    assert once.pose[-1, 1] < -1e-4
    for push in (once, thrice):
        far, turned = distance(push.pose[-1], fine.pose[-1])
        assert far < STEP_DISTANCE
        assert turned < STEP_ANGLE


def test_sliding_into_a_concave_corner():
    """Wedged between two walls, the finger has two contacts and overlaps neither."""
    start = np.array([0.03 + RADIUS, 0.06]) - 0.035
    push = run_all([straight(start, -120, 0.05, 100, vertices=ANGLE, friction=0.1)])[0]
    assert np.isin(push.status, [Status.MOVING, Status.FREE]).all()
    assert push.gap.min() > -2e-5


def test_a_finger_that_touches_may_leave_and_cross_a_hollow(rng):
    """It then pushes the other side from where it meets it; the one that it leaves does not matter."""
    arms = [(-50, -50), (50, -50), (50, 50), (25, 50), (25, -20), (-25, -20), (-25, 50), (-50, 50)]
    gap = np.repeat([0.0, 1e-12, -1e-6, 1e-4], 6)
    starts = np.stack([-0.019 + gap, rng.uniform(0, 0.04, 24)], axis=1)
    ends = starts + np.stack([rng.uniform(0.0385, 0.0405, 24), rng.uniform(-2e-3, 2e-3, 24)], axis=1)
    given = {"vertices": np.array(arms) * 1e-3, "radius": 0.006, "friction": 0.3}
    coarse, fine = (
        np.stack(
            [
                push.pose[-1]
                for push in run_all([Push(line(a, b, n), **given) for a, b in zip(starts, ends, strict=True)])
            ]
        )
        for n in (1, 64)
    )
    np.testing.assert_allclose(coarse, fine, atol=2e-4)
    assert np.max(np.abs(fine)) > 1e-3


def test_free_motion_leaves_the_pose_bit_identical():
    pose = np.array([0.1, -0.2, 0.7])
    pushes = run_all([straight((-0.3, y), 20, 0.2, 50, pose=pose) for y in (-0.4, 0.1, 0.3)])
    for push in pushes:
        assert (push.status == Status.FREE).all()
        np.testing.assert_array_equal(push.pose, np.tile(pose, (51, 1)))


def test_hand_that_stands_still_moves_nothing():
    touching = straight((-0.045 - RADIUS, 0.01), 0, 0.0, 3)
    apart = straight((-0.06, 0.01), 0, 0.0, 3)
    at_rest, free = run_all([touching, apart])
    np.testing.assert_allclose(at_rest.pose, 0, rtol=0, atol=1e-16)
    np.testing.assert_array_equal(free.pose, 0)


def test_overlap_is_pushed_out_within_one_step():
    for depth in (1e-4, 1e-3, 4e-3):
        onward = straight((-0.045 - RADIUS + depth, 0.02), 20, 0.01, 10)
        beside = straight((-0.045 - RADIUS + depth, 0.02), 90, 0.005, 10)
        for push in run_all([onward, beside]):
            assert push.gap[0] == pytest.approx(-depth, rel=1e-6)
            assert push.gap[1] > -0.01 * depth - 1e-9
            assert push.gap.min() == push.gap[0]


def test_point_finger_that_sticks_does_not_slip():
    kind = {"radius": 0.0, "friction": 1.0}
    pushes = run_all([straight((-0.045, y), d, 0.04, 100, **kind) for y in (-0.01, 0.012) for d in (5, -5)])
    for push in pushes:
        assert (push.mode == ContactMode.STICKING).all()
        assert abs(push.pose[-1, 2]) > 0.1
        assert np.abs(push.finger - push.finger[0]).max() < ROUNDING


def test_round_finger_that_sticks_rolls():
    """The finger does not rotate, so if the slider rotates the contact moves along the edge by radius x angle."""
    slips = []
    for steps in (25, 50, 100):
        push = run_all([straight((-0.045 - RADIUS, 0.02), 5, 0.05, steps, friction=2.0)])[0]
        assert (push.mode == ContactMode.STICKING).all()
        assert abs(push.pose[-1, 2]) > 0.1
        rolled = push.finger[:, 1] - push.finger[0, 1] - RADIUS * (push.pose[:, 2] - push.pose[0, 2])
        slips.append(np.abs(np.diff(rolled)).max())
    for coarse, fine in itertools.pairwise(slips):
        assert coarse / fine > 7  # per step; third order gives 8


def test_dissipation_and_friction_cone_at_each_step():
    for friction in (0.0, 0.3, 1.5):
        for push in run_all(fan(50, friction=friction)):
            moves = push.status == Status.MOVING
            power = np.sum(push.twist * push.wrench, axis=1)
            assert (power[moves] > 0).all()
            fn, ft = push.force[:, 0, 0], push.force[:, 0, 1]
            assert (fn[moves] > 0).all()
            assert (np.abs(ft) <= friction * fn * (1 + 1e-12)).all()
            for idle in (push.twist, push.wrench, push.force, push.mode):
                assert not idle[~moves].any()
            np.testing.assert_array_equal(push.pose[1:][~moves], push.pose[:-1][~moves])


def test_going_on_is_the_same_as_one_push():
    pushes = fan(50)
    whole = run_all(pushes)
    rest = [p._replace(path=p.path[20:], pose=done.pose[20]) for p, done in zip(pushes, whole, strict=True)]
    for a, b in zip(whole, run_all(rest), strict=True):
        np.testing.assert_array_equal(b.pose, a.pose[20:])
        np.testing.assert_array_equal(b.force, a.force[20:])


# --- different programs ---


def lone(p: Push) -> Trajectory:
    """Run the first steps of a push by a plain call."""
    slider = Slider(Polygon(p.vertices), Quartic(p.surface, p.length))
    return rollout(slider, Hand.finger(p.radius), p.path[:LONE], pose=p.pose, friction=p.friction)


def test_batched_and_single_pushes_agree():
    pushes = fan(50)[3::9]
    for p, batched in zip(pushes, run_all(pushes), strict=True):
        single = lone(p)
        np.testing.assert_allclose(single.pose, batched.pose[:LONE], rtol=0, atol=ROUNDING)
        np.testing.assert_array_equal(single.mode, batched.mode[: LONE - 1])
        np.testing.assert_array_equal(single.status, batched.status[: LONE - 1])


def test_slider_left_at_a_corner_stays_still():
    """The slider stays still when the finger slides off a corner.

    Straight out from the corner both edges are equally near. When the fields of two edges could be mixed at such a tie,
    a batched push jumped by millimeters.
    """
    pushes = [
        straight((-0.05025, y), direction, 0.05, 50)
        for y in (0.025, 0.026, 0.024, 0.03)
        for direction in np.linspace(52.5, 67.5, 16)
    ]
    exact = straight((-0.05025, 0.025), 60, 0.05, 50)
    results = run_all([exact, *pushes[1:]])
    for push in results:
        last = np.flatnonzero(push.status == Status.MOVING)[-1]
        assert 5 < last < 49  # it did slide off
        np.testing.assert_array_equal(push.pose[last + 1 :], np.tile(push.pose[last + 1], (50 - last, 1)))
        assert np.linalg.norm(np.diff(push.pose[:, :2], axis=0), axis=1).max() < 1e-3
    np.testing.assert_allclose(results[0].pose[:LONE], lone(exact).pose, rtol=0, atol=ROUNDING)


def test_float32_is_close_to_float64():
    for steps in (50, 400):
        pushes = fan(steps)
        for exact, rough in zip(run_all(pushes), run_all(pushes, np.float32), strict=True):
            assert rough.pose.dtype == np.float32
            for field in (rough.pose, rough.twist, rough.wrench, rough.force):
                assert np.isfinite(field).all()
            assert np.linalg.norm(rough.pose[:, :2] - exact.pose[:, :2], axis=1).max() < FLOAT32_DISTANCE
            assert np.abs(rough.pose[:, 2] - exact.pose[:, 2]).max() < FLOAT32_DISTANCE / LENGTH


# --- single calls ---

SLIDER = Slider(Polygon(SQUARE), Quartic(SURFACE, LENGTH))
HAND = Hand.finger(RADIUS)
PATH = line((-0.06, 0.01), (0.0, 0.015), 20)
PUSH = {"pose": np.zeros(3), "friction": 0.25}


def test_step_is_a_step_of_rollout():
    push = rollout(SLIDER, HAND, PATH, **PUSH)
    for i in (0, 4, 10):  # free, meeting, pushing
        one = step(SLIDER, HAND, PATH[i], PATH[i + 1], pose=push.pose[i], friction=0.25)
        np.testing.assert_allclose(one.pose, push.pose[i + 1], rtol=0, atol=ROUNDING)
        for field in ("twist", "wrench", "force", "contact_point", "contact_normal"):
            np.testing.assert_allclose(getattr(one, field), getattr(push, field)[i], rtol=0, atol=1e3 * ROUNDING)
        np.testing.assert_array_equal(one.mode, push.mode[i])
        assert one.status == push.status[i]
        assert one.status.dtype == one.mode.dtype == np.int8


def test_shapes_and_dtypes_of_a_trajectory():
    push = rollout(SLIDER, HAND, PATH, **PUSH)
    assert push.pose.shape == (21, 3)
    assert push.twist.shape == push.wrench.shape == (20, 3)
    assert push.force.shape == (20, 1, 2)
    assert push.mode.shape == (20, 1)
    assert push.status.shape == (20,)
    assert push.mode.dtype == push.status.dtype == np.int8
    assert not push.failed.any()
    assert push.first_failure == -1
    np.testing.assert_array_equal(push.pose[0], 0)
    # friction per finger, and lists
    same = rollout(SLIDER, HAND, np.asarray(PATH).tolist(), pose=[0, 0, 0], friction=[0.25])
    np.testing.assert_array_equal(push.pose, same.pose)


def test_paths_of_other_lengths_compile_no_rollout(caplog):
    """The parts of a path, each with another number of steps, run in the program of the whole path."""
    whole = rollout(SLIDER, HAND, PATH, **PUSH)
    with jax.log_compiles(), caplog.at_level("WARNING", logger="jax"):
        for steps in (1, 13, 19):
            part = rollout(SLIDER, HAND, PATH[: steps + 1], **PUSH)
            for name in Trajectory.__dataclass_fields__:
                entries = steps + (name in ("pose", "configuration"))
                np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[:entries])
    compiled = [record.getMessage() for record in caplog.records if record.getMessage().startswith("Compiling")]
    assert compiled, "what cuts the result to its length"
    assert not any("_rollout" in message for message in compiled)


def test_both_solvers_push_alike():
    root = rollout(SLIDER, HAND, PATH, **PUSH)
    hessian = rollout(SLIDER, HAND, PATH, **PUSH, solver=HessianIteration())
    assert (np.asarray(root.mode) == ContactMode.STICKING).any()
    np.testing.assert_allclose(hessian.pose, root.pose, rtol=0, atol=1e-10)


def test_disk_pushed_through_its_center():
    """An isotropic slider with a central push moves straight, by the travel minus the gap."""
    slider = Slider(Disk(0.05), Ellipsoid(np.eye(3), LENGTH))
    push = rollout(slider, HAND, line((-0.06, 0.0), (0.0, 0.0), 20), **PUSH)
    np.testing.assert_allclose(push.pose[-1], [0.05 + RADIUS, 0, 0], rtol=0, atol=ROUNDING)


def test_step_solves_the_contact_it_reports():
    """A sticking step's reported twist and force are those of `solve_contacts` for the same contact."""
    start = np.array([-0.045, 0.01])
    push = np.array([1e-9, 1e-10])  # so short that halfway is at the start
    one = step(SLIDER, Hand.finger(0.0), start, start + push, pose=np.zeros(3), friction=0.5)
    motion = solve_contacts(SLIDER.surface, Contacts(start[None], [[1.0, 0.0]], push[None], 0.5))
    np.testing.assert_allclose(one.twist, motion.twist, rtol=1e-6)
    np.testing.assert_allclose(one.force, motion.force, rtol=1e-6)


# --- bad input ---

BAD = [
    ({"pose": [0.0, np.nan, 0.0]}, "pose must be finite"),
    ({"pose": [0.0, 0.0]}, "pose has shape"),
    ({"pose": np.zeros((1, 3))}, "pose has shape"),
    ({"path": [[0.2, 0.0], [np.inf, 0.0]]}, "path must be finite; 1 configuration.* the first at index 1"),
    ({"path": [[0.2, 0.0]]}, "path needs at least one step"),
    ({"path": np.zeros((5, 3))}, "path has 3 columns; a configuration of this hand has 2: x, y"),
    ({"path": [0.2, 0.0]}, "path has shape"),
    ({"friction": -0.1}, "friction must not be negative"),
    ({"friction": np.nan}, "friction must be finite"),
    ({"friction": [0.1, 0.2]}, "friction has shape"),
    (
        {"path": [[0.0, 0.0], [0.1, 0.0]]},
        "path starts with the hand inside the slider.*overlaps it by .* mm; at most 6 mm",
    ),
]


@pytest.mark.parametrize(("change", "message"), BAD, ids=[f"{next(iter(c))}-{i}" for i, (c, _) in enumerate(BAD)])
def test_rollout_refuses_bad_input(change, message):
    arguments = {"path": PATH, **PUSH} | change
    with pytest.raises(ValueError, match=message):
        rollout(SLIDER, HAND, arguments.pop("path"), **arguments)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"q0": [0.2, np.nan]}, "q0 must be finite"),
        ({"q1": [np.inf, 0.0]}, "q1 must be finite"),
        ({"q0": [0.2, 0.0, 0.0]}, "q0 has shape"),
        ({"q1": 0.2}, "q1 has shape"),
        ({"pose": [np.nan, 0.0, 0.0]}, "pose must be finite"),
        ({"pose": 0.0}, "pose has shape"),
        ({"friction": -1.0}, "friction must not be negative"),
        ({"friction": np.zeros((1, 1))}, "friction has shape"),
    ],
)
def test_step_refuses_bad_input(change, message):
    arguments = {"q0": [-0.06, 0.0], "q1": [-0.05, 0.0], **PUSH} | change
    with pytest.raises(ValueError, match=message):
        step(SLIDER, HAND, arguments.pop("q0"), arguments.pop("q1"), **arguments)


def test_traced_failures_are_statuses():
    """Where values cannot be rejected, each step reports what was wrong, and the slider stays, with finite values."""
    good = straight((-0.055, 0.01), 0, 0.03, 30)
    deep = good._replace(path=good.path + np.array([0.05, 0.0]))
    gap_in_path = good.path.copy()
    gap_in_path[20] = np.nan
    holed = good._replace(path=gap_in_path)
    broken = {
        "friction": good._replace(friction=np.nan),
        "negative friction": good._replace(friction=-0.1),
        "surface": good._replace(surface=np.where(np.arange(15) == 3, np.nan, SURFACE)),
        "length": good._replace(length=np.nan),
        "zero length": good._replace(length=0.0),
    }
    reference, inside, hole, *others = run_all([good, deep, holed, *broken.values()])
    assert (inside.status == Status.OVERLAPPING).all()
    np.testing.assert_array_equal(inside.pose, np.zeros((31, 3)))
    assert not inside.twist.any()

    expected = np.isin(np.arange(30), [19, 20])
    np.testing.assert_array_equal(hole.status == Status.INVALID, expected)
    np.testing.assert_array_equal(hole.pose[:20], reference.pose[:20])
    np.testing.assert_array_equal(hole.pose[21], hole.pose[19])
    assert np.isfinite(hole.pose).all()
    assert (hole.status[21:] == Status.MOVING).all()

    for name, push in zip(broken, others, strict=True):
        assert (push.status[10:] == Status.INVALID).all(), name
        np.testing.assert_array_equal(push.pose, np.zeros((31, 3)), err_msg=name)
        for field in (push.twist, push.wrench, push.force):
            assert not field.any(), name


def test_first_failure():
    path = np.asarray(PATH).copy()
    path[7] = np.nan
    program = jax.jit(lambda q: rollout(SLIDER, HAND, q, **PUSH))
    good, bad = program(PATH), program(path)
    assert bad.first_failure == 6
    np.testing.assert_array_equal(np.flatnonzero(bad.failed), [6, 7])
    both = jax.tree.map(lambda *leaves: jnp.stack(leaves), good, bad)
    np.testing.assert_array_equal(both.first_failure, [-1, 6])
    np.testing.assert_allclose(good.pose, rollout(SLIDER, HAND, PATH, **PUSH).pose, rtol=0, atol=ROUNDING)
