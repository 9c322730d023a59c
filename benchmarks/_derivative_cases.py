"""Random pushes and grasps, and the comparison of their derivatives with central differences."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.simulation.substeps import SMALLEST_PART

RADIUS, LENGTH = 0.005, 0.035
# Half-width of the central differences, that of the finer ones, and the error above which these are used too.
H, FINE, TOLERANCE = 1e-5, 1e-7, 1e-5
# A contact is on an edge if the sine of the angle between the contact's normal and the edge's normal is below this.
EDGE = 1e-9


def fitted(block: pj.Polygon, dtype: Any) -> pj.Quartic:
    """Return the quartic of uniform pressure on 64 points of `block`, with `LENGTH` as its length."""
    points = pj.Support.uniform(block, points=64)
    pairs = points.wrench_twist_pairs(jax.random.key(0), 400)
    surface: Any = pj.fit_limit_surface(pairs.wrench, pairs.twist, length=LENGTH)
    return pj.Quartic(jnp.asarray(surface.coefficients, dtype), jnp.asarray(LENGTH, dtype))


class Case(NamedTuple):
    """Random pushes or grasps to differentiate."""

    # From the inputs of one push, (inputs,), to its final pose, (3,), and its kind. Inputs and pose are scaled to order
    # one. The kind, an array that begins with the status of each step, must be equal for two pushes to be compared.
    end: Callable
    inputs: np.ndarray  # (pushes, inputs)
    along: dict[str, np.ndarray]  # directions of differentiation by name, (inputs,) each
    size: int  # number of pushes in a batch
    steps: int  # number of steps of each push


def surfaces(mean: pj.Quartic, n: int) -> np.ndarray:
    """Return coefficients (n, 15) in units of the mean's largest: every second row is the mean, the rest random."""
    model = pj.FrictionModel(dof=20.0, friction=0.3)
    drawn: Any = jax.jit(jax.vmap(model.around(mean).sample))(jax.random.split(jax.random.key(3), n)).surface
    each = np.where(np.arange(n)[:, None] % 2, drawn.coefficients, mean.coefficients)
    return each / float(jnp.max(mean.coefficients))


def directions(names: list[str], width: int, drawn: dict[str, slice]) -> dict[str, np.ndarray]:
    """Return unit vectors (width,) of the first inputs, and two random directions in each slice of `drawn`, by name."""
    rng, found = np.random.default_rng(4), dict(zip(names, np.eye(width), strict=False))
    for name, where in drawn.items():
        for k in (1, 2):
            found[f"{name} {k}"] = np.zeros(width)
            found[f"{name} {k}"][where] = rng.normal(size=len(range(width)[where]))
    return found


def one_finger(n: int, steps: int = 60) -> Case:
    """Return 60 mm pushes of random pentagons by one finger, from any side toward any point; some slip off or miss."""
    rng, mean = np.random.default_rng(2), fitted(pj.Polygon.rectangle(0.09, 0.09), float)
    scale, hand_names = float(jnp.max(mean.coefficients)), ["start x", "start y", "direction", "travel"]

    def end(x):
        pose, path, vertices = x[2:5] * jnp.array([LENGTH, LENGTH, 1.0]), x[5:9], LENGTH * x[24:].reshape(5, 2)
        slider = pj.Slider(pj.Polygon(vertices, convex=True), pj.Quartic(scale * x[9:24], mean.length))
        way = LENGTH * path[3] * jnp.array([jnp.cos(path[2]), jnp.sin(path[2])])
        path = LENGTH * path[None, :2] + jnp.arange(steps + 1)[:, None] / steps * way[None]
        run = pj.rollout(slider, pj.Hand.finger(LENGTH * x[1]), path, pose=pose, friction=x[0])
        return scaled(run), jnp.concatenate([run.status, run.mode[:, 0], touched(run, vertices)])

    corners = 2 * np.pi * (np.arange(5) + rng.uniform(0, 0.6, (n, 5))) / 5
    vertices = 0.045 / LENGTH * np.stack([np.cos(corners), np.sin(corners)], axis=-1).reshape(n, 10)
    pose = np.stack([*rng.normal(0, 0.02 / LENGTH, (2, n)), rng.uniform(-3, 3, n)], axis=-1)
    bearing, aside = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.045, 0.045, n)
    away = rng.uniform(0.051, 0.056, n) / LENGTH
    out = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    begin = pose[:, :2] + away[:, None] * out
    to = aside[:, None] / LENGTH * np.stack([-out[:, 1], out[:, 0]], axis=-1) - away[:, None] * out
    path = [begin, np.arctan2(to[:, 1], to[:, 0])[:, None], np.full((n, 1), 0.06 / LENGTH)]
    mu, radius = rng.uniform(0.0, 1.0, (n, 1)), rng.uniform(0.002, 0.006, (n, 1)) / LENGTH
    inputs = np.concatenate([mu, radius, pose, *path, surfaces(mean, n), vertices], axis=1)
    names = ["friction", "radius", "x", "y", "theta", *hand_names]
    along = directions(names, 34, {"surface": slice(9, 24), "vertices": slice(24, 34)})
    return Case(end, inputs, along, 4000, steps)


