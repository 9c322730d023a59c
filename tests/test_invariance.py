"""The answer does not depend on what has no physical meaning: frames, order, units, pauses, neighbors, tracing.

A hand here is a tuple of fingers, and its configuration holds the pose of each of them. So hands whose fingers turn,
close and change places are all one program, and so are scenes that differ in their numbers only.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import pushjax as pj

STEPS = 12
SMALL_PART = 5e-4  # where steps are divided in other parts
EXACT = 1e-9  # m and rad: what roundoff becomes in twelve steps
SPLIT_M, SPLIT_RAD = 3e-3, 0.1  # where the sizes of steps differ
EXAMPLES = settings(max_examples=6, deadline=None, derandomize=True)
seeds = st.integers(0, 2**32 - 1)

SIDE = np.array([[-0.03, -0.02], [0.03, -0.02], [0.03, 0.02], [-0.03, 0.02]])
T = np.array([[-45, 10], [-45, -10], [-10, -10], [-10, -50], [10, -50], [10, -10], [45, -10], [45, 10]]) * 8e-4
L = (np.array([[0, 0], [90, 0], [90, 30], [30, 30], [30, 60], [0, 60]]) - [35, 22]) * 8e-4
ANGLES = np.pi / 5 * np.arange(10)
STAR = np.where(np.arange(10) % 2, 0.018, 0.035)[:, None] * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
BEAN = np.array([[30, 0], [22, 16], [0, 10], [-22, 16], [-30, 0], [-20, -18], [0, -22], [20, -18]]) * 1e-3
PAD = np.array([[-0.025, -0.005], [0.025, -0.005], [0.025, 0.005], [-0.025, 0.005]])


@dataclasses.dataclass(frozen=True)
class Scene:
    """A push in plain arrays, in which every number can be changed without compiling anything."""

    shape: Callable = pj.Polygon  # from `points`
    points: np.ndarray = dataclasses.field(default_factory=lambda: SIDE)
    A: np.ndarray = dataclasses.field(default_factory=lambda: np.eye(3))
    length: float = 0.03
    fingers: tuple = (0.006,)  # radii of disks, or vertices of pads
    path: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((2, 1, 3)))  # (steps + 1, fingers, 3)
    pose: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(3))
    friction: np.ndarray = dataclasses.field(default_factory=lambda: np.array([0.3]))
    fixtures: tuple = ()  # (kind, shape's points or radius, pose, friction)

    def but(self, **changes) -> "Scene":
        return dataclasses.replace(self, **changes)

    def slider(self) -> pj.Slider:
        return pj.Slider(self.shape(self.points), pj.Ellipsoid(self.A, length=self.length))

    def hand(self) -> pj.Hand:
        fingers = [pj.Polygon(f) if np.ndim(f) else f for f in self.fingers]
        return pj.Hand(fingers, KINEMATICS[len(fingers)], 3 * len(fingers))

    def bodies(self) -> list:
        found = []
        for kind, size, pose, friction in self.fixtures:
            if kind == "wall":
                found.append(pj.Wall(pose[:2], np.array([-np.sin(pose[2]), np.cos(pose[2])]), friction))
            else:
                found.append(pj.Fixture(pj.Disk(size) if kind == "disk" else pj.Polygon(size), pose, friction))
        return found

    def push(self) -> pj.Trajectory:
        rows = self.path.reshape(len(self.path), -1)
        return pj.rollout(
            self.slider(), self.hand(), rows, pose=self.pose, friction=self.friction, fixtures=self.bodies()
        )


KINEMATICS = {n: (lambda q, n=n: q.reshape(n, 3)) for n in (1, 2, 3)}


def rotated(points, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s], [-s, c]])


def placed(poses, angle, shift):
    """Poses (..., 3) after a rotation about the world's origin and a translation."""
    poses = np.asarray(poses)
    return np.concatenate([rotated(poses[..., :2], angle) + shift, poses[..., 2:] + angle], axis=-1)


