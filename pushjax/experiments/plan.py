"""Plan pushes that bring a block from pose to pose, and write the motion of the finger for a robot.

`way_points.csv` has the columns time (s), push, finger_x and finger_y (m, world), one row for each point. The finger
goes straight from each point to the next. `push` is the number of the push that the finger makes up to that point, from
one, and zero on its way between pushes.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

import pushjax as pj
from pushjax import plot
from pushjax._internal.checks import check_count, check_finite, check_positive
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._cli_option import cli_option
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table, saved
from pushjax.experiments._slider_options import fitted_surface, parse_fixture, parse_shape, parse_support
from pushjax.geometry.polygon_numpy import outline_vertices, signed_distances
from pushjax.geometry.se2_numpy import to_body
from pushjax.identification.pushes_of_recordings import MAX_SLIDER_SIZE
from pushjax.planning import FinalPose, Goal, PlanStatus, PushPlan, PushScene, PushSequence, finger_motion, plan_pushes
from pushjax.planning.between_pushes import FingerMotion
from pushjax.planning.roadmap import TransitStatus
from pushjax.plot.parts import draw_fixtures
from pushjax.plot.style import BLACK, BLUE, GRAY, GREEN, MM, ORANGE, RED, STYLE
from pushjax.simulation.fixtures import Fixtures

WAY_POINTS_FILE = "way_points.csv"
MAX_PUSH_LENGTH = 2.5  # in units of the limit surface's length
STEPS = 12  # number of steps of each push
POSSIBLE = (PlanStatus.FOUND, PlanStatus.UNLIKELY)  # the finger can do what the plan says
DRAWN = 40  # largest number of predicted ends that are drawn
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


def run(
    options: Options, seed: int = 0, out: Path | None = None, progress: ProgressCallback = no_progress
) -> dict[str, Any]:
    """Plan the pushes, and write way points and picture into the folder `out`.

    Args:
        options: What is to be planned.
        seed: Seed of the surface and of the search.
        out: Folder for the way points and the picture. None: neither.
        progress: Called with the number of attempts done and their total.
    """
    options.check()
    shape, hand = parse_shape(options.shape), pj.Hand.finger(options.radius)
    fixtures = tuple(parse_fixture(text, options.fixture_friction) for text in options.fixtures)
    model = pj.FrictionModel(options.dof, options.friction)
    _check_block(shape, options)
    support = parse_support(options.support, shape)
    slider = pj.Slider(shape, fitted_surface(support, options.surface, seed))
    length = float(slider.surface.length)
    longest = MAX_PUSH_LENGTH * length if options.longest is None else options.longest
    away = math.dist(options.start[:2], options.goal[:2])
    if away > options.pushes * longest + options.tolerance[0]:
        raise ValueError(
            f"--goal is {away:.3g} m away, and --pushes {options.pushes} of at most {longest:.3g} m (--longest) do not "
            "reach it; are its coordinates in millimeters?"
        )
    position, angle = options.tolerance
    goal = Goal(
        np.array(options.goal),
        position_tolerance=position,
        angle_tolerance=angle,
        length=length,
        symmetry=options.symmetry,
    )
    scene = PushScene(slider, hand, model, fixtures)
    plans: list[PushPlan] = []
    while len(plans) < options.attempts and not (plans and plans[-1].status == PlanStatus.FOUND):
        plans.append(
            plan_pushes(
                jax.random.fold_in(jax.random.key(seed), len(plans)),
                scene,
                np.array(options.start),
                goal,
                pushes=PushSequence(options.pushes, length=longest, steps=STEPS, clearance=options.clearance),
                success=options.success,
                finger=options.finger,
                # without a search under sampled friction, the plan is the best one under the mean friction
                **({} if options.robust else {"cost": FinalPose(goal), "search": ()}),
            )
        )
        progress(len(plans), options.attempts)
    plan = max(plans, key=lambda plan: (plan.status in POSSIBLE, plan.success))
    motion = None
    if plan.status in POSSIBLE and plan.transits:
        free, push = options.speed
        motion = finger_motion(plan.transits, np.asarray(plan.path), free=free, push=push)
    files = [] if out is None else _write_way_points(out, motion)
    pictures = saved(out, lambda: {"plan.png": _figure(slider, goal, fixtures, plan, options)})
    settings = {"seed": seed} | vars(options)
    return result_record("plan", settings, **_plan_entries(plan, goal, motion), files=files, pictures=pictures)


def _check_block(shape: pj.Shape, options: Options) -> None:
    """Raise ValueError if block or finger are probably in another unit, or if the finger overlaps the block."""
    low, high = (np.asarray(corner, float) for corner in shape.bounds)
    for name, size in (("shape", float(np.max(high - low))), ("radius", 2 * options.radius)):
        if size > MAX_SLIDER_SIZE:
            raise ValueError(
                f"--{name}: {size:g} m across; expected at most {MAX_SLIDER_SIZE:g} m: is it in millimeters?"
            )
    if options.finger is not None:
        apart = signed_distances(outline_vertices(shape), to_body(np.array(options.start), np.array(options.finger)))
        if apart < options.radius:
            raise ValueError(f"--finger overlaps the block at its start, by {1e3 * (options.radius - apart):.3g} mm")


def _plan_entries(plan: PushPlan, goal: Goal, motion: FingerMotion | None) -> dict[str, Any]:
    """Return the entries of the record that describe a plan."""
    final = np.asarray(plan.outcomes.pose, np.float64)
    errors = np.asarray(goal.offset(final), np.float64)
    spread = errors.std(axis=0)
    return {
        "status": plan.status.name,
        "success": plan.success,
        "samples": len(final),
        "spread": {"x_mm": 1e3 * spread[0], "y_mm": 1e3 * spread[1], "theta_deg": np.degrees(spread[2])},
        "path": plan.path,
        "pose": plan.pose,
        "transits": [
            {"status": transit.status.name, "points": transit.points}
            | ({"length": transit.length} if transit.status == TransitStatus.FOUND else {})
            for transit in plan.transits
        ],
        "final_poses": final,
        "duration_s": None if motion is None else float(motion.time[-1]),
        "way_points": None if motion is None else len(motion.time),
    }


def _write_way_points(out: Path, motion: FingerMotion | None) -> list[str]:
    """Write the motion of the finger, if there is one, rounded to micrometers and milliseconds; return the files."""
    path = out / WAY_POINTS_FILE
    if motion is None:
        path.unlink(missing_ok=True)  # a robot must not follow the plan of an earlier call
        return []
    out.mkdir(parents=True, exist_ok=True)
    rows, form = np.column_stack([motion.time, motion.push, motion.position]), ("%.3f", "%d", "%.6f", "%.6f")
    np.savetxt(path, rows, form, ",", "\r\n", header="time,push,finger_x,finger_y", comments="")
    return [str(path)]


def _figure(slider: pj.Slider, goal: Goal, fixtures: Fixtures, plan: PushPlan, options: Options) -> Figure:
    """Draw the pushes and transits of a plan, where the block is on the way, and the errors of its final poses."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, 3, figsize=(12.5, 4.6), layout="constrained", gridspec_kw={"width_ratios": [2, 1, 1]}
        )
        draw_fixtures(panels[0], fixtures)
        _draw_plan(panels[0], slider, goal, plan, options)
        errors = np.asarray(goal.offset(np.asarray(plan.outcomes.pose)), float)
        _draw_positions(panels[1], errors, options.tolerance[0])
        plot.histogram_panel(panels[2], np.degrees(errors[:, 2]), "error of the angle / °", bins=30)
        for side, label in ((-1, "tolerance"), (1, None)):
            angle = side * np.degrees(options.tolerance[1])
            panels[2].axvline(angle, color=BLACK, lw=1, ls="--", label=label)
        panels[2].legend(fontsize=7, loc="upper left")
        panels[0].set_title(f"{plan.status.name.replace('_', ' ').lower()}: {plan.success:.0%} succeed")
        panels[2].set_title("angle at the end")
        return figure


