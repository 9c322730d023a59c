"""Number of control steps from any pose to the goal, by value iteration over a library of pushes.

Poses are on a grid: positions at equal spacing, and angles, which are periodic. The pushes that start at one angle
move the slider by the same displacements wherever it is. So for each angle, a push that ends near the center of a cell
stands for all pushes into that cell, and one sweep of the iteration takes minima of shifted grids.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from pushjax.geometry.se2_numpy import compose, inverse, to_world
from pushjax.planning.free_space import POSITIONS, FreeSpace, PoseGrid, grid_spacing
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.workspace import BoundingBoxTable, Workspace

NEVER = 1e3  # control steps; cost of poses from which the goal is not reached
ANGLES = 36  # angles of the grid in a full turn
SWEEPS = 12  # largest number of sweeps over the grid
CHANGE = 0.5  # control steps; smaller changes end the iteration
LAST_PUSHES = 6  # pushes to the goal that are tried from each cell, if some may run into an obstacle
NEAR_CENTER = 0.35  # a push stands for a cell if it ends within this part of a cell from the cell's center


def cost_to_go(
    library: PushLibrary,
    goal: np.ndarray,  # (3,), world, m and rad
    workspace: Workspace,
    push_time: np.ndarray,  # (entries,), control steps of each entry of the library
    *,
    usable: np.ndarray,  # (pushes,), whether the finger can get to the start of each push
    tolerance: float,  # of final poses that reach the goal, m, in the metric of `PushLibrary.features`
    between: float,  # control steps between two pushes
    low: np.ndarray,  # (2,), lowest position of the slider's origin on the grid, m
    high: np.ndarray,  # (2,), highest; the grid is square, so along the narrower axis it reaches beyond
    vertices: np.ndarray,  # (vertices, 2), of the slider, body frame, m
    space: FreeSpace | None = None,  # built with the same `low` and `high`; None: no obstacles
) -> PoseGrid:
    """Compute the cost to go by value iteration."""
    spacing = grid_spacing(low, high)
    axes = [corner + spacing * np.arange(POSITIONS) for corner in low]
    theta = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    cells = np.stack(np.meshgrid(*axes, theta, indexing="ij"), axis=-1).astype(np.float32)
    blocked = BoundingBoxTable(vertices).outside(cells, workspace) > 0
    values = _last_push(library, goal, cells, push_time, usable, tolerance, between, space)
    cost = push_time + between
    moves = [
        _moves(library, workspace, cells[:, :, k], angle, spacing, cost, usable, space) for k, angle in enumerate(theta)
    ]
    if space is not None:
        met = space.distances.nearest(cells) < space.slider_clearance
        blocked |= met
    for _ in range(SWEEPS):
        before = values.copy()
        for k, move in enumerate(moves):
            values[:, :, k] = np.minimum(values[:, :, k], _best_move(values, blocked, k, move))
        if np.max(before - values) < CHANGE:
            break
    # A cell counts as blocked if the slider is too near to an obstacle at its center. At other poses in the cell the
    # slider may be free, so the cell gets the cost of the best neighbor, after one more pause between pushes.
    if space is not None:
        edges: Any = "nearest", "nearest", "wrap"  # SciPy's hints know a single mode only
        around = minimum_filter(np.where(met, NEVER, values), 3, mode=edges)
        values = np.where(met, around + between, values)
    return PoseGrid(np.asarray(low, np.float32), spacing, values)


class _Moves(NamedTuple):
    """The cheapest push from one angle into each cell."""

    shift: np.ndarray  # (moves, 3), whole cells by which the slider moves
    cost: np.ndarray  # (moves,), control steps
    allowed: np.ndarray  # (moves, positions, positions), whether finger and slider may make each move from each cell


def _last_push(library, goal, cells, push_time, usable, tolerance, between, space) -> np.ndarray:
    """Return the cost of the cells from which one push reaches the goal; NEVER for the others."""
    values = np.full(cells.shape[:3], NEVER, np.float32)
    wanted = compose(inverse(cells), np.broadcast_to(np.asarray(goal, np.float32), cells.shape))
    distance, index = library.nearest(wanted.reshape(-1, 3), 1 if space is None else LAST_PUSHES, tolerance)
    cell, column = np.nonzero(np.isfinite(distance))
    entry = index[cell, column]
    cost = np.where(usable[library.entries[entry, 0]], push_time[entry] + between, NEVER)
    if space is not None:
        cost = np.where(space.free(library, cells.reshape(-1, 3)[cell], entry), cost, NEVER)
    np.minimum.at(values.reshape(-1), cell, cost.astype(np.float32))
    return values


def _moves(library, workspace, cells, angle, spacing, cost, usable, space) -> _Moves:
    """Return the cheapest push into each cell that some push ends near the center of, from the cells of one angle."""
    pose = np.array([0.0, 0.0, angle], np.float32)
    reached = compose(pose, library.relative) - pose
    apart = reached / np.array([spacing, spacing, 2 * np.pi / ANGLES], np.float32)
    shift = np.rint(apart).astype(np.int32)
    near = (np.abs(apart - shift).max(1) < NEAR_CENTER) & shift.any(1) & usable[library.entries[:, 0]]
    entry = np.flatnonzero(near)
    entry = entry[np.argsort(cost[entry], kind="stable")]
    wide = 2 * np.abs(shift).max(initial=0) + 1  # so that each distinct shift has its own number
    _, first = np.unique(shift[entry] @ np.array([wide**2, wide, 1]), return_index=True)
    entry = entry[first]
    starts = library.starts[library.entries[entry, 0]].astype(np.float32)
    allowed = workspace.allows_finger(to_world(cells[None], starts[:, None, None]))
    if space is not None:
        allowed &= space.free_from_grid(library, angle, entry)
    return _Moves(shift[entry], cost[entry].astype(np.float32), allowed)


def _best_move(values: np.ndarray, blocked: np.ndarray, k: int, moves: _Moves) -> np.ndarray:
    """Return the least cost over the moves from the cells of one angle, (positions, positions)."""
    rows, columns, angles = values.shape
    margin = int(np.abs(moves.shift[:, :2]).max(initial=0))
    padded = np.full((rows + 2 * margin, columns + 2 * margin, angles), NEVER, np.float32)
    padded[margin : margin + rows, margin : margin + columns] = np.where(blocked, NEVER, values)
    best = np.full((rows, columns), NEVER, np.float32)
    for (i, j, turn), cost, is_allowed in zip(*moves, strict=True):
        shifted = padded[margin + i : margin + i + rows, margin + j : margin + j + columns, (k + turn) % angles]
        np.minimum(best, np.where(is_allowed, shifted + cost, NEVER), out=best)
    return best