def same(found, wanted, atol=EXACT):
    """Check poses (steps, 3) and statuses."""
    pose, status = found
    np.testing.assert_array_equal(status, wanted[1])
    np.testing.assert_allclose(pose, wanted[0], atol=atol, rtol=0)


def of(push: pj.Trajectory):
    return np.asarray(push.pose), np.asarray(push.status)


def surface(rng) -> np.ndarray:
    B = 0.3 * rng.normal(size=(3, 3))
    return np.eye(3) + B @ B.T


def approach(rng, reach, travel, turn=0.2, steps=STEPS) -> np.ndarray:
    """A finger that comes from `reach` m away and goes in, past the middle, turning about a far point."""
    way, aside, bend = rng.uniform(-np.pi, np.pi), rng.uniform(-0.5, 0.5) * reach, rng.uniform(-turn, turn)
    f = np.linspace(0, 1, steps + 1)
    rows = np.stack([-reach + travel * f, aside + 0 * f, np.pi / 2 + bend * f], axis=1)
    rows[:, 1] += 0.1 * travel * np.sin(bend * f)
    return placed(rows, way, 0)


def closing(rng, opened, closed, steps=STEPS) -> np.ndarray:
    """Two fingers that close on the origin while their axis turns, and their middle moves."""
    way, turn, drift = rng.uniform(-np.pi, np.pi), rng.uniform(-0.15, 0.15), rng.uniform(-0.01, 0.01, 2)
    f = np.linspace(0, 1, steps + 1)[:, None]
    angle, half = way + turn * f, (opened + (closed - opened) * f) / 2
    axis = np.concatenate([-np.sin(angle), np.cos(angle)], axis=1)
    return np.stack([np.concatenate([drift * f + s * half * axis, angle], axis=1) for s in (1, -1)], axis=1)


def three(rng) -> np.ndarray:
    first = closing(rng, 0.1, 0.06)
    return np.concatenate([first, approach(rng, 0.06, 0.02)[:, None]], axis=1)


SLIDERS = {
    "rectangle": (pj.Polygon, SIDE, 0.023),
    "T": (pj.Polygon, T, 0.025),
    "L": (pj.Polygon, L, 0.025),
    "star": (pj.Polygon, STAR, 0.018),
    "curve": (pj.Curve.through, BEAN, 0.018),
}
# One finger, two, three, a pad that turns as it pushes, and a jaw that turns as it closes.
HANDS = {
    "finger": ((0.006,), lambda rng: approach(rng, 0.06, 0.05)[:, None]),
    "two": ((0.006, 0.009), lambda rng: closing(rng, 0.1, 0.055)),
    "three": ((0.006, 0.009, 0.005), three),
    "pad": ((PAD,), lambda rng: approach(rng, 0.065, 0.045)[:, None]),
    "jaw": ((PAD, 0.8 * PAD), lambda rng: closing(rng, 0.1, 0.06)),
}
# Every slider and every hand is here, but not every pair: each is a program, which takes seconds to compile.
KINDS = [
    ("rectangle", "finger"),
    ("rectangle", "two"),
    ("rectangle", "three"),
    ("rectangle", "pad"),
    ("rectangle", "jaw"),
    ("T", "finger"),
    ("L", "pad"),
    ("star", "two"),
    ("curve", "finger"),
    ("curve", "pad"),
]
AMONG = ("rectangle", "finger", "fixtures")
# The programs of all others together take minutes to compile.
QUICK = (("rectangle", "finger"), ("rectangle", "jaw"), ("T", "finger"), AMONG)


