"""Plans of pushes that reach a goal under friction that is not known.

A plan is open loop: the hand's paths are fixed before the first push. Each push is given in the slider's frame
(`PushSequence`), at the pose that the pushes before it lead to under the mean friction. The search runs in two stages:

1. under the mean friction, from many random plans: which ways there are to reach the goal at all;
2. under sampled friction, the same samples for all candidates: which of these plans does so most surely, and how to
   change it so that it does more surely still.

The search has seen its samples, so the plan's own distribution and its probability of success are computed with others.
Between two pushes a finger goes around the slider (`between_pushes`). A sample in which it would touch the slider there
does not count as a success. The transits are looked for only when the search has ended: the plan is the best candidate
that has them.
"""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_type, checked_array
from pushjax.geometry.polygon_numpy import outline_vertices, signed_distances
from pushjax.geometry.se2_numpy import to_body
from pushjax.metrics import mean_pose
from pushjax.planning.between_pushes import TIGHT, transits_between
from pushjax.planning.costs import Cost, FinalPose, HandClearance, Mean, Missed, Risk
from pushjax.planning.goal import Goal, PlanStatus
from pushjax.planning.obstacles import OVERLAP_TOLERANCE, Obstacles
from pushjax.planning.push_problem import Outcomes, PushProblem, lay_out, objective, push_problem, samples_of
from pushjax.planning.push_sequence import PushSequence
from pushjax.planning.roadmap import Transit, TransitStatus
from pushjax.planning.scene import PushScene
from pushjax.planning.search import Candidates, CrossEntropy, Search, Selection
from pushjax.simulation.arguments import check_start_beside_each_other
from pushjax.simulation.pair import MAX_PENETRATION
from pushjax.simulation.slider import fixture_overlaps

UNSEEN_SAMPLES = 256  # samples of the predicted outcomes
HAND_IN_FIXTURE_COST = 10.0  # least cost of a hand that runs into a fixture
MISSED_WIDTH = 0.5  # width of the smooth transition of `Missed` in the default cost, in tolerances
NOMINAL_STAGE = (Selection(64), CrossEntropy(iterations=6, population=16, elites=4))
ROBUST_STAGE = (Selection(16), CrossEntropy(iterations=10, population=32))


class PushPlan(NamedTuple):
    """A plan of pushes.

    Attributes:
        status: Whether it is sure enough.
        path: Paths of the hand, (pushes, steps + 1, dof), world. Pushes that move the slider in no sample are left out.
        pose: Poses of the slider under the mean friction, before the first push and after each, (pushes + 1, 3), world;
            of several sliders (pushes + 1, sliders, 3).
        transits: Transits of the finger to the start of each push, and its last retreat, (pushes + 1). Empty for other
            hands.
        parameters: Its parameters, as in `PushSequence`, (size,), also of pushes that are left out.
        outcomes: Predicted poses under friction that the search has not seen, as of `push_outcomes`.
        pushed: Index of the slider that each push is made on, (pushes,).
        success: Predicted probability of success: the fraction of these samples that reach the goal, and that the
            finger does not touch between pushes. Zero for a plan that cannot be carried out.
        cost: Its cost in the search.
        history: Least cost after each iteration of the search under sampled friction, (iterations,).
    """

    status: PlanStatus
    path: np.ndarray
    pose: np.ndarray
    transits: tuple[Transit, ...]
    parameters: np.ndarray
    outcomes: Outcomes
    pushed: np.ndarray
    success: float
    cost: float
    history: np.ndarray


