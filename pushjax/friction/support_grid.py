"""Cells of a grid over a shape, and the part of each that lies inside its outline."""

import jax
import numpy as np
from jaxtyping import Array, Float

from pushjax._internal.checks import concrete, on_device
from pushjax._internal.jit import quick_jit
from pushjax.geometry.disk import Disk
from pushjax.geometry.ellipse import Ellipse
from pushjax.geometry.polygon import Polygon
from pushjax.geometry.polygon_numpy import signed_distances
from pushjax.geometry.shape import Shape

MAX_CELLS = 4_000_000  # of all grids that are tried
SAMPLES = 8  # samples of each cell along x and along y, to estimate how much of it lies inside
AT_ONCE = 4096  # points whose distances are computed together, because points times edges may be many


def covered_cells(shape: Shape, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Return centers, (cells, 2), m, and relative sizes, (cells,), of the covered parts of about `points` cells."""
    low, high = (concrete(corner) for corner in shape.bounds)
    if low is None or high is None:
        raise ValueError("shape must be known to lay a grid over it; build the Support outside jit")
    dtype, low, high = low.dtype, low.astype(np.float64), high.astype(np.float64)
    # If no cell is cut, the area of the shape determines the spacing. Cut cells require a coarser one. So try
    # spacings around the value from the area, the nearest first.
    around = np.linspace(-0.1, 0.4, 26)
    spacings = np.sqrt(float(shape.area) / points) * (1 + around[np.argsort(np.abs(around), kind="stable")])
    if np.sum(np.prod(high - low) / spacings**2) > MAX_CELLS:
        raise ValueError(
            "shape covers too little of the box around it to lay a grid over it, a share of "
            f"{float(shape.area) / float(np.prod(high - low)):.2g}; give `Support.points`, or turn its frame"
        )
    boxes = [_cells(low, high, spacing) for spacing in spacings]
    center_distances = _distances(shape, np.concatenate([centers for centers, _ in boxes]).astype(dtype))
    at_centers = np.split(center_distances, np.cumsum([len(centers) for centers, _ in boxes])[:-1])
    # cells that lie outside as a whole bear nothing
    grids = [
        (centers[distance <= 0.51 * np.hypot(*cell)], cell)
        for (centers, cell), distance in zip(boxes, at_centers, strict=True)
    ]
    most = max(len(centers) for centers, _ in grids)  # pad all to one length, to compile once
    # samples nearer to the outline than this count half, because roundoff would decide whether they are inside
    tolerance = 64 * np.finfo(dtype).eps * max(np.abs(low).max(), np.abs(high).max())
    found = []
    for centers, cell in grids:
        samples = _samples(centers, cell)
        padded = np.concatenate([samples, np.broadcast_to(low, ((most - len(centers)) * SAMPLES**2, 2))])
        distance = _distances(shape, padded.astype(dtype))[: len(samples)]
        inside = np.where(distance < -tolerance, 1.0, np.where(distance <= tolerance, 0.5, 0.0))
        found.append(_covered_parts(samples, centers, inside))
        if len(found[-1][0]) == points:
            break
    best_centers, areas = min(found, key=lambda parts: abs(len(parts[0]) - points))
    return best_centers.astype(dtype), areas.astype(dtype)


def _cells(low: np.ndarray, high: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Divide a box into cells with sides near `spacing`: return their centers (cells, 2) and a cell's sides (2,), m."""
    count = np.maximum(np.round((high - low) / spacing), 1).astype(int)
    cell = (high - low) / count
    x, y = (low[k] + (np.arange(count[k]) + 0.5) * cell[k] for k in range(2))
    return np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2), cell


def _samples(centers: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Return the sample points of cells, shape (cells * SAMPLES^2, 2), m."""
    offset = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    offsets = np.stack(np.meshgrid(offset * cell[0], offset * cell[1], indexing="ij"), axis=-1).reshape(-1, 2)
    return (centers[:, None] + offsets[None]).reshape(-1, 2)


def _covered_parts(samples: np.ndarray, centers: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each cell with a sample inside, the mean of its inside samples and the fraction of it inside."""
    inside = inside.reshape(len(centers), -1)
    fraction = inside.mean(axis=1)
    total = np.sum(samples.reshape(*inside.shape, 2) * inside[..., None], axis=1)
    mean = np.where((fraction == 1)[:, None], centers, total / np.maximum(inside.sum(axis=1), 0.5)[:, None])
    return mean[fraction > 0], fraction[fraction > 0]


def _distances(shape: Shape, points: np.ndarray) -> np.ndarray:
    """Return signed distances from the outline, m, that are exact near it, and too small far outside."""
    # with NumPy for the shapes where this is simple
    if isinstance(shape, Polygon):
        vertices, parts = np.asarray(shape.vertices, np.float64), range(0, len(points), AT_ONCE)
        return np.concatenate([signed_distances(vertices, points[k : k + AT_ONCE]) for k in parts])
    if isinstance(shape, Disk):
        return np.linalg.norm(points - np.asarray(shape.center), axis=1) - np.asarray(shape.radius)
    if isinstance(shape, Ellipse):
        semi = np.asarray([shape.semi_x, shape.semi_y])
        scaled = (points - np.asarray(shape.center)) / semi
        slope = np.maximum(np.linalg.norm(2 * scaled / semi, axis=1), 1e-30)  # zero at the center
        return (np.sum(scaled**2, axis=1) - 1) / slope
    return np.asarray(_signed_distances(shape, on_device(points)))


@quick_jit
def _signed_distances(shape: Shape, points: Float[Array, "points 2"]) -> Float[Array, "points"]:
    return jax.lax.map(shape.signed_distance, points, batch_size=AT_ONCE)