def drawn(kind, seed: int) -> tuple[Scene, np.random.Generator]:
    """Return a random scene of a kind, and the generator for what is changed in it."""
    rng = np.random.default_rng(seed)
    (shape, points, length), (fingers, path) = SLIDERS[kind[0]], HANDS[kind[1]]
    scene = Scene(
        shape, points, surface(rng), length, fingers, path(rng), friction=rng.uniform(0.05, 0.6, len(fingers))
    )
    scene = scene.but(pose=np.array([*rng.uniform(-0.004, 0.004, 2), rng.uniform(-np.pi, np.pi)]))
    if len(kind) == 3:  # a wall, a box and a peg, on the side to which the finger pushes
        way = np.arctan2(*(scene.path[-1, 0, :2] - scene.path[0, 0, :2])[::-1])
        around = [
            ("wall", None, (0.05, 0, np.pi / 2)),
            ("box", PAD, (0.03, 0.055, 0.4)),
            ("disk", 0.01, (0.04, -0.055, 0.0)),
        ]
        mu = rng.uniform(0, 0.4, 3)
        fixtures = tuple((k, s, placed(at, way, 0), m) for (k, s, at), m in zip(around, mu, strict=True))
        scene = scene.but(fixtures=fixtures)
    return scene, rng


def each_of(kinds):
    marked = [pytest.param(kind, id="-".join(kind), marks=[pytest.mark.slow] * (kind not in QUICK)) for kind in kinds]
    return pytest.mark.parametrize("kind", marked)


def every_kind(test):
    return each_of([*KINDS, AMONG])(EXAMPLES(given(seed=seeds)(test)))


@every_kind
def test_scene_turned_and_moved(kind, seed):
    scene, rng = drawn(kind, seed)
    angle, shift = rng.uniform(-np.pi, np.pi), rng.uniform(-0.3, 0.3, 2)
    there = scene.but(
        path=placed(scene.path, angle, shift),
        pose=placed(scene.pose, angle, shift),
        fixtures=tuple((k, s, placed(p, angle, shift), m) for k, s, p, m in scene.fixtures),
    )
    pose, status = of(scene.push())
    same(of(there.push()), (placed(pose, angle, shift), status))


@every_kind
def test_scene_mirrored(kind, seed):
    scene, _ = drawn(kind, seed)
    flip, sign = np.array([1, -1]), np.array([1, -1, -1])
    turn_back = {"wall": np.array([0, 0, np.pi])}  # the normal (-sin, cos) is mirrored to (-sin, -cos)
    mirrored = scene.but(
        points=scene.points[::-1] * flip,
        A=scene.A * np.outer(sign, sign),
        fingers=tuple(f[::-1] * flip if np.ndim(f) else f for f in scene.fingers),
        path=scene.path * sign,
        pose=scene.pose * sign,
        fixtures=tuple(
            (k, s[::-1] * flip if k == "box" else s, p * sign + turn_back.get(k, 0), m) for k, s, p, m in scene.fixtures
        ),
    )
    pose, status = of(scene.push())
    same(of(mirrored.push()), (pose * sign, status))


@every_kind
@pytest.mark.filterwarnings("ignore:.*are its coordinates in millimeters")
def test_lengths_scaled(kind, seed):
    """In other units of length, between millimeters and kilometers, the push is the same."""
    scene, rng = drawn(kind, seed)
    k = 10 ** rng.uniform(-3, 3)
    scale = np.array([k, k, 1])
    larger = scene.but(
        points=k * scene.points,
        length=k * scene.length,
        fingers=tuple(k * f for f in scene.fingers),
        path=scale * scene.path,
        pose=scale * scene.pose,
        fixtures=tuple((kind, None if s is None else k * s, scale * p, m) for kind, s, p, m in scene.fixtures),
    )
    pose, status = of(larger.push())
    same((pose / scale, status), of(scene.push()))


@every_kind
def test_origin_of_the_body_frame(kind, seed):
    scene, rng = drawn(kind, seed)
    shift = rng.uniform(-0.1, 0.1, 2)
    moment = np.array([shift[1] / scene.length, -shift[0] / scene.length, 1])
    transform = np.stack([[1, 0, 0], [0, 1, 0], moment])

    def moved(pose, sign):
        """Poses of the frame whose origin is at minus or plus `shift`."""
        offset = np.stack([rotated(sign * shift, angle) for angle in np.atleast_2d(pose)[:, 2]])
        return np.concatenate([np.atleast_2d(pose)[:, :2] + offset, np.atleast_2d(pose)[:, 2:]], axis=1)

    other = scene.but(points=scene.points + shift, A=transform.T @ scene.A @ transform, pose=moved(scene.pose, -1)[0])
    pose, status = of(other.push())
    same((moved(pose, 1), status), of(scene.push()))