def plan_pushes(
    key: PRNGKeyArray,
    scene: PushScene,
    start: ArrayLike,
    goal: Goal,
    *,
    pushes: PushSequence,
    cost: Cost | None = None,
    risk: Risk | None = None,
    samples: int = 32,
    candidates: int = 2048,
    nominal_search: Sequence[Search] = NOMINAL_STAGE,
    search: Sequence[Search] = ROBUST_STAGE,
    success: float = 0.9,
    finger: ArrayLike | None = None,
) -> PushPlan:
    """Plan pushes that bring a slider to a goal, as surely as can be under friction that is not known.

    Of several sliders, the first one is brought to the goal. They push each other, and pushes may be made on any of
    those that `pushes` names.

    The same arguments give the same bits. All candidates share their sampled friction.

    Args:
        key: PRNG key of everything random.
        scene: Slider or several, hand (of round fingers), friction and fixtures. A slider may run into fixtures, and
            then moves as in a simulation; the hand stays out of them, in pushes and, if it is one finger, between them.
        start: Pose of the slider at the start, (3,), world, m and rad, or samples of a belief, (poses, 3); of several
            sliders (sliders, 3) or (poses, sliders, 3). Sample k of the friction starts at pose k modulo the number of
            poses. So of more poses than samples only the first are used, `samples` in the search and 256 in the
            prediction.
        goal: The goal.
        pushes: How many pushes, and what is free in each.
        cost: Cost of a push; by default, `Missed` with a smooth transition and a thousandth of the squared error.
        risk: What is minimized over the samples of the cost; by default the mean.
        samples: Number of samples of friction in the search.
        candidates: Number of random plans that the search starts from.
        nominal_search: Searches under the mean friction.
        search: Searches under sampled friction, which start from the result of `nominal_search`.
        success: Probability of success that is asked for.
        finger: Where the finger is at first, (2,), world, m; for a hand of one finger. By default it is where its
            first push begins.

    Returns:
        The plan. Its status says whether it is as sure as was asked for.

    Raises:
        ValueError: For a count below one, a start that is not finite or of another shape, a success outside [0, 1], a
            finger in the slider or in a fixture or for another hand, a start at which sliders overlap, a start or a
            goal at which the slider overlaps a fixture, a hand that does not fit `pushes`, or pushes on sliders that
            are not in the scene.
        TypeError: For arguments of other types, and for a hand with pads.
    """
    check_type("goal", goal, Goal)
    check_type("pushes", pushes, PushSequence)
    check_count("candidates", candidates)
    if not 0 <= success <= 1:
        raise ValueError(f"success must be a probability; got {success!r}")
    check_type("scene", scene, PushScene)
    pushes.check_hand(scene.hand)
    if max(pushes.sliders) >= len(scene.sliders):
        raise ValueError(f"pushes.sliders is {pushes.sliders}; the scene has {len(scene.sliders)} slider(s)")
    cost = Missed(goal, MISSED_WIDTH) + 0.001 * FinalPose(goal) if cost is None else cost
    risk = Mean() if risk is None else risk
    if scene.fixtures:
        cost = cost + HAND_IN_FIXTURE_COST * HandClearance(scene.hand, scene.fixtures, TIGHT * pushes.clearance)
    criteria = (pushes, cost, risk)
    problem = push_problem(key, scene, start, samples, criteria)
    _check_poses(problem, goal)
    finger_start = _checked_finger(finger, problem)
    found, history = _search(jax.random.fold_in(key, 1), problem, candidates, nominal_search, search)
    unseen = push_problem(jax.random.fold_in(key, 2), scene, start, UNSEEN_SAMPLES, criteria)
    plans = (
        _predicted(parameters, float(least), problem, unseen, goal, success, finger_start)
        for parameters, least in zip(found.parameters, found.cost, strict=True)
    )
    first = next(plans)
    possible = (PlanStatus.FOUND, PlanStatus.UNLIKELY)
    best = next((plan for plan in chain([first], plans) if plan.status in possible), first)
    return best._replace(history=history)


def _search(
    key: PRNGKeyArray, problem: PushProblem, candidates: int, nominal_search: Sequence[Search], search: Sequence[Search]
) -> tuple[Candidates, np.ndarray]:
    """Return the best candidates, and the least cost after each iteration under sampled friction."""
    keys = iter(jax.random.split(key, 1 + len(nominal_search) + len(search)))
    mean_start = mean_pose(problem.start)[None]
    nominal = eqx.tree_at(lambda p: (p.draws, p.start), problem, (problem.mean, mean_start))
    found = Candidates(problem.pushes.sample(next(keys), candidates), np.full(candidates, np.inf))
    history = [np.zeros(0)]
    for each in nominal_search:
        found, _ = each(next(keys), objective(nominal), found)
    for each in search:
        found, costs = each(next(keys), objective(problem), found)
        history.append(costs)
    return found, np.concatenate(history)


