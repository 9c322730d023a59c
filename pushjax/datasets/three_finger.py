"""Three-finger grasps as the toolbox of Zhou et al. 2017 simulated them: recorded motions, not measurements.

The hand does not move: its three round fingers, 120 degrees apart, close on its origin, their distance d from it
falling at a constant rate, until the object is grasped or jams; then all stands still.
"""

from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pushjax.datasets._archive import Arrays, check_shapes, floats, read_archive
from pushjax.datasets.pushes import Floats, LogError

# Degree of the limit surface, and the shape of its coefficients, by the name its kind has in the archive.
SURFACES = {"quadratic": (2, (3, 3)), "poly4": (4, (15,))}
# m; the fingers' distance is recorded in float32 and moves to and fro by this much after a stop.
ROUNDING = 1e-5
_NAMES = (
    "t",
    "object_pose",
    "object_pose_start",
    "finger_distance",
    "hand_pose",
    "stop_index",
    "ls_type",
    "ls_coeffs",
    "vertices_body",
    "rho",
    "finger_radius",
    "push_index",
)


class ThreeFingerLog(NamedTuple):
    """The n runs of one object, each recorded at the same T times.

    time: (T,) s. pose: (n, T, 3) m, rad, world, the object's; its first is that of the start. distance: (n, T) m, d.
    stop: (n,) index of the last sample at which the hand still moved; T - 1 where it never stopped.
    index: (n,) the run's number in the original file. hand: (3,) m, rad, world, the hand's pose.
    degree: of the limit surface, and coefficients: (3, 3) for 2 or (15,) for 4, as `Ellipsoid` and `Quartic` take them;
    length: m, which it is normalised with. vertices: (v, 2) m, body, anticlockwise. radius: m, the fingers'. source:
    the file.
    """

    time: Floats
    pose: Floats
    distance: Floats
    stop: NDArray[np.int64]
    index: NDArray[np.int64]
    hand: Floats
    degree: int
    coefficients: Floats
    length: float
    vertices: Floats
    radius: float
    source: str

    @property
    def runs(self) -> int:
        return len(self.pose)


def load_three_finger_npz(path: str | PathLike[str]) -> ThreeFingerLog:
    """Reads a file of the `three_finger_sim` folder.

    Poses are recorded in float32, but the start also in float64, which replaces the first. Raises LogError if the file
    is missing, is no such archive, lacks an array, or holds one of the wrong shape or with numbers that are not finite.
    """
    file = Path(path)
    data = read_archive(file, _NAMES, "grasps")
    kind = str(data["ls_type"])
    if kind not in SURFACES:
        raise LogError(file, f"expected ls_type to be one of {', '.join(SURFACES)}, found {kind!r}")
    degree, shape = SURFACES[kind]
    _check(file, data, shape)
    pose = floats(data["object_pose"])
    pose[:, 0] = floats(data["object_pose_start"])
    return ThreeFingerLog(
        time=floats(data["t"]),
        pose=pose,
        distance=floats(data["finger_distance"]),
        stop=data["stop_index"].astype(np.int64),
        index=data["push_index"].astype(np.int64),
        hand=floats(data["hand_pose"]),
        degree=degree,
        coefficients=floats(data["ls_coeffs"]),
        length=float(floats(data["rho"])),
        vertices=floats(data["vertices_body"]),
        radius=float(floats(data["finger_radius"])),
        source=str(file),
    )


def _check(path: Path, data: Arrays, coefficients: tuple[int, ...]) -> None:
    runs = len(data["push_index"]) if data["push_index"].ndim else 0
    times = len(data["t"]) if data["t"].ndim else 0
    corners = len(data["vertices_body"]) if data["vertices_body"].ndim else 0
    if runs < 1 or times < 2 or corners < 3:
        raise LogError(path, f"expected runs, times and corners, found {runs}, {times} and {corners} of them")
    shapes = {
        "t": (times,),
        "object_pose": (runs, times, 3),
        "object_pose_start": (runs, 3),
        "finger_distance": (runs, times),
        "hand_pose": (3,),
        "stop_index": (runs,),
        "push_index": (runs,),
        "ls_coeffs": coefficients,
        "vertices_body": (corners, 2),
        "rho": (),
        "finger_radius": (),
    }
    check_shapes(path, data, shapes)
    for name in shapes:
        if not np.issubdtype(data[name].dtype, np.number) or not np.isfinite(data[name]).all():
            raise LogError(path, f"expected finite numbers, found others in {name}")
    stop = data["stop_index"].astype(np.int64)
    if stop.min() < 0 or stop.max() >= times:
        raise LogError(path, f"expected stop_index from 0 to {times - 1}, found {stop.min()} to {stop.max()}")
    if np.diff(floats(data["finger_distance"]), axis=1).max() > ROUNDING:
        raise LogError(path, "expected finger_distance never to grow, found it growing")