def _draw_plan(axes: Axes, slider: pj.Slider, goal: Goal, plan: PushPlan, options: Options) -> None:
    for pose in np.asarray(plan.outcomes.pose)[:DRAWN]:
        plot.outline(axes, slider.shape, pose, RED, 0.4, alpha=0.5)
    axes.plot([], [], color=RED, lw=0.8, label="predicted ends")
    for number, pose in enumerate(np.asarray(plan.pose)):
        color, label = (BLACK, "start") if number == 0 else (GRAY, "after each push" if number == 1 else None)
        plot.outline(axes, slider.shape, pose, color, 1.2, label=label)
    plot.outline(axes, slider.shape, np.asarray(goal.pose), GREEN, 1.6, linestyle="--", label="goal")
    for number, transit in enumerate(plan.transits):
        label = "between pushes" if number == 0 else None
        axes.plot(*(MM * transit.points.T), color=ORANGE, lw=0.9, ls="--", label=label)
    for number, path in enumerate(np.asarray(plan.path)):
        points = MM * path
        axes.plot(*points.T, color=BLUE, lw=1.8, label="pushes of the finger" if number == 0 else None)
        axes.annotate(
            "", points[-1], points[-2], arrowprops={"arrowstyle": "-|>", "color": BLUE, "shrinkA": 0, "shrinkB": 0}
        )
        axes.add_patch(Circle(tuple(points[0]), MM * options.radius, color=BLUE, fill=False, lw=0.9))
        axes.annotate(
            str(number + 1),
            points[0],
            xytext=(7, 7),
            textcoords="offset points",
            color=BLUE,
            weight="bold",
            bbox={"boxstyle": "circle,pad=0.1", "fc": "white", "ec": "none", "alpha": 0.8},
            zorder=6,
        )
    axes.set(xlabel="x / mm", ylabel="y / mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.legend(fontsize=7, loc="best")


def _draw_positions(axes: Axes, errors: np.ndarray, tolerance: float) -> None:
    points = MM * errors[:, :2]
    reach = max(1.3 * MM * tolerance, float(np.quantile(np.abs(points), 0.995)) * 1.05)
    axes.plot(*points[np.all(np.abs(points) <= reach, axis=1)].T, ".", color=RED, ms=3)
    axes.add_patch(Circle((0, 0), MM * tolerance, color=BLACK, fill=False, ls="--", lw=1))
    axes.update_datalim([(-reach, -reach), (reach, reach)])
    axes.set(xlabel="error of x / mm", ylabel="error of y / mm")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title("position at the end")


def summary(record: dict[str, Any]) -> list[str | Table]:
    """Return the report on a record of `run`."""
    status, count, spread = PlanStatus[record["status"]], len(record["path"]), record["spread"]
    success = f"{record['success']:.1%} of {record['samples']} samples"
    if status == PlanStatus.NO_TRANSIT:
        found = [transit["status"] for transit in record["transits"]]
        k = next(k for k, each in enumerate(found) if each != TransitStatus.FOUND.name)
        return [f"no plan: the finger does not get to push {k + 1} ({found[k]})"]
    if status == PlanStatus.HAND_IN_FIXTURE:
        return ["no plan: in the best one that was found the finger runs into a fixture in a push"]
    if not count:
        words = "no push is needed" if status == PlanStatus.FOUND else "no push that helps was found"
        return [f"{words}: {success} are at the goal"]
    asked = f"less than the {record['settings']['success']:.0%} asked for"
    return [
        f"{count} pushes, which take the robot {record['duration_s']:.0f} s: success in {success} of friction",
        *(
            []
            if status == PlanStatus.FOUND
            else [f"{asked}: try more --attempts, more --pushes, or a smaller range of --friction"]
        ),
        f"final pose: standard deviation {spread['x_mm']:.1f} mm, {spread['y_mm']:.1f} mm, {spread['theta_deg']:.1f}°",
        *(f"wrote {path}, {record['way_points']} points" for path in record["files"]),
    ]