def _predicted(
    parameters: np.ndarray,
    cost: float,
    problem: PushProblem,
    unseen: PushProblem,
    goal: Goal,
    success: float,
    finger: np.ndarray | None,
) -> PushPlan:
    """Predict where a candidate ends under unseen friction, and find the transits of the finger between its pushes."""
    paths, poses = lay_out(parameters[None], problem)
    _, found = samples_of(paths, unseen)
    path, poses, outcomes, moves = _without_idle(paths[0], poses[0], Outcomes(found.poses[0], found.failed[0]))
    pushed = problem.pushes.pushed(parameters)[moves]
    good = np.asarray(goal.reached(outcomes.pose)) & ~np.asarray(outcomes.failed)
    transits, has_transits = (), True
    if (scene := problem.scene).has_one_finger:
        outlines = [outline_vertices(slider.shape) for slider in scene.sliders]
        each, samples = poses.reshape(len(poses), -1, 3), np.asarray(outcomes.poses)
        samples = samples.reshape(*samples.shape[:2], -1, 3)
        given = outlines, float(scene.hand.radius[0]), float(problem.pushes.clearance), path, each, samples
        between = transits_between(*given, finger, scene.fixtures, pushed)
        good, transits = good & ~between.touched, between.transits
        has_transits = between.status == TransitStatus.FOUND
    hits = _hand_in_fixture(problem, path)
    probability = float(np.mean(good)) if has_transits and not hits else 0.0
    status = PlanStatus.FOUND if probability >= success else PlanStatus.UNLIKELY
    status = status if has_transits else PlanStatus.NO_TRANSIT
    status = PlanStatus.HAND_IN_FIXTURE if hits else status
    return PushPlan(status, path, poses, transits, parameters, outcomes, pushed, probability, cost, np.zeros(0))


def _without_idle(
    path: np.ndarray, poses: np.ndarray, outcomes: Outcomes
) -> tuple[np.ndarray, np.ndarray, Outcomes, np.ndarray]:
    """Leave out the pushes that move a slider in no sample, nor under the mean friction; and return which are left."""
    every = np.concatenate([poses[None], np.asarray(outcomes.poses)])
    moves = np.any(np.diff(every, axis=1) != 0, axis=(0, *range(2, every.ndim)))
    keep = np.concatenate([[True], moves])
    return path[moves], poses[keep], outcomes._replace(poses=outcomes.poses[:, keep]), moves


def _hand_in_fixture(problem: PushProblem, path: np.ndarray) -> bool:
    """Return whether a finger runs into a fixture along paths, (pushes, steps + 1, dof)."""
    hand = problem.scene.hand
    centers = np.asarray(hand.poses(jnp.asarray(path)), float)[..., :2]
    apart = Obstacles.of(problem.scene.fixtures).segment_clearance(centers[:, :-1], centers[:, 1:])
    return bool(np.any(apart < np.asarray(hand.radius)))


def _check_poses(problem: PushProblem, goal: Goal) -> None:
    """Raise an error if a slider overlaps another one or a fixture at the start, or the first a fixture at the goal."""
    sliders, fixtures, length = problem.scene.sliders, problem.scene.fixtures, problem.scene.length
    starts = problem.start.reshape(-1, len(sliders), 3)
    check_start_beside_each_other(sliders, starts[0] if (starts == starts[:1]).all() else starts, "start")
    if not fixtures:
        return
    # a rollout pushes out what overlaps less
    checks = [("start", slider, starts[:, k], MAX_PENETRATION * length) for k, slider in enumerate(sliders)]
    for name, slider, poses, allowed in [*checks, ("goal", sliders[0], goal.pose[None], OVERLAP_TOLERANCE * length)]:
        depth = np.asarray(fixture_overlaps(slider, fixtures, poses.astype(problem.start.dtype)))
        if depth.max() > allowed:
            raise ValueError(
                f"{name} must be a pose at which the slider overlaps no fixture; got an overlap of "
                f"{1e3 * depth.max():.3g} mm at {np.asarray(poses)[np.argmax(depth)].tolist()}"
            )


def _checked_finger(finger: ArrayLike | None, problem: PushProblem) -> np.ndarray | None:
    """Return where the finger is at first, after checks, or None if that is free."""
    if finger is None:
        return None
    if not problem.scene.has_one_finger:
        raise ValueError("finger is for a hand of one finger; this hand has another configuration")
    given = checked_array("finger", finger, (2,), problem.start.dtype)
    center, radius = np.asarray(given, float), problem.scene.hand.radius[0]
    poses = np.asarray(mean_pose(problem.start), float).reshape(-1, 3)
    apart = [("a fixture", Obstacles.of(problem.scene.fixtures).point_clearance(center))]
    for slider, pose in zip(problem.scene.sliders, poses, strict=True):
        apart.append(("the slider", signed_distances(outline_vertices(slider.shape), to_body(pose, center))))
    for name, distance in apart:
        if (overlap := float(radius - distance)) > 0:
            raise ValueError(f"finger must not overlap {name} at the start; got an overlap of {overlap:.3g} m")
    return center
