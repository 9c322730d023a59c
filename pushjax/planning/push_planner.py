"""Choice of the next push of least cost to the goal.

The cost of a push is a number of control steps: the transit of the finger around the slider to the start of the push,
the push, and what comes after it. The cheaper of two is chosen:

- The best last push. The library's k-d tree has the pushes whose outcomes are near the relative pose of the goal.
- The best first of several pushes. From where each of the first pushes of least estimated cost leads, the same tree has
  the second pushes that reach the goal. If there are none, it is the push from whose end the cost to go is least.
"""

from copy import copy
from functools import cached_property

import numpy as np
from scipy.spatial import KDTree

from pushjax.geometry.polygon_numpy import outline_vertices
from pushjax.geometry.se2_numpy import compose, inverse, to_body, to_world
from pushjax.planning.cost_to_go import cost_to_go
from pushjax.planning.coverage_table import CoverageTable, Measure
from pushjax.planning.finger_control import SpeedLimits
from pushjax.planning.free_space import GRID_STRIDE, FreeSpace, PoseGrid
from pushjax.planning.obstacles import Obstacles
from pushjax.planning.planned_push import PlannedPush, PushChoice, PushStatus
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.roadmap import Roadmap, Transit, run_ups
from pushjax.planning.scene import PushScene
from pushjax.planning.workspace import BoundingBoxTable, Workspace
from pushjax.simulation.pair import MAX_PENETRATION

CLEARANCE, RUN_UP = 0.08, 0.3  # lengths in units of the surface's length
CANDIDATES, NEIGHBORS = 1500, 4  # first pushes that are continued by a second one, and second pushes for each
MAX_COLLISION_CHECKS, COLLISION_BATCH = 480, 24  # choices that are checked, the best first, and how many at a time
RISK_BATCH = 256  # last pushes whose risk is computed at a time, those that take the fewest steps first
STRIDE = 4  # of first pushes, every so many lengths of the library are considered
BETWEEN = 6.0  # control steps between two pushes, for the cost to go
# A slider outside of the workspace must come back by twice this. If no push does that, it may go farther out by this.
# In units of the surface's length.
OUTSIDE = 0.02
AROUND = 8.0  # distance from the goal along x and y up to which the cost to go is known, in units of the length
COVERED = 0.95  # coverage from which a slider is at the goal, if no other measure is given
MISS_COST = 10.0  # control steps of another push, if the last one misses the goal
NO_TRANSIT_TIME = 60.0  # control steps of a transit between two pushes if none is found
# With known friction, a last push is safe from the score that is this part of the way from `enough` to one. Below it,
# each unit of score costs so many control steps.
SAFE_SCORE, RISK_COST = 0.6, 200.0
INTERPOLATION_FACTOR = 1.2  # of interpolated costs to go; those of the nearest cell, for a first selection, have none
STEPS_PER_LENGTH = 20.0  # control steps for each length of distance from the goal, where there is no cost to go