def scaled(run: pj.Trajectory) -> jax.Array:
    """Return the final pose, (3,), with positions in units of `LENGTH`."""
    return run.pose[-1] / jnp.array([LENGTH, LENGTH, 1.0], run.pose.dtype)


def touched(run: pj.Trajectory, vertices: jax.Array) -> jax.Array:
    """Return what each step touches, (steps,): 2 k for edge k, 2 k + 1 for the vertex after it, -1 for nothing."""
    # The normal's direction follows from the rotation between the contact's force (normal, tangential) and the force of
    # the wrench.
    (a, b), (x, y) = run.force[:, 0].T, run.wrench[:, :2].T
    outward = -jnp.stack([x * a + y * b, y * a - x * b], axis=-1)
    outward = outward / jnp.maximum(jnp.linalg.norm(outward, axis=-1, keepdims=True), 1e-300)
    side = jnp.roll(vertices, -1, axis=0) - vertices
    normal = jnp.stack([side[:, 1], -side[:, 0]], axis=-1) / jnp.linalg.norm(side, axis=-1, keepdims=True)
    sine = normal[None, :, 0] * outward[:, 1:] - normal[None, :, 1] * outward[:, :1]
    on = (jnp.abs(sine) < EDGE) & (outward @ normal.T > 0)
    between = (sine > 0) & (jnp.roll(sine, -1, axis=1) < 0)
    feature = jnp.argmax(jnp.concatenate([on, between & ~jnp.any(on, axis=1, keepdims=True)], axis=1), axis=1)
    feature = jnp.where(feature < len(vertices), 2 * feature, 2 * (feature - len(vertices)) + 1)
    return jnp.where(run.force[:, 0, 0] > 0, feature, -1).astype(jnp.int8)


def of_hand(hand: pj.Hand, block: pj.Polygon, steps: int, given: list[np.ndarray], size: int) -> Case:
    """Return pushes or grasps of `block` by a hand of two fingers."""
    # given: friction (n, 2), start poses (n, 3), first and last configurations (n, 4) each
    mean = fitted(block, float)
    scale, unit = float(jnp.max(mean.coefficients)), np.array([LENGTH, LENGTH, 1.0, LENGTH])

    def end(x):
        slider = pj.Slider(block, pj.Quartic(scale * x[13:], mean.length))
        first, last = x[5:9] * unit, x[9:13] * unit
        path = first[None] + jnp.arange(steps + 1)[:, None] / steps * (last - first)[None]
        run = pj.rollout(slider, hand, path, pose=x[2:5] * unit[:3], friction=x[:2])
        travel = last - first
        done = (run.configuration[-1] - first) @ travel / (travel @ travel)
        stops = jnp.round(done * steps / SMALLEST_PART).astype(jnp.int32)[None]
        return scaled(run), jnp.concatenate([run.status, run.mode.ravel(), stops])

    n = len(given[0])
    numbers = [given[0], given[1] / unit[:3], given[2] / unit, given[3] / unit, surfaces(mean, n)]
    each = [f"{when} {of}" for when in ("first", "last") for of in ("x", "y", "theta", "opening")]
    names = ["friction 1", "friction 2", "x", "y", "theta", *each]
    return Case(end, np.concatenate(numbers, axis=1), directions(names, 28, {"surface": slice(13, 28)}), size, steps)


def two_fingers(n: int) -> Case:
    """Return `n` pushes of a square, 50 mm, by two fingers that turn and close or open on the way."""
    rng, zero = np.random.default_rng(5), np.zeros(n)
    pose = np.stack([np.full(n, 0.072), rng.uniform(-0.02, 0.02, n), rng.uniform(-3, 3, n)], axis=-1)
    first = np.stack([zero, zero, zero, rng.uniform(0.02, 0.06, n)], axis=-1)
    more = [np.full(n, 0.05), rng.uniform(-0.01, 0.01, n), rng.uniform(-0.3, 0.3, n), rng.uniform(-0.005, 0.005, n)]
    given = [rng.uniform(0, 0.8, (n, 2)), pose, first, first + np.stack(more, axis=-1)]
    return of_hand(pj.Hand.two_fingers(RADIUS), pj.Polygon.rectangle(0.09, 0.09), 60, given, 1000)