@each_of([kind for kind in KINDS if kind[1] in ("pad", "jaw")])
@EXAMPLES
@given(seed=seeds)
def test_origin_of_a_pads_frame(kind, seed):
    scene, rng = drawn(kind, seed)
    shifts = rng.uniform(-0.2, 0.2, (len(scene.fingers), 2))
    path = scene.path.copy()
    for k, shift in enumerate(shifts):
        path[:, k, :2] -= np.stack([rotated(shift, angle) for angle in path[:, k, 2]])
    other = scene.but(fingers=tuple(f + s for f, s in zip(scene.fingers, shifts, strict=True)), path=path)
    same(of(other.push()), of(scene.push()))


@every_kind
def test_order_of_vertices_fingers_and_fixtures(kind, seed):
    scene, rng = drawn(kind, seed)
    order = rng.permutation(len(scene.fingers))
    if kind[1] == "jaw":  # pads of the same number of corners
        order = np.array([1, 0])
    wall, *rest = scene.fixtures or (None,)
    other = scene.but(
        points=np.roll(scene.points, rng.integers(1, len(scene.points)), axis=0),
        fingers=tuple(np.roll(f, 1, axis=0) if np.ndim(f) else f for f in (scene.fingers[k] for k in order)),
        path=scene.path[:, order],
        friction=scene.friction[order],
        fixtures=(*rest, wall) if rest else (),
    )
    same(of(other.push()), of(scene.push()))


@every_kind
def test_rows_repeated(kind, seed):
    """A pause changes nothing, bit for bit, and is FREE; unless the hand has stopped, which is for good."""
    scene, rng = drawn(kind, seed)
    times = 1 + rng.integers(0, 3, len(scene.path))
    if kind[-1] == "fixtures":
        times = np.minimum(times, 2)
    last = np.cumsum(times)[:-1]  # the row after the pauses at each row, which ends the step that moves
    pose, status = of(scene.push())
    paused_pose, paused_status = of(scene.but(path=np.repeat(scene.path, times, axis=0)).push())
    np.testing.assert_array_equal(paused_pose[last], pose[1:])
    np.testing.assert_array_equal(paused_status[last - 1], status)
    pauses = np.setdiff1d(np.arange(len(paused_status)), last - 1)
    assert set(paused_status[pauses]) <= {pj.Status.FREE, pj.Status.JAMMED, pj.Status.GRASPED}


def split(path: np.ndarray, parts: int) -> np.ndarray:
    """A path with every row split in parts."""
    f = np.arange((len(path) - 1) * parts + 1) / parts
    columns = [np.interp(f, np.arange(len(path)), column) for column in path.reshape(len(path), -1).T]
    return np.stack(columns, axis=1).reshape(len(f), *path.shape[1:])


@every_kind
def test_rows_split(kind, seed):
    """Steps split in two, and three of them in ten, end at the same place, to the accuracy of the scheme.

    The steps are of about 4 mm, a tenth of the slider. Where a second contact closes or a jam ends the motion within a
    step, that step is of first order.
    """
    scene, _ = drawn(kind, seed)
    push = scene.push()
    half = scene.but(path=split(scene.path, 2)).push()
    np.testing.assert_allclose(half.pose[-1, :2], push.pose[-1, :2], atol=SPLIT_M)
    np.testing.assert_allclose(half.pose[-1, 2], push.pose[-1, 2], atol=SPLIT_RAD)
    if int(push.stopped) >= 0:  # the hand stopped, and the rest of its path goes into the slider
        return
    late = scene.but(path=scene.path[7:10], pose=np.asarray(push.pose[7]))
    few, many = late.push(), late.but(path=split(late.path, 10)).push()
    np.testing.assert_allclose(many.pose[-1, :2], few.pose[-1, :2], atol=SPLIT_M)
    np.testing.assert_allclose(many.pose[-1, 2], few.pose[-1, 2], atol=SPLIT_RAD)


# --- one body or one hand in several forms ---


