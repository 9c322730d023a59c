"""Checks of the arguments of steps and rollouts, and their conversion to one floating dtype."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from pushjax._internal.checks import (
    ArrayLike,
    as_float,
    check_finite,
    check_non_negative,
    check_shape,
    check_type,
    checked_array,
    common_dtype,
    concrete,
    traced,
    warn,
)
from pushjax._internal.jit import is_staging
from pushjax.contact.problem import check_solver
from pushjax.contact.scaled_problem import ContactSolver
from pushjax.contact.sticking import StickingSolver
from pushjax.friction.friction_model import warn_about_percent
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.table import Table
from pushjax.geometry.disk import Disk
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.shape import Shape
from pushjax.simulation.fixtures import Fixture, Fixtures, Wall
from pushjax.simulation.hand import Hand
from pushjax.simulation.pair import MAX_PENETRATION
from pushjax.simulation.path import checked_path
from pushjax.simulation.slider import Slider, fixture_overlaps, overlaps
from pushjax.simulation.sliders_step import mutual_overlaps

POSES_AT_ONCE = 4096  # poses whose overlaps are computed together
# Numbers beyond these are probably in other units: length of a surface, m; distance of a hand from the origin, in
# lengths of the surface; angle of a pose, rad (angles are never wrapped, so a few turns are no mistake).
MAX_LENGTH, MAX_REACH, MAX_TURN = 3.0, 1000.0, 8 * np.pi


def check_slider_and_hand(slider: Slider, hand: Hand) -> None:
    """Raise TypeError unless `slider` and `hand` are of their types."""
    check_type("slider", slider, Slider)
    check_type("slider.shape", slider.shape, Shape)
    check_type("slider.surface", slider.surface, LimitSurface)
    check_type("hand", hand, Hand)


def checked_arguments(
    slider: Slider, hand: Hand, pose: ArrayLike, friction: ArrayLike, *paths: ArrayLike, pushes: int | None = None
):
    """Return slider, hand, pose and friction (fingers,), checked where known, and the one dtype that they now have."""
    check_slider_and_hand(slider, hand)
    dtype = common_dtype(slider, hand, pose, friction, *paths)  # paths only help to decide it
    start, mu = as_float(pose, dtype, "pose"), as_float(friction, dtype, "friction")
    if pushes is None or start.ndim == 1:
        check_shape("pose", start, (3,))
    elif start.shape != (pushes, 3):
        raise ValueError(f"pose has shape {start.shape}; expected (3,) or ({pushes}, 3)")
    check_finite("pose", start)
    fingers = len(hand.fingers)
    if mu.shape not in ((), (fingers,)):
        raise ValueError(f"friction has shape {mu.shape}; expected a scalar or ({fingers},), one per finger")
    check_finite("friction", mu)
    check_non_negative("friction", mu)
    if not traced((slider, pose, friction, paths, mu)):  # inside `jit`, `mu` is traced even if `friction` is known
        warn_about_percent(np.max(np.asarray(mu), initial=0))
    cast = jax.tree.map(lambda leaf: leaf.astype(dtype), (slider, hand))
    return *cast, start, jnp.broadcast_to(mu, (fingers,)), dtype


def warn_about_units(slider: Slider, pose: Array, *paths: Array) -> None:
    """Warn if numbers are probably in millimeters or degrees, unless any value is traced."""
    if traced((slider, pose, paths)):
        return
    length = float(slider.surface.length)
    # at least the first two numbers of any configuration are lengths
    reach = max((float(np.max(np.abs(np.asarray(path)[..., :2]), initial=0)) for path in paths), default=0.0)
    angle = float(np.max(np.abs(np.asarray(pose)[..., 2]), initial=0))
    if length > MAX_LENGTH:
        warn(f"slider: its surface has a length of {length:.3g} m: are its coordinates in millimeters?")
    elif reach > MAX_REACH * length:
        times = f"{reach / length:.0f} times the length of the slider's surface"
        warn(f"path: it goes {reach:.3g} m from the origin, {times}: are its coordinates in millimeters?")
    if angle > MAX_TURN:
        warn(f"pose: its angle is {angle:.3g} rad: is it in degrees?")


def checked_rollout_arguments(
    slider: Any, hand: Hand, path: ArrayLike, pose: ArrayLike, friction: ArrayLike, pushes: int | None = None
):
    """Return slider, hand, path, start and friction of a rollout, in one dtype and checked where values are known."""
    slider, hand, start, mu, dtype = checked_arguments(slider, hand, pose, friction, path, pushes=pushes)
    path_array = as_float(path, dtype, "path")
    _check_columns(path_array, hand)
    if pushes is not None and path_array.ndim == 3:
        path_array = checked_array("path", path_array, (pushes, "steps + 1", hand.dof))
        if path_array.shape[1] < 2:
            raise ValueError(f"path must have at least two configurations; got shape {path_array.shape}")
    else:
        path_array = checked_path(path_array, hand.dof)
    warn_about_units(slider, start, path_array)
    check_opening(hand, path_array)
    check_start(slider, hand, start, path_array[..., 0, :])
    return slider, hand, path_array, start, mu


def checked_sliders_arguments(
    sliders: Sequence[Slider],
    hand: Hand,
    path: ArrayLike,
    pose: ArrayLike,
    friction: ArrayLike,
    between: ArrayLike | None,
    pushes: int | None = None,
):
    """Return the arguments of a rollout of several sliders, as above, with their friction (fingers, between)."""
    if not sliders:
        raise ValueError("slider: a tuple of sliders needs at least one; got none")
    for k, slider in enumerate(sliders):
        check_type(f"slider[{k}]", slider, Slider)
    dtype, count = common_dtype(tuple(sliders), hand, pose, friction, path, between), len(sliders)
    of_each = (pushes,) if pushes is not None and np.ndim(pose) == 3 else ()
    start = checked_array("pose", pose, (*of_each, count, 3), dtype)
    mutual = checked_between(sliders, between, dtype)
    each = [checked_rollout_arguments(s, hand, path, start[..., k, :], friction, pushes) for k, s in enumerate(sliders)]
    sliders = tuple(one[0] for one in each)
    check_start_beside_each_other(sliders, start)
    # all are of the dtype of `start`
    _, hand, path_array, _, mu = each[0]
    return sliders, hand, path_array, start, (mu, mutual)


def checked_between(sliders: Sequence[Slider], between: ArrayLike | None, dtype: Any) -> Array:
    """Return the friction of sliders with each other, (sliders, sliders), checked where known."""
    if between is None:
        raise ValueError("between: several sliders need the coefficient of friction with each other; got None")
    mutual, count = as_float(between, dtype, "between"), len(sliders)
    if mutual.shape not in ((), (count, count)):
        raise ValueError(f"between has shape {mutual.shape}; expected a scalar or ({count}, {count})")
    check_finite("between", mutual)
    check_non_negative("between", mutual)
    mutual = jnp.broadcast_to(mutual, (count, count))
    known = concrete(mutual)
    if known is not None and np.any(known != known.T):
        raise ValueError(f"between must be symmetric; got {known.tolist()}")
    smooth = [k for k, slider in enumerate(sliders) if not isinstance(slider.shape, Disk | Polygon)]
    if len(smooth) > 1:
        raise ValueError(f"slider: of each two, one must be a disk or a polygon; sliders {smooth} are not")
    return mutual


def checked_friction_range(sliders: Sequence[Slider], between: Any, dtype: Any) -> Array:
    """Return the lowest and highest friction of sliders with each other, (2, sliders, sliders), checked where known."""
    low, high = between if np.shape(between) == (2,) else (between, between)  # the shape of None is ()
    limits = jnp.stack([checked_between(sliders, each, dtype) for each in (low, high)])
    known = concrete(limits)
    if known is not None and np.any(known[0] > known[1]):
        raise ValueError(f"between must be (lowest, highest); got ({float(low):g}, {float(high):g})")
    return limits


def check_start_beside_each_other(sliders: tuple[Slider, ...], poses: Array, name: str = "pose") -> None:
    """Raise ValueError if two sliders start too deep in each other, unless values are traced."""
    if traced((sliders, poses)) or is_staging() or len(sliders) < 2:
        return
    depth = np.asarray(mutual_overlaps(tuple(s.shape for s in sliders), poses.reshape(-1, len(sliders), 3)))
    allowed = MAX_PENETRATION * min(float(s.surface.length) for s in sliders)
    push, pair = np.unravel_index(np.argmax(depth), depth.shape)
    if depth[push, pair] > allowed:
        first, second = [(i, j) for i in range(len(sliders)) for j in range(i)][pair]
        where = "" if poses.ndim == 2 else f" of push {push}"
        raise ValueError(
            f"{name}{where}: sliders {second} and {first} start inside each other, by {1e3 * depth[push, pair]:.3g} "
            f"mm; at most {1e3 * allowed:.3g} mm ({MAX_PENETRATION:g} of the surface's length) is pushed out"
        )


class Scene(NamedTuple):
    """Everything about a rollout but its solver."""

    slider: Any  # one slider, or a tuple of several
    hand: Hand
    path: Array
    start: Array  # pose of each slider
    friction: Any  # (fingers,); of several sliders with it the one of each with each
    table: Table | None
    fixtures: Fixtures


def checked_scene(
    slider: Slider | Sequence[Slider],
    hand: Hand,
    path: ArrayLike,
    pose: ArrayLike,
    friction: ArrayLike,
    between: ArrayLike | None,
    solver: ContactSolver | StickingSolver | None,
    table: Table | None,
    fixtures: Sequence[Wall | Fixture],
    pushes: int | None = None,
) -> Scene:
    """Return everything about a rollout, random or not, of one slider or of several; checked where values are known."""
    check_solver(solver)
    if isinstance(slider, tuple | list):
        if solver is not None or table is not None:
            raise ValueError("solver and table are for one slider; got one with several sliders")
        checked = checked_sliders_arguments(slider, hand, path, pose, friction, between, pushes)
    else:
        if between is not None:
            raise ValueError("between is for several sliders; got one")
        checked = checked_rollout_arguments(slider, hand, path, pose, friction, pushes)
    start = checked[3]
    scene = Scene(*checked, checked_table(table, start.dtype), checked_fixtures(fixtures, start.dtype))
    if isinstance(scene.slider, Slider):
        check_start_among_fixtures(scene.slider, scene.fixtures, start)
    else:
        for k, one in enumerate(scene.slider):
            check_start_among_fixtures(one, scene.fixtures, start[..., k, :])
    return scene


def _check_columns(path: Array, hand: Hand) -> None:
    """Raise ValueError for a path whose rows are not as long as a configuration of the hand."""
    if path.ndim > 1 and path.shape[-1] != hand.dof:
        raise ValueError(
            f"path has {path.shape[-1]} columns; a configuration of this hand has {hand.dof}"
            + (f": {hand.coordinates}" if hand.coordinates else "")
        )


def check_start(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> None:
    """Raise ValueError if a finger starts too deep in the slider, unless values are traced."""
    if traced((slider, hand, poses, configuration)):
        return
    count = max(np.atleast_2d(poses).shape[0], np.atleast_2d(configuration).shape[0])
    many = np.broadcast_to(poses, (count, 3))
    configurations = np.broadcast_to(configuration, (count, hand.dof))
    part_size, depths = min(count, POSES_AT_ONCE), []
    for first in range(0, count, part_size):  # parts of equal size; the last one is padded
        part = np.minimum(np.arange(first, first + part_size), count - 1)
        depths.append(np.asarray(overlaps(slider, hand, jnp.asarray(many[part]), jnp.asarray(configurations[part]))))
    depth = np.concatenate(depths)
    worst = int(np.argmax(depth))
    allowed = MAX_PENETRATION * float(slider.surface.length)
    if depth[worst] > allowed:
        where = "" if poses.ndim == configuration.ndim == 1 else f" in push {worst}"
        raise ValueError(
            f"path starts with the hand inside the slider{where}: a finger overlaps it by {1e3 * depth[worst]:.3g} "
            f"mm; at most {1e3 * allowed:.3g} mm ({MAX_PENETRATION:g} of the surface's length) is pushed out"
        )


def check_opening(hand: Hand, path: Array) -> None:
    """Raise ValueError if a path closes the hand on itself, unless values are traced."""
    least, known_path = hand.least, concrete(path)
    if least is None or known_path is None or traced(least):
        return
    opening = np.atleast_2d(known_path)[..., -1]
    narrow = np.argwhere(opening < float(least))
    if narrow.size:
        index = tuple(narrow[0].tolist())
        raise ValueError(
            f"path closes the hand on itself: d is {opening[index]:.6g} m at index {', '.join(map(str, index))}; "
            f"with these fingers it must be at least {float(least):.6g} m"
        )


def checked_table(table: Table | None, dtype: Any) -> Table | None:
    """Return the table in a floating dtype; raise TypeError for anything else than a table or None."""
    if table is None:
        return None
    check_type("table", table, Table)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), table)


def checked_fixtures(fixtures: Sequence[Wall | Fixture], dtype: Any) -> Fixtures:
    """Return fixtures in a floating dtype; raise TypeError for anything else than a sequence of them."""
    if isinstance(fixtures, Wall | Fixture):
        raise TypeError(f"fixtures: expected a sequence of Wall and Fixture; got one {type(fixtures).__name__}")
    for k, fixture in enumerate(fixtures):
        check_type(f"fixtures[{k}]", fixture, Wall, Fixture)
    return jax.tree.map(lambda leaf: leaf.astype(dtype), tuple(fixtures))


def check_start_among_fixtures(slider: Slider, fixtures: Fixtures, poses: Array) -> None:
    """Raise ValueError if the slider starts too deep in a fixture, unless values are traced."""
    if not fixtures or traced((slider, fixtures, poses)):
        return
    depth = np.asarray(fixture_overlaps(slider, fixtures, jnp.atleast_2d(poses)))
    worst, allowed = int(np.argmax(depth)), MAX_PENETRATION * float(slider.surface.length)
    if depth[worst] > allowed:
        where = "" if poses.ndim == 1 else f" of push {worst}"
        raise ValueError(
            f"pose{where}: the slider starts inside a fixture, by {1e3 * depth[worst]:.3g} mm; at most "
            f"{1e3 * allowed:.3g} mm ({MAX_PENETRATION:g} of the surface's length) is pushed out"
        )
