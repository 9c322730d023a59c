"""A thousand identifications in one `vmap` beside as many semi-definite programs.

The objects are squares of 90 mm. Each has its own ellipsoid (30 degrees of freedom, around that of uniform pressure)
and friction (0.1 to 0.5), and is pushed 30 mm, in 20 steps, by a finger of 5 mm radius. Two things are measured in each
push: the final pose, with noise of 0.3 mm in x, y and length * theta, and the mean directions of wrench and motion in
each half of the push, with noise of 3 degrees.

- `identify` finds friction and surface from poses and wrenches together, with all objects in one `vmap`.
- `convex` finds the surface from the wrench-twist pairs by a semi-definite program (cvxpy, with the loss of
  `fit_limit_surface`), one object after another. It then finds the friction from the final poses on a grid of 21
  values, with all objects in one batch.
- `expected` is no identification, but the mean surface and a friction of 0.25 for all objects.

They are compared by the final poses of other pushes of the same objects, without noise, by the friction, and by the
wrenches of random twists.
"""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from benchmarks.identification import HALF, RADIUS, random_pushes
from benchmarks.peers import fits
from pushjax.experiments._record import result_record

PATH_STEPS, GRID, TEST = 20, np.linspace(0.05, 0.65, 21), 10
POSE_NOISE, ANGLE_NOISE = 3e-4, np.radians(3.0)
UNKNOWNS = pj.Unknowns((0.0, 1.0), surface_dof=30)
Arrays = tuple[jax.Array, ...]


@jax.jit
def simulate(surface: pj.LimitSurface, friction, starts, paths) -> pj.Trajectory:
    """Simulate the pushes of all objects.

    Args:
        surface: Limit surfaces, with a leading axis (objects,).
        friction: Friction coefficients, (objects,).
        starts: Start poses, (objects, pushes, 3).
        paths: Paths of the finger, (objects, pushes, steps + 1, 2).

    Returns:
        Trajectories with leading axes (objects, pushes).
    """
    square, hand = pj.Polygon.rectangle(2 * HALF, 2 * HALF), pj.Hand.finger(RADIUS)

    def one(surface, mu, start, path):
        return pj.rollout(pj.Slider(square, surface), hand, path, pose=start, friction=mu)

    return jax.vmap(jax.vmap(one, in_axes=(None, None, 0, 0)))(surface, friction, starts, paths)


def random_objects(rng: np.random.Generator, mean: pj.LimitSurface, count: int) -> tuple[pj.LimitSurface, jax.Array]:
    """Draw the limit surfaces and the friction of `count` objects around the surface `mean`."""
    model = pj.FrictionModel(30, (0.1, 0.5))
    return jax.vmap(lambda key: model.sample(key, mean))(jax.random.split(jax.random.key(int(rng.integers(99))), count))


def measured_pushes(rng: np.random.Generator, surface, friction, length: float, count: int, pushes: int) -> pj.Pushes:
    """Simulate the measured pushes of all objects, with noise.

    Args:
        rng: Generator of the pushes and of the noise.
        surface: True limit surfaces, with a leading axis (count,).
        friction: True friction coefficients, (count,).
        length: Characteristic length of the surfaces, m.
        count: Number of objects.
        pushes: Number of pushes of each object.

    Returns:
        The pushes, with a leading axis (count,). Each has two wrench-twist pairs.
    """
    starts, paths = coarse_random_pushes(rng, count, pushes)
    done = simulate(surface, friction, starts, paths)
    noise = rng.normal(size=(count, pushes, 3)) * POSE_NOISE / [1, 1, length]
    metric = np.array([1, 1, length])
    middle = PATH_STEPS // 2
    wrench, twist = [], []
    for part in (slice(1, middle), slice(middle, None)):
        wrench.append(_with_direction_noise(rng, np.asarray(done.wrench)[:, :, part].mean(axis=2) / metric) * metric)
        twist.append(_with_direction_noise(rng, np.asarray(done.twist)[:, :, part].sum(axis=2) * metric) / metric)
    pairs = (jnp.asarray(np.stack(each, axis=2), jnp.float32) for each in (wrench, twist))
    wrench, twist = pairs
    return jax.vmap(lambda s, p, e, w, v: pj.Pushes(s, p, e, wrench=w, twist=v))(
        starts, paths, done.pose[:, :, -1] + jnp.asarray(noise, jnp.float32), wrench, twist
    )