@pytest.mark.slow
def test_vertices_on_straight_sides_and_a_convex_polygon_declared_not_convex():
    """A pad pushes a rectangle flat, tilted and aside: more vertices on sides, or `convex=False`, change nothing."""
    rng = np.random.default_rng(0)
    ends, steps = SIDE[[1, 2, 3, 0]], np.linspace(0, 0.03, STEPS + 1)
    for tilt, turn, aside in ((0, 0, 0), (0.02, 0, 0), (0, 0.1, 0), (0, 0, 0.5), (-0.02, -0.1, 0.3)):
        path = np.stack([aside * steps, steps - 0.0053, turn * steps / 0.03], axis=1)[:, None]
        scene = Scene(points=SIDE, length=0.023, fingers=(4 * PAD * [1, 0.25],), path=path, friction=np.array([0.3]))
        scene = scene.but(pose=np.array([0.03, 0.0172 + 0.03 * abs(np.sin(tilt)), tilt]))
        wanted = of(scene.push())
        split_sides = np.concatenate(
            [
                np.linspace(a, b, 4)[:3] + rng.uniform(-0.2, 0.2, (3, 1)) * [[0], [1], [1]] * (b - a) / 3
                for a, b in zip(SIDE, ends, strict=True)
            ]
        )
        same(of(scene.but(points=split_sides).push()), wanted)
        same(of(scene.but(shape=lambda v: pj.Polygon(v, convex=False)).push()), wanted)


@pytest.mark.parametrize(
    ("finger", "atol"), [(0.006, 1e-5), pytest.param(PAD, 2e-3, marks=pytest.mark.slow)], ids=["finger", "pad"]
)
def test_disk_ellipse_and_curve(finger, atol):
    """A disk, an ellipse with equal axes, and a curve through 64 points of the circle (which is off by 0.2 um).

    Where the slider comes over the end of a pad within a step, its turn is exact to a hundredth of that step.
    """
    angle = np.pi / 32 * np.arange(64)
    circle = 0.02 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    shapes = {
        "disk": lambda v: pj.Disk(0.02),
        "ellipse": lambda v: pj.Ellipse(0.02, 0.02),
        "curve": pj.Curve.through,
    }
    for seed in range(4):
        rng = np.random.default_rng(seed)
        scene = Scene(points=circle, A=surface(rng), length=0.0142, fingers=(finger,))
        scene = scene.but(path=approach(rng, 0.05, 0.04)[:, None], friction=np.array([0.4]))
        disk, ellipse, curve = (of(scene.but(shape=shape).push()) for shape in shapes.values())
        same(ellipse, disk)
        np.testing.assert_allclose(curve[0], disk[0], atol=atol)


@pytest.mark.slow
def test_wall_as_a_half_plane_a_box_and_two_boxes():
    """A slider that is pushed onto a wall and along it does not catch on the seam of two boxes.

    The step in which it jams may be divided in other parts, so the pose there is exact to a sixteenth of that step, in
    which a slider pressed flat slides by 1.3 mm and turns by 0.014 rad.
    """
    half = np.array([[-0.3, -0.1], [0.3, -0.1], [0.3, 0], [-0.3, 0]])
    left, right = np.minimum(half, [0.004, 0]), np.maximum(half, [0.004, -1])
    walls = {
        "wall": (("wall", None, np.zeros(3), 0.2),),
        "box": (("box", half, np.zeros(3), 0.2),),
        "boxes": (("box", left, np.zeros(3), 0.2), ("box", right, np.zeros(3), 0.2)),
    }
    cases = {
        "onto": ((0.005, 0.07), (0.005, 0.035), (0, 0.026, 0.15)),
        "along": ((-0.045, 0.012), (0.035, 0.012), (0, 0.0202, 0.0)),
        "tip": ((-0.05, 0.035), (0.02, 0.025), (0, 0.03, 0.2)),
        "press": ((-0.01, 0.07), (0.03, 0.038), (0, 0.024, 0.05)),
    }
    for name, (start, end, pose) in cases.items():
        path = np.concatenate([pj.line(start, end, STEPS), np.zeros((STEPS + 1, 1))], axis=1)[:, None]
        scene = Scene(length=0.021, path=path, pose=np.array(pose))
        wall, *boxes = (scene.but(fixtures=fixtures).push() for fixtures in walls.values())
        part = np.array([1.5e-3, 1.5e-3, 0.015]) if name == "press" else SMALL_PART
        for box in boxes:
            assert np.all(np.abs(box.pose[-1] - wall.pose[-1]) <= part)
            assert box.status[-1] == wall.status[-1]


