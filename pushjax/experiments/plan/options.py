"""Options of the command that plans pushes."""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

from pushjax._internal.checks import check_count, check_finite, check_positive
from pushjax.experiments._cli_option import cli_option

Pose = tuple[float, float, float]
MAX_ANGLE = 8 * math.pi  # rad; a larger angle is probably in degrees


@dataclass
class Options:
    """The block, its start and goal, the finger, and what is known of friction."""

    goal: Annotated[Pose, cli_option("X Y THETA")]
    """Pose of the block that is wanted, m and rad."""
    shape: Annotated[str, cli_option("SHAPE")] = "rectangle:0.09x0.06"
    """The block: rectangle:0.09x0.06, disk:0.05 (radius), ellipse:0.06x0.04 (semi-axes), regular:6x0.05 (corners,
    distance of each), all in m, or a CSV file of vertices."""
    start: Annotated[Pose, cli_option("X Y THETA")] = (0.0, 0.0, 0.0)
    """Pose of the block now, m and rad."""
    tolerance: Annotated[tuple[float, float], cli_option("M RAD")] = (0.005, 0.0873)
    """Tolerances of the goal: of the position, m, and of the angle, rad."""
    symmetry: int = 1
    """Number of angles in a full turn at which the block looks the same: 2 for a rectangle, 4 for a square."""
    finger: Annotated[tuple[float, float] | None, cli_option("X Y")] = None
    """Where the center of the finger is now, m. Default: where its first push begins."""
    fixtures: Annotated[tuple[str, ...], cli_option("FIXTURE ...")] = ()
    """What stands fixed on the table: walls, wall@X,Y,ANGLE (a point, and the angle of the normal into the free space),
    and disks or convex bodies at a pose, such as disk:0.02@0.1,0.05,0 (m and rad). Default: nothing."""
    fixture_friction: float = 0.0
    """Friction coefficient between fixtures and block."""
    radius: float = 0.005
    """Radius of the finger, m."""
    pushes: int = 3
    """Largest number of pushes."""
    longest: Annotated[float | None, cli_option("M")] = None
    """Longest push, m. Default: 2.5 times the characteristic length of the limit surface."""
    clearance: float = 0.01
    """Distance that the finger keeps from the block between pushes, m."""
    speed: Annotated[tuple[float, float], cli_option("FREE PUSH")] = (0.1, 0.02)
    """Speeds of the finger, m/s: between pushes, and in pushes."""
    friction: Annotated[tuple[float, float], cli_option("LOWEST HIGHEST")] = (0.2, 0.3)
    """Range of the friction coefficient of the finger; twice the same number if it is known."""
    dof: Annotated[float | None, cli_option("DOF")] = 100.0
    """Degrees of freedom of the limit surface's noise: the fewer, the more noise. None: no noise."""
    surface: Literal["ellipsoid", "quartic"] = "ellipsoid"
    """Kind of limit surface."""
    support: str = "uniform"
    """Pressure distribution under the block: uniform, rim, or points:x,y;x,y;x,y (m)."""
    robust: bool = True
    """Plan for all of this friction. With --no-robust the plan is for the mean friction only. That takes a fifth of the
    time, but such plans fail more often."""
    success: float = 0.9
    """Probability of success that is asked for."""
    attempts: int = 3
    """Number of searches with different random numbers, until one finds a plan that is sure enough."""

    def check(self) -> None:
        """Raise ValueError for the first invalid option, before anything is compiled."""
        given = {name.replace("_", "-"): value for name, value in vars(self).items() if value is not None}
        for name in ("start", "goal", "finger"):
            check_finite(f"--{name}", given.get(name, 0.0))
        for name in ("tolerance", "speed", "radius", "clearance", "longest"):
            check_positive(f"--{name}", given.get(name, 1.0))
        for name in ("pushes", "symmetry", "attempts"):
            check_count(f"--{name}", given[name])
        for name in ("start", "goal"):
            if abs(given[name][2]) > MAX_ANGLE:
                raise ValueError(f"--{name}: the angle is in rad, at most {MAX_ANGLE:.1f}; got {given[name][2]:g}")
        if not 0 <= self.success <= 1:
            raise ValueError(f"--success must be a probability; got {self.success:g}")