def coarse_random_pushes(rng: np.random.Generator, count: int, pushes: int) -> Arrays:
    """Draw start poses, (count, pushes, 3), and paths of PATH_STEPS steps, (count, pushes, PATH_STEPS + 1, 2)."""
    starts, paths = random_pushes(rng, (count, pushes))
    return starts, jax.vmap(jax.vmap(lambda path: pj.line(path[0], path[-1], PATH_STEPS)))(paths)


def _with_direction_noise(rng: np.random.Generator, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) with noise that turns their directions by ANGLE_NOISE, as a root mean square."""
    size = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors + ANGLE_NOISE / np.sqrt(2) * size * rng.normal(size=vectors.shape)


def ellipsoid_by_semidefinite_program(wrench: np.ndarray, twist: np.ndarray, length: float) -> np.ndarray:
    """Fit an ellipsoid by a semi-definite program, with the loss of `fit_limit_surface`.

    Args:
        wrench: Wrenches, (pairs, 3). Pairs with a zero wrench or twist are ignored.
        twist: Twists, (pairs, 3).
        length: Characteristic length, m.

    Returns:
        The matrix of the ellipsoid, (3, 3).
    """
    cp = fits.cvxpy()
    metric = np.array([1, 1, length])
    valid = np.any(wrench != 0, axis=1) & np.any(twist != 0, axis=1)
    force, motion = wrench[valid] / metric, twist[valid] * metric
    force = force / np.linalg.norm(force, axis=1).mean()
    motion = motion / np.linalg.norm(motion, axis=1, keepdims=True)
    a, s = cp.Variable((3, 3), PSD=True), cp.Variable(len(force), nonneg=True)
    misfit = cp.sum_squares(2 * force @ a - cp.multiply(cp.reshape(s, (len(force), 1), order="C"), motion))
    values = cp.sum(cp.multiply(force @ a, force), axis=1)
    loss = (misfit + 2 * cp.sum_squares(values - 1)) / len(force) + 1e-3 * cp.sum_squares(a)
    cp.Problem(cp.Minimize(loss)).solve(solver=cp.CLARABEL)
    return np.asarray(a.value)


@jax.jit
def friction_on_grid(surface, pushes: pj.Pushes, length) -> jax.Array:
    """Find the friction on the grid for which the final poses of each object deviate least.

    Args:
        surface: Limit surfaces, with a leading axis (objects,).
        pushes: Measured pushes, with a leading axis (objects,).
        length: Characteristic length, m.

    Returns:
        Friction coefficients, (objects,).
    """

    def off(mu):
        done = simulate(surface, jnp.full(len(pushes.weight), mu), pushes.start, pushes.path)
        return jnp.mean(pj.deviation(done.pose[:, :, -1], pushes.end, length), axis=1)

    losses = jax.lax.map(off, jnp.asarray(GRID, jnp.float32))
    return jnp.asarray(GRID, jnp.float32)[jnp.argmin(losses, axis=0)]


def errors(name: str, surface, friction, truth, tested: Arrays, length: float) -> dict[str, Any]:
    """Compare identified objects with the truth.

    Args:
        name: Name of the method.
        surface: Identified limit surfaces, with a leading axis (objects,).
        friction: Identified friction coefficients, (objects,).
        truth: True surfaces, true friction coefficients, and true final poses of the tested pushes.
        tested: Start poses and paths of the tested pushes.
        length: Characteristic length, m.

    Returns:
        The row: mean deviation of the final poses over objects, the deviation that one of twenty objects exceeds, mean
        error of the friction, and mean angle between true and identified wrenches.
    """
    real, mu, ends = truth
    done = simulate(surface, friction, *tested)
    off = 1e3 * np.asarray(pj.deviation(done.pose[:, :, -1], ends, length)).mean(axis=1)
    angles = np.degrees(np.asarray(wrench_angle(surface, real)))
    wrong = np.abs(np.asarray(friction - mu))
    figures = {"mean_mm": off.mean(), "q95_mm": np.quantile(off, 0.95)}
    return {"method": name} | figures | {"friction": wrong.mean(), "wrench_deg": angles.mean()}


@jax.jit
def wrench_angle(one, other) -> jax.Array:
    """Return the mean angle between the wrenches of two surfaces over 100 random twists, rad, for each object."""
    twist = jax.random.normal(jax.random.key(5), (100, 3))

    def of(a, b):
        metric = jnp.stack([jnp.ones_like(a.length), jnp.ones_like(a.length), 1 / a.length])

        def between(v):
            p, q = a.wrench(v * metric) * metric, b.wrench(v * metric) * metric
            cosine = jnp.sum(p * q) / jnp.sqrt(jnp.sum(p**2) * jnp.sum(q**2))
            return jnp.arccos(jnp.clip(cosine, -1, 1))

        return jnp.mean(jax.vmap(between)(twist))

    return jax.vmap(of)(one, other)


def run(objects: int = 1000, pushes: int = 20, programs: int = 1000) -> dict[str, Any]:
    """Identify random objects, all at once, and some of them one after another by semi-definite programs.

    Args:
        objects: Number of objects.
        pushes: Number of pushes of each.
        programs: Number of objects that cvxpy fits, at most all.

    Returns:
        The record, with a row of errors for the expected object, for `identify` and for `convex`, and the times.

    Raises:
        ValueError: If cvxpy is not installed.
    """
    rng = np.random.default_rng(0)
    square, hand = pj.Polygon.rectangle(2 * HALF, 2 * HALF), pj.Hand.finger(RADIUS)
    mean = pj.fit_limit_surface(*pj.Support.uniform(square).wrench_twist_pairs(jax.random.key(0), 400), degree=2)
    length = float(mean.length)
    real, mu = random_objects(rng, mean, objects)
    measured = measured_pushes(rng, real, mu, length, objects, pushes)
    tested = coarse_random_pushes(rng, objects, TEST)
    truth = (real, mu, simulate(real, mu, *tested).pose[:, :, -1])
    expected = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (objects, *leaf.shape)), mean)
    rows = [errors("expected, friction 0.25", expected, jnp.full(objects, 0.25), truth, tested, length)]

    def identified(pushes):
        return pj.identify(pushes, pj.Slider(square, mean), hand, UNKNOWNS, robust=None)

    begin = time.perf_counter()
    program = jax.jit(jax.vmap(identified)).lower(measured).compile()
    middle = time.perf_counter()
    found = jax.block_until_ready(program(measured))
    took = time.perf_counter() - middle
    times = {"identify_compile_s": middle - begin, "identify_s": took}
    not_converged = int(np.sum(~np.asarray(found.converged)))
    surface = jax.vmap(lambda one: one.surface)(found)
    friction = jax.vmap(lambda one: one.friction)(found)
    rows.append(errors("identify", surface, friction, truth, tested, length))

    count = min(programs, objects)
    part = jax.tree.map(lambda leaf: leaf[:count], (measured, truth, tested))
    wrench, twist = (np.asarray(x, float).reshape(count, -1, 3) for x in (part[0].wrench, part[0].twist))
    fits.cvxpy()  # importing it is not timed
    begin = time.perf_counter()
    matrices = np.stack([ellipsoid_by_semidefinite_program(w, v, length) for w, v in zip(wrench, twist, strict=True)])
    middle = time.perf_counter()
    convex = jax.vmap(pj.Ellipsoid, in_axes=(0, None))(jnp.asarray(matrices, jnp.float32), mean.length)
    grid = friction_on_grid.lower(convex, part[0], length).compile()
    start = time.perf_counter()
    friction = jax.block_until_ready(grid(convex, part[0], length))
    took = time.perf_counter() - start
    times |= {"programs_s": middle - begin, "grid_s": took}
    rows.append(errors("convex", convex, friction, part[1], part[2], length))
    settings = {"objects": objects, "pushes": pushes, "programs": count}
    return result_record("many_identifications", settings, rows=rows, not_converged=not_converged, **times)


def summary(record: dict[str, Any]) -> str:
    """Return what the command prints."""
    objects, programs = record["settings"]["objects"], record["settings"]["programs"]
    took = record["programs_s"] + record["grid_s"]
    lines = [
        f"identify: {objects} objects in {record['identify_s']:.1f} s, {1e3 * record['identify_s'] / objects:.1f} ms "
        f"each; compiled in {record['identify_compile_s']:.0f} s; {record['not_converged']} not converged",
        f"convex: {programs} objects in {record['programs_s']:.1f} s of programs and {record['grid_s']:.1f} s of grid, "
        f"{1e3 * took / programs:.1f} ms each",
    ]
    for row in record["rows"]:
        lines.append(
            f"{row['method']}: final poses off by {row['mean_mm']:.3f} mm in the mean over objects, "
            f"{row['q95_mm']:.3f} in one of twenty; friction by {row['friction']:.4f}; wrenches by "
            f"{row['wrench_deg']:.2f} degrees"
        )
    return "\n".join(lines)