@pytest.mark.slow
def test_idle_finger_far_away():
    """A second finger that never touches changes nothing, except that steps of hands with two contacts are divided.

    The step that begins to push is then exact to 0.6 mrad, and not to 2 mrad.
    """
    for seed in range(6):
        scene, _ = drawn(("rectangle", "finger"), seed)
        far = scene.path + np.array([3.0, 1.0, 0.0])
        two = scene.but(fingers=(0.006, 0.009), friction=np.array([scene.friction[0], 0.9]))
        wanted = of(scene.push())
        same(of(two.but(path=np.concatenate([scene.path, far], axis=1)).push()), wanted, 3e-3)
        swapped = two.but(fingers=(0.009, 0.006), friction=two.friction[::-1])
        same(of(swapped.but(path=np.concatenate([far, scene.path], axis=1)).push()), wanted, 3e-3)


# --- how it is computed ---


def test_eager_jit_vmap_scan_closed_over_or_given():
    scene, _ = drawn(("rectangle", "finger"), 3)
    slider, hand, mu = scene.slider(), scene.hand(), jnp.asarray(scene.friction)
    rows, pose = jnp.asarray(scene.path.reshape(STEPS + 1, -1)), jnp.asarray(scene.pose)
    wanted = of(scene.push())

    def push(slider, rows, pose):
        found = pj.rollout(slider, hand, rows, pose=pose, friction=mu)
        return found.pose, found.status

    same(jax.tree.map(np.asarray, jax.jit(push)(slider, rows, pose)), wanted)
    batch = jnp.stack([rows + 0.001, rows])
    closed = jax.tree.map(np.asarray, jax.jit(jax.vmap(lambda rows: push(slider, rows, pose)))(batch))
    same((closed[0][1], closed[1][1]), wanted)
    nonsense = batch.at[0].set(jnp.nan)
    among = jax.tree.map(np.asarray, jax.jit(jax.vmap(push, in_axes=(None, 0, None)))(slider, nonsense, pose))
    same((among[0][1], among[1][1]), wanted)
    assert set(among[1][0].tolist()) == {pj.Status.INVALID}

    def one_step(pose, ends):
        done = pj.step(slider, hand, *ends, pose=pose, friction=mu)
        return done.pose, (done.pose, done.status)

    _, (poses, statuses) = jax.jit(lambda pose: jax.lax.scan(one_step, pose, (rows[:-1], rows[1:])))(pose)
    same((np.concatenate([pose[None], poses]), np.asarray(statuses)), wanted)


@each_of([("rectangle", "finger"), ("rectangle", "pad")])
def test_float32_beside_float64(kind):
    """In float32 a push of 45 mm ends within 20 um and 0.5 mrad of float64: seven digits, some lost in each step."""
    for seed in range(4):
        scene, _ = drawn(kind, seed)

        def narrow(x):
            return np.asarray(x, np.float32)

        single = scene.but(
            points=narrow(scene.points),
            A=narrow(scene.A),
            length=np.float32(scene.length),
            fingers=tuple(narrow(f) for f in scene.fingers),
            path=narrow(scene.path),
            pose=narrow(scene.pose),
            friction=narrow(scene.friction),
        )
        narrow_push, wide = single.push(), scene.push()
        assert narrow_push.pose.dtype == np.float32
        np.testing.assert_allclose(narrow_push.pose[-1, :2], wide.pose[-1, :2], atol=2e-5)
        np.testing.assert_allclose(narrow_push.pose[-1, 2], wide.pose[-1, 2], atol=5e-4)