class PushPlanner:
    """Chooses pushes that bring the slider of a scene to one goal.

    Pushes in which slider or finger comes nearer to a fixture than a clearance are not chosen.

    Args:
        scene: Slider, finger, friction and fixtures.
        library: Pushes of that slider and finger, with that friction.
        goal: The goal, (3,), world, m and rad. The slider must be within the workspace there.
        workspace: Limits of finger and slider.
        speeds: Speeds of the finger.
        measure: Score of final poses. None: the slider must cover 95 % of the goal. Otherwise a function of poses
            relative to the goal, (..., 3), whose values (...,) are from 0 to 1. Its attribute `enough` is the score
            from which the slider is at the goal, and `reach` the largest distance from the goal, m, of such a pose.
        look_ahead: Whether to consider plans of two pushes.
        use_cost_to_go: Whether pushes far from the goal are chosen by the cost to go, or by the distance to the goal.
        miss_cost: If the library has several samples of friction: control steps that a last push costs more, times the
            probability that it misses the goal. Other pushes are chosen by their mean outcome, because the next push
            is planned from where they end.

    Raises:
        ValueError: For a library of another slider, finger or friction, and for a goal at which the slider overlaps a
            fixture or reaches out of the workspace.
    """

    def __init__(
        self,
        scene: PushScene,
        library: PushLibrary,
        goal: np.ndarray,
        workspace: Workspace,
        speeds: SpeedLimits,
        *,
        measure: Measure | None = None,
        look_ahead: bool = True,
        use_cost_to_go: bool = True,
        miss_cost: float = MISS_COST,
    ):
        library.check_made_for(scene)
        self.scene, self.library_samples, self.miss_cost = scene, library, miss_cost
        self.goal, self.workspace, self.speeds = np.asarray(goal, float), workspace, speeds
        self.vertices, length = outline_vertices(scene.one_slider.shape), library.length
        workspace.check_goal(self.goal, self.vertices)
        self.measure = measure or CoverageTable(self.vertices, library.center, length, COVERED)
        self.look_ahead, self.use_cost_to_go = look_ahead, use_cost_to_go
        self.bounding_boxes, self.clearance = BoundingBoxTable(self.vertices), CLEARANCE * length
        self._weigh(None)
        # pushes are looked up in this library; `reweighted` changes `mean_library`, but keeps this one and its tree
        self.indexed_library = library = self.mean_library
        starts, ahead = library.starts, library.directions
        self.run_up = run_ups(self.vertices, scene.radius, self.clearance, starts, ahead, RUN_UP * length)
        self.usable = np.isfinite(self.run_up)
        goals = starts - np.where(self.usable, self.run_up, 0)[:, None] * ahead
        self.obstacles = Obstacles.of(scene.fixtures)
        self.roadmap = Roadmap(self.vertices, scene.radius, self.clearance, goals, self.obstacles)
        half = np.abs(self.vertices).max() / 2  # the slider's origin is at least about this far from a wall
        around = self.goal[:2] + AROUND * length * np.array([[-1.0], [1.0]])
        # lowest and highest position of the slider's origin for which tables are made
        self.table_low = np.maximum(workspace.slider_low + half, around[0])
        self.table_high = np.minimum(workspace.slider_high - half, around[1])
        self.space = None
        if self.obstacles.any:
            self.space = FreeSpace(
                workspace, self.roadmap, library, self.clearance, self.goal, self.table_low, self.table_high
            )
        # of each entry of the library: its push, control steps, and where the finger ends, body frame, m
        push, index = library.entries.T
        travel = library.travel[index]
        self.push, self.push_time = push, speeds.push_time(travel)
        self.ends = (starts[push] + travel[:, None] * ahead[push]).astype(np.float32)
        self.coarse = np.flatnonzero((index % STRIDE == 0) & self.usable[push])

    def reweighted(self, weight: np.ndarray) -> "PushPlanner":
        """Return a planner with other weights of the library's samples. It keeps the tables, and the cost to go.

        So pushes are looked up by their mean outcomes under equal weights: building the tree anew takes too long for a
        control step. Their costs are those of the new weights.

        Args:
            weight: Weights of the samples, (samples,), which add up to one.
        """
        self.prepare()  # so that both planners share the tables
        other = copy(self)
        other._weigh(weight)
        return other

    def _weigh(self, weight: np.ndarray | None) -> None:
        """Set the weights of the library's samples, and the mean outcomes of pushes."""
        self.weight, self.mean_library = weight, self.library_samples.averaged(weight)

    @cached_property
    def value(self) -> PoseGrid | None:
        """Cost to go, or None if the distance to the goal takes its place."""
        if not self.use_cost_to_go:
            return None
        return cost_to_go(
            self.mean_library,
            self.goal,
            self.workspace,
            self.push_time,
            usable=self.usable,
            tolerance=self.measure.reach,
            between=BETWEEN,
            low=self.table_low,
            high=self.table_high,
            vertices=self.vertices,
            space=self.space,
        )

    @cached_property
    def _places(self) -> np.ndarray:
        """Points around the slider where run-ups begin, one for each different start of pushes, (places, 2), m."""
        # Pushes of different directions share a start. Of the points where their run-ups begin, one is taken.
        _, first = np.unique(self.mean_library.starts[self.usable], axis=0, return_index=True)
        return self.roadmap.goals[self.usable][first]

    @cached_property
    def _transit_time(self) -> np.ndarray:
        """Control steps of the transit from each place to the start of each push, (places, pushes)."""
        lengths = self.roadmap.between(self._places)
        return np.where(np.isfinite(lengths), self.speeds.free_time(lengths), NO_TRANSIT_TIME).astype(np.float32)

    @cached_property
    def _end_place(self) -> np.ndarray:
        """Index of the place that is nearest to the finger at the end of each entry, (entries,)."""
        finger = to_body(self.mean_library.relative, self.ends)
        return np.asarray(KDTree(self._places).query(finger)[1])

    def prepare(self) -> None:
        """Compute all tables, which are else computed when they are first needed."""
        _ = self.value, self._transit_time, self._end_place, self.indexed_library.tree
        _ = self.space and self.space.distances

    def is_at_goal(self, pose: np.ndarray) -> bool:
        """Return whether a slider at `pose`, (3,), world, m and rad, is at the goal by `measure`."""
        error = compose(inverse(self.goal), np.asarray(pose, float))
        return bool(self.measure(error) > self.measure.enough)

    def choose(self, pose: np.ndarray, finger: np.ndarray, cost_noise: np.ndarray | None = None) -> PlannedPush:
        """Choose the next push.

        Args:
            pose: Pose of the slider, (3,), world, m and rad.
            finger: Center of the finger, (2,), world, m.
            cost_noise: Control steps that are added to the cost of each push, (pushes,), to choose another one.

        Returns:
            The push. Its status says what it is for, or why there is none.
        """
        pose = np.asarray(pose, float)
        transits = self.roadmap.transits(finger, pose, self.workspace)
        nowhere = Transit(np.asarray(finger, float)[None], np.inf, transits.status)
        none = PlannedPush(PushStatus.NO_TRANSIT, nowhere, finger, finger, pose, np.inf)
        reachable = np.isfinite(transits.lengths) & self.usable
        starts = to_world(pose, self.mean_library.starts)
        reachable &= self.workspace.allows_finger(starts)
        if self.space is not None:
            if self.space.slider_distance(pose) < -MAX_PENETRATION * self.mean_library.length:
                return none._replace(status=PushStatus.START_IN_FIXTURE)
            reachable &= self.space.finger_free(to_world(pose, self.roadmap.goals), starts)
        if not reachable.any():
            return none
        transit_time = self.speeds.free_time(np.where(reachable, transits.lengths + np.nan_to_num(self.run_up), np.inf))
        if cost_noise is not None:
            transit_time = transit_time + cost_noise
        found = self._one_push(pose, transit_time), self._more_pushes(pose, transit_time)
        best = min((each for each in found if each is not None), key=lambda each: each.cost, default=None)
        if best is None:
            return none._replace(status=PushStatus.NO_PUSH)
        push, end = int(self.push[best.entry]), to_world(pose, self.ends[best.entry].astype(float))
        transit = self.roadmap.transit(transits, push, pose)
        return PlannedPush(best.status, transit, starts[push], end, best.target, best.cost)

    def _one_push(self, pose: np.ndarray, transit_time: np.ndarray) -> PushChoice | None:
        """Return the push that reaches the goal at the least cost, which includes its risk of missing."""
        relative = compose(inverse(pose), self.goal)
        near = self.indexed_library.tree.query_ball_point(self.mean_library.features(relative), self.measure.reach)
        entries = np.asarray(near, int)
        entries = entries[np.isfinite(transit_time[self.push[entries]])]
        entries = entries[self.workspace.allows_finger(to_world(pose, self.ends[entries]))]
        back = np.broadcast_to(inverse(relative), (len(entries), 3))
        spent = transit_time[self.push[entries]] + self.push_time[entries]
        cost = self._with_risk(spent, back, entries, must_reach=True)
        return self._least(PushStatus.ONE_PUSH, cost, self.goal, (pose, entries))

    def _with_risk(self, spent: np.ndarray, back: np.ndarray, entries: np.ndarray, *, must_reach: bool) -> np.ndarray:
        """Return the costs of last pushes, with their risk; infinite for some that cannot have the least cost."""
        # `spent` are the control steps without the risk, which is never negative, (pushes,). `back` are the poses of
        # the slider before the pushes, relative to the goal, (pushes, 3). With `must_reach`, pushes that cannot reach
        # the goal have infinite cost.
        cost = np.full(len(entries), np.inf)
        order = np.argsort(spent, kind="stable")
        order = order[np.isfinite(spent[order])]
        for begin in range(0, len(order), RISK_BATCH):
            some = order[begin : begin + RISK_BATCH]
            if self.space is None and spent[some[0]] > cost.min():  # among fixtures, the cheapest may not be free
                break
            risk, may_reach = self._risk(back[some], entries[some])
            cost[some] = np.where(may_reach | (not must_reach), spent[some] + risk, np.inf)
        return cost

    def _risk(self, back: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the risk of missing the goal, in control steps, and whether it may be reached, (pushes,) each."""
        enough = self.measure.enough
        score = self.measure(compose(back, self.mean_library.relative[entries]))
        if len(self.library_samples.outcomes) == 1:
            safe = enough + SAFE_SCORE * (1 - enough)
            return RISK_COST * np.maximum(safe - score, 0), score > enough
        push, index = self.mean_library.entries[entries].T
        reached = self.measure(compose(back, self.library_samples.outcomes[:, push, index])) > enough
        chance = np.average(reached, axis=0, weights=self.weight)
        return self.miss_cost * (1 - chance), (chance > 0) | (score > enough)

    def _more_pushes(self, pose: np.ndarray, transit_time: np.ndarray) -> PushChoice | None:
        """Return the best first of two pushes, if there is one, or else the best by the cost to go."""
        entries, reached = self._first_pushes(pose, transit_time)
        if not len(entries):
            return None
        spent = transit_time[self.push[entries]] + self.push_time[entries]
        total = spent + self._estimate(reached, quick=True)
        best = np.argpartition(total, min(CANDIDATES, len(total) - 1))[:CANDIDATES]
        entries, reached, spent = entries[best], reached[best], spent[best]
        two = self._two_pushes(pose, entries, reached, spent) if self.look_ahead else None
        if two is not None:
            return two
        total = spent + self._estimate(reached, quick=False)
        return self._least(PushStatus.COST_TO_GO, total, reached, (pose, entries))

    def _first_pushes(self, pose: np.ndarray, transit_time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the entries that can come next, and the poses that they lead to."""
        reachable = np.isfinite(transit_time)
        entries = self.coarse[reachable[self.push[self.coarse]]]
        if self.space is not None:
            likely = self.space.probably_free(self.mean_library, pose, np.flatnonzero(reachable))
            entries = entries[likely[self.push[entries], self.mean_library.entries[entries, 1] // GRID_STRIDE]]
        here = pose.astype(np.float32)
        entries = entries[self.workspace.allows_finger(to_world(here, self.ends[entries]))]
        reached = compose(here, self.mean_library.relative[entries])
        outside = self.bounding_boxes.outside(reached, self.workspace)
        # a slider that is outside must come back, or at least not go farther if it cannot
        now, allowance = float(self.bounding_boxes.outside(here, self.workspace)), OUTSIDE * self.mean_library.length
        good = outside <= max(0.0, now - 2 * allowance)
        if not good.any():
            good = outside <= now + allowance
        return entries[good], reached[good]

    def _estimate(self, poses: np.ndarray, *, quick: bool) -> np.ndarray:
        """Return the control steps from poses to the goal; `quick` takes them from the nearest cell of the grid."""
        if self.value is not None:
            return self.value.nearest(poses) if quick else INTERPOLATION_FACTOR * self.value(poses)
        goal = self.mean_library.features(self.goal.astype(np.float32))
        apart = np.sqrt(((self.mean_library.features(poses) - goal) ** 2).sum(-1))
        return STEPS_PER_LENGTH * apart / self.mean_library.length

    def _two_pushes(
        self, pose: np.ndarray, entries: np.ndarray, reached: np.ndarray, spent: np.ndarray
    ) -> PushChoice | None:
        """Return the best of the first pushes that a second one continues to the goal."""
        wanted = compose(inverse(reached), self.goal.astype(np.float32))
        distance, second = self.indexed_library.nearest(wanted, NEIGHBORS, 0.5 * self.measure.reach)
        first, column = np.nonzero(np.isfinite(distance))
        second = second[first, column]
        starts = self.mean_library.starts[self.push[second]].astype(np.float32)
        allowed = self.workspace.allows_finger(to_world(reached[first], starts)) & self.usable[self.push[second]]
        allowed &= self.workspace.allows_finger(to_world(reached[first], self.ends[second]))
        between = self._transit_time[self._end_place[entries[first]], self.push[second]]
        total = np.where(allowed, spent[first] + between + self.push_time[second], np.inf)
        total = self._with_risk(total, inverse(wanted[first]), second, must_reach=False)
        pushes = (pose, entries[first]), (reached[first], second)
        return self._least(PushStatus.TWO_PUSHES, total, reached[first], *pushes)

    def _least(
        self, status: PushStatus, cost: np.ndarray, target: np.ndarray, *pushes: tuple[np.ndarray, np.ndarray]
    ) -> PushChoice | None:
        """Return the choice of least finite cost, (choices,), whose pushes are all free, or None."""
        # `target` is the pose that each choice is for, (choices, 3) or the same for all, and so are the poses of the
        # slider before each of the `pushes`; beside these are its entries, (choices,). Only the `MAX_COLLISION_CHECKS`
        # choices of least cost are considered.
        order = np.argsort(cost, kind="stable")[:MAX_COLLISION_CHECKS]
        order = order[np.isfinite(cost[order])]
        for some in np.split(order, range(COLLISION_BATCH, len(order), COLLISION_BATCH)):
            free = np.ones(len(some), bool)
            for poses, entries in pushes:
                before = np.broadcast_to(poses, (len(cost), 3))[some]
                free &= self.space is None or self.space.free(self.mean_library, before, entries[some])
            if free.any():
                best = some[np.argmax(free)]
                aim = np.broadcast_to(target, (len(cost), 3))[best].astype(float)
                return PushChoice(status, int(pushes[0][1][best]), aim, float(cost[best]))
        return None