def grasps(jaw: bool, n: int) -> Case:
    """Return `n` grasps of a 50 x 35 mm rectangle by two round fingers or a parallel jaw, which close and shift."""
    rng, zero = np.random.default_rng(6), np.zeros(n)
    pose = np.stack([*rng.uniform(-0.005, 0.005, (2, n)), rng.uniform(-3, 3, n)], axis=-1)
    hand = pj.Hand.parallel_jaw(0.027, 0.01) if jaw else pj.Hand.two_fingers(RADIUS)
    wide, narrow = (0.077, 0.031) if jaw else (0.09, 0.041)
    first = np.stack([zero, zero, zero, np.full(n, wide)], axis=-1)
    more = [*rng.uniform(-0.003, 0.003, (2, n)), rng.uniform(-0.1, 0.1, n), np.full(n, narrow - wide)]
    mu = rng.uniform(0.1, 0.6, (n, 1)) * np.ones((1, 2))
    given = [mu, pose, first, first + np.stack(more, axis=-1)]
    case = of_hand(hand, pj.Polygon.rectangle(0.05, 0.035), 115, given, 175 if jaw else 350)
    chosen = ("friction 1", "x", "theta", "last y", "last theta", "last opening", "surface 1")
    return case._replace(along={name: case.along[name] for name in chosen})


class Batched:
    """A function of rows, compiled once for batches of `size` rows and called with any number of them."""

    def __init__(self, function: Callable, size: int):
        self.program, self.size = jax.jit(jax.vmap(function)), size

    def __call__(self, *rows: np.ndarray) -> Any:
        n, found = len(rows[0]), []
        for first in range(0, n, self.size):
            index = np.minimum(np.arange(first, first + self.size), n - 1)
            out = self.program(*(row[index] for row in rows))
            found.append(jax.tree.map(np.asarray, out))
        return jax.tree.map(lambda *parts: np.concatenate(parts)[:n], *found)


class Compared(NamedTuple):
    """Agreement of derivatives with central differences."""

    same: np.ndarray  # (pushes, directions), whether the pushes on both sides are of the same kind as the push itself
    error: np.ndarray  # (pushes, directions), relative, against extrapolated differences; zero where not `same`
    # (pushes, directions), relative, against differences of width FINE; zero unless `error` > TOLERANCE
    fine: np.ndarray
    finite: np.ndarray  # (pushes,), whether all derivatives are finite
    status: np.ndarray  # (pushes, steps)


def compare(case: Case) -> Compared:
    """Compare derivatives in reverse mode with central differences, for each push and direction."""
    ends = Batched(case.end, case.size)
    backs = Batched(lambda x, weight: jax.vjp(case.end, x, has_aux=True)[1](weight)[0], case.size)
    x, along = case.inputs, np.stack(list(case.along.values()))
    (n, width), count = x.shape, len(along)
    _, kind = ends(x)
    jacobian = backs(np.repeat(x, 3, axis=0), np.tile(np.eye(3), (n, 1))).reshape(n, 3, width)
    slope = np.swapaxes(jacobian @ along.T, 1, 2).reshape(-1, 3)
    push, way = np.repeat(np.arange(n), count), np.tile(along, (n, 1))

    def central(rows: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
        (above, one), (below, other) = (ends(x[push[rows]] + t * way[rows]) for t in (h, -h))
        base = kind[push[rows]]
        return (above - below) / (2 * h), np.all((one == base) & (other == base), axis=1)

    def error(rows: np.ndarray, difference: np.ndarray) -> np.ndarray:
        return np.max(np.abs(slope[rows] - difference) / np.maximum(1, np.abs(difference)), axis=1)

    everything = np.arange(n * count)
    wide, same = central(everything, H)
    narrow, _ = central(everything, H / 4)
    found = np.where(same, error(everything, narrow + (narrow - wide) / 15), 0.0)
    fine, large = np.zeros(n * count), np.flatnonzero(~(found <= TOLERANCE))
    if large.size:
        fine[large] = error(large, central(large, FINE)[0])
    shape, finite = (n, count), np.isfinite(jacobian).all(axis=(1, 2))
    return Compared(same.reshape(shape), found.reshape(shape), fine.reshape(shape), finite, kind[:, : case.steps])
