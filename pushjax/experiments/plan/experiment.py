"""Plan pushes that bring a block from pose to pose, and write the motion of the finger for a robot.

`way_points.csv` has the columns time (s), push, finger_x and finger_y (m, world), one row for each point. The finger
goes straight from each point to the next. `push` is the number of the push that the finger makes up to that point, from
one, and zero on its way between pushes.
"""

import csv
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.experiments._record import result_record
from pushjax.experiments._report import Table
from pushjax.experiments._slider_options import expected_surface, parse_fixture, parse_shape, parse_support
from pushjax.experiments.plan.options import Options
from pushjax.geometry.polygon_numpy import outline_vertices, signed_distances
from pushjax.geometry.se2_numpy import to_body
from pushjax.identification.pushes_of_recordings import MAX_SLIDER_SIZE
from pushjax.planning import FinalPose, Goal, PlanStatus, PushPlan, PushScene, PushSequence, finger_motion, plan_pushes
from pushjax.planning.between_pushes import FingerMotion
from pushjax.planning.roadmap import TransitStatus

WAY_POINTS_FILE = "way_points.csv"
MAX_PUSH_LENGTH = 2.5  # in units of the limit surface's length
STEPS = 12  # number of steps of each push
POSSIBLE = (PlanStatus.FOUND, PlanStatus.UNLIKELY)  # the finger can do what the plan says


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
    degree = {"ellipsoid": 2, "quartic": 4}[options.surface]
    slider = pj.Slider(shape, expected_surface(support, degree, seed))
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
    files, pictures = [], []
    if out is not None:
        from pushjax.experiments.plan.picture import draw

        if motion is None:
            (out / WAY_POINTS_FILE).unlink(missing_ok=True)  # a robot must not follow the plan of an earlier call
        else:
            files.append(str(_write_way_points(out / WAY_POINTS_FILE, motion)))
        pictures.append(str(draw(slider, goal, fixtures, plan, options, out / "plan.png")))
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


def _write_way_points(path: Path, motion: FingerMotion) -> Path:
    """Write the motion of the finger, rounded to micrometers and milliseconds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(("time", "push", "finger_x", "finger_y"))
        for time, push, (x, y) in zip(motion.time, motion.push, motion.position, strict=True):
            rows.writerow((f"{time:.3f}", int(push), f"{x:.6f}", f"{y:.6f}"))
    return path


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
