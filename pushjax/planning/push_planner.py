"""Choice of the next push: one that reaches the goal, else the first of two, else by cost to go.

Costs are control steps: the transit around the slider to the start of the push, the push, and what comes after it.

One push: the outcomes near the relative pose of the goal, by the library's k-d tree.
Two pushes: the poses that promising first pushes lead to are looked up in the same tree. Promising are those for which
    the transit, the push and the cost to go make the least sum.
Farther away: the push with that least sum.
"""

from copy import copy
from functools import cached_property
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from pushjax.geometry.polygon_numpy import outline_vertices, signed_distances
from pushjax.geometry.se2_numpy import compose, inverse, to_body, to_world
from pushjax.planning.cost_to_go import CostToGo, cost_to_go, digest_of_costs
from pushjax.planning.coverage_table import CoverageTable, Measure
from pushjax.planning.finger_control import Pace
from pushjax.planning.free_space import GRID_STRIDE, FreeSpace
from pushjax.planning.planned_push import PlannedPush, PlanStatus, PushChoice
from pushjax.planning.push_library import PushLibrary
from pushjax.planning.roadmap import Roadmap, ShortestTransits, Transit, run_ups
from pushjax.planning.workspace import Extent, Workspace
from pushjax.simulation.pair import MAX_PENETRATION
from pushjax.simulation.slider import Slider

CLEARANCE, RUN_UP = 0.08, 0.3  # in units of the surface's length
CANDIDATES, NEIGHBORS = 1500, 4  # first pushes that are continued by a second one, and second pushes for each
CHECKED, CHECKED_AT_A_TIME = 480, 24  # choices that are checked for collisions, best first, and how many at a time
JUDGED = 256  # last pushes whose risk is computed at a time, those that take the fewest steps first
STRIDE = 4  # of the lengths of first pushes, one in so many is considered
BETWEEN = 6.0  # control steps between two pushes, for the cost to go
# A slider outside of the workspace must come back by twice this, or, where no push does that, go no farther out than
# this; in units of the surface's length.
OUTSIDE = 0.02
AROUND = 8.0  # distance from the goal along x and y up to which the cost to go is known, in units of the length
COVERED = 0.95  # coverage from which a slider is at the goal, if no other measure is given
RETRY = 10.0  # control steps of another push, if the last one misses the goal
NO_TRANSIT_TIME = 60.0  # control steps that count for a transit between two pushes that is not found
# With known friction: a last push whose score is less than this part of the way from enough to one is at risk, and
# costs so many control steps for each unit of score below it.
SAFE_SCORE, RISK_COST = 0.6, 200.0
INTERPOLATION_FACTOR = 1.2  # factor of costs to go that are interpolated
STEPS_PER_LENGTH = 20.0  # control steps for each length of distance from the goal, where there is no cost to go


class PushPlanner:
    """Chooses pushes that bring one slider to one goal.

    Args:
        slider: The slider.
        radius: Radius of the finger, m.
        library: Pushes of that slider and finger.
        goal: The goal, (3,), world, m and rad. The slider must be within the workspace there.
        workspace: Limits of finger and slider, and the fixtures that they stay out of. Pushes in which either comes
            nearer to a fixture than a clearance are not chosen.
        pace: Speeds of the finger.
        measure: Score of final poses. None: the slider must cover 95 % of the goal.
        look_ahead: Whether to consider plans of two pushes.
        value: Cost to go. None: it is computed when it is first needed. False: the distance to the goal instead.
        retry: If the library has several samples of friction: control steps that a last push costs more, times the
            probability that it misses the goal. Other pushes are chosen by their mean outcome, because the next push
            is planned from where they end.

    Raises:
        ValueError: For a library of another slider or finger, and for a goal at which the slider overlaps a fixture or
            reaches out of the workspace.
    """

    def __init__(
        self,
        slider: Slider,
        radius: float,
        library: PushLibrary,
        goal: np.ndarray,
        workspace: Workspace,
        pace: Pace,
        *,
        measure: Measure | None = None,
        look_ahead: bool = True,
        value: CostToGo | bool | None = None,
        retry: float = RETRY,
    ):
        library.check_made_for(slider, radius)
        self.slider, self.radius, self.sampled, self.retry = slider, radius, library, retry
        self.goal, self.workspace, self.pace = np.asarray(goal, float), workspace, pace
        self.vertices, length = outline_vertices(slider.shape), library.length
        workspace.check_goal(self.goal, self.vertices)
        self.measure = measure or CoverageTable(self.vertices, library.center, length, COVERED)
        self.look_ahead, self.extent, self.clearance = look_ahead, Extent(self.vertices), CLEARANCE * length
        self._weigh(None)
        # pushes are looked up in this library; `reweighted` changes `library`, but keeps this one and its tree
        self.searched = library = self.library
        starts = library.starts[:, :2]
        self.run_up = run_ups(self.vertices, radius, self.clearance, starts, library.directions, RUN_UP * length)
        self.usable = np.isfinite(self.run_up)
        goals = starts - np.where(self.usable, self.run_up, 0)[:, None] * library.directions
        self.roadmap = Roadmap(self.vertices, radius, self.clearance, goals)
        self.space = self._free_space() if workspace.obstacles.any else None
        push, index = library.entries.T
        self.push, self.travel = push, library.travel[index]
        self.push_time = pace.push_time(self.travel)
        self.ends = (starts[push] + self.travel[:, None] * library.directions[push]).astype(np.float32)
        self.coarse = np.flatnonzero((index % STRIDE == 0) & self.usable[push])
        self._value = value

    def reweighted(self, weight: np.ndarray) -> "PushPlanner":
        """Return a planner with other weights of the library's samples. It keeps the tables, and the cost to go.

        So pushes are looked up by their mean outcomes under equal weights: building the tree anew takes too long for a
        control step. Their costs are those of the new weights.

        Args:
            weight: Weights of the samples, (samples,), which add up to one.
        """
        self.prepare()  # so that planners share the tables
        other = copy(self)
        other._weigh(weight)
        return other

    def finger_clearance(self, pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the distance of the finger from slider and fixtures, negative where it overlaps one, (...,), m.

        Args:
            pose: Pose of the slider, (3,), world.
            points: Centers of the finger, (..., 2), world.
        """
        apart = signed_distances(self.vertices, to_body(pose, points))
        if self.space is not None:
            apart = np.minimum(apart, self.workspace.obstacles.point_clearance(points))
        return apart - self.radius

    def _weigh(self, weight: np.ndarray | None) -> None:
        """Set the mean outcomes of pushes by weights of the library's samples."""
        self.weight, self.library = weight, self.sampled.averaged(weight)

    @cached_property
    def value(self) -> CostToGo | None:
        """Cost to go, or None if the distance to the goal takes its place."""
        if isinstance(self._value, CostToGo):
            return self._value
        if self._value is False:
            return None
        return cost_to_go(self.library, self.goal, self.workspace, **self._costs())

    def _costs(self) -> dict[str, Any]:
        """Return the other arguments of `cost_to_go`."""
        low, high = self._positions(self.library.length)
        return {
            "push_time": self.push_time,
            "usable": self.usable,
            "tolerance": self.measure.reach,
            "between": BETWEEN,
            "low": low,
            "high": high,
            "vertices": self.vertices,
            "space": self.space,
        }

    def value_digest(self) -> str:
        """Return a hash of what the cost to go depends on, by which it may be kept in a file."""
        return digest_of_costs(self.library, self.goal, self.workspace, **self._costs())

    def _positions(self, length: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the lowest and the highest position of the slider's origin for which tables are made."""
        half = np.abs(self.vertices).max() / 2  # the slider's origin is at least about this far from a wall
        around = self.goal[:2] + AROUND * length * np.array([[-1.0], [1.0]])
        low = np.maximum(self.workspace.slider_low + half, around[0])
        return low, np.minimum(self.workspace.slider_high - half, around[1])

    def _free_space(self) -> FreeSpace:
        given = self.workspace, self.roadmap, self.library, self.clearance, self.goal
        return FreeSpace(*given, *self._positions(self.library.length))

    @cached_property
    def after_push(self) -> np.ndarray:
        """Control steps of the transit from the end of a push in each row to the start of each push, (places, pushes).

        A row is a place of the finger around the slider; `place` is that of each entry.
        """
        lengths = self.roadmap.between(self.places)
        return np.where(np.isfinite(lengths), self.pace.free_time(lengths), NO_TRANSIT_TIME).astype(np.float32)

    @cached_property
    def places(self) -> np.ndarray:
        """Points around the slider where run-ups begin, one for each different start of pushes, (places, 2), m.

        Pushes of different directions share a start. Of the points where their run-ups begin, one is taken.
        """
        _, first = np.unique(self.library.starts[self.usable, :2], axis=0, return_index=True)
        return self.roadmap.goals[self.usable][first]

    @cached_property
    def place(self) -> np.ndarray:
        """Index of the place that is nearest to the finger at the end of each entry, (entries,)."""
        finger = to_body(self.library.relative, self.ends)
        return np.asarray(KDTree(self.places).query(finger)[1])

    def prepare(self) -> None:
        """Compute all tables, which are else computed when they are first needed."""
        _ = self.value, self.after_push, self.place, self.searched.tree, self.space and self.space.distances

    def is_at_goal(self, pose: np.ndarray) -> bool:
        """Return whether a slider at `pose`, (3,), world, m and rad, is at the goal by the planner's `measure`."""
        error = compose(inverse(self.goal), np.asarray(pose, float))
        return bool(self.measure(error) > self.measure.enough)

    def choose(self, pose: np.ndarray, finger: np.ndarray, shake: np.ndarray | None = None) -> PlannedPush:
        """Choose the next push.

        Args:
            pose: Pose of the slider, (3,), world, m and rad.
            finger: Center of the finger, (2,), world, m.
            shake: Control steps that are added to the cost of each push, (pushes,), for another choice than before.

        Returns:
            The push. Its status says what it is for, or why there is none.
        """
        pose = np.asarray(pose, float)
        transits = self.roadmap.transits(finger, pose, self.workspace)
        nowhere = Transit(np.asarray(finger, float)[None], np.inf, transits.status)
        none = PlannedPush(PlanStatus.NO_TRANSIT, nowhere, finger, finger, pose, np.inf)
        reachable = np.isfinite(transits.lengths) & self.usable
        starts = to_world(pose, self.library.starts[:, :2])
        reachable &= self.workspace.allows_finger(starts)
        if self.space is not None:
            if self.space.slider_distance(pose) < -MAX_PENETRATION * self.library.length:
                return none._replace(status=PlanStatus.START_IN_FIXTURE)
            reachable &= self.space.finger_free(to_world(pose, self.roadmap.goals), starts)
        if not reachable.any():
            return none
        transit_time = self.pace.free_time(np.where(reachable, transits.lengths + np.nan_to_num(self.run_up), np.inf))
        if shake is not None:
            transit_time = transit_time + shake
        found = [self._one_push(pose, transit_time), *self._more_pushes(pose, transit_time)]
        best = min((each for each in found if each is not None), key=lambda each: each.cost, default=None)
        if best is None:
            return none._replace(status=PlanStatus.NO_PUSH)
        return self._planned(best, transits, pose)

    def _planned(self, best: PushChoice, transits: ShortestTransits, pose: np.ndarray) -> PlannedPush:
        push = int(self.push[best.entry])
        transit = self.roadmap.transit(transits, push, pose)
        start = to_world(pose, self.library.starts[push, :2])
        end = to_world(pose, self.ends[best.entry].astype(float))
        return PlannedPush(best.status, transit, start, end, best.target, best.cost)

    def _one_push(self, pose: np.ndarray, transit_time: np.ndarray) -> PushChoice | None:
        """Return the push that reaches the goal at the least cost: its control steps, and its risk of missing."""
        relative = compose(inverse(pose), self.goal)
        near = self.searched.tree.query_ball_point(self.library.features(relative), self.measure.reach)
        entries = np.asarray(near, int)
        entries = entries[np.isfinite(transit_time[self.push[entries]])]
        entries = entries[self.workspace.allows_finger(to_world(pose, self.ends[entries]))]
        if not len(entries):
            return None
        back = np.broadcast_to(inverse(relative), (len(entries), 3))
        spent = transit_time[self.push[entries]] + self.push_time[entries]
        cost = self._with_risk(spent, back, entries, must_reach=True)
        best = self._least(cost, (np.broadcast_to(pose, back.shape), entries))
        if best is None:
            return None
        return PushChoice(PlanStatus.ONE_PUSH, int(entries[best]), self.goal, float(cost[best]))

    def _with_risk(self, spent: np.ndarray, back: np.ndarray, entries: np.ndarray, *, must_reach: bool) -> np.ndarray:
        """Return the costs of last pushes, with their risk; infinite for some that cannot have the least cost."""
        # `spent` are the control steps without the risk, which is never negative, (pushes,). `back` are the poses of
        # the slider before the pushes, relative to the goal, (pushes, 3). With `must_reach`, pushes that cannot reach
        # the goal have infinite cost.
        cost = np.full(len(entries), np.inf)
        order = np.argsort(spent, kind="stable")
        order = order[np.isfinite(spent[order])]
        for begin in range(0, len(order), JUDGED):
            some = order[begin : begin + JUDGED]
            if self.space is None and spent[some[0]] > cost.min():  # a fixture may forbid the best
                break
            risk, may_reach = self._risk(back[some], entries[some])
            cost[some] = np.where(may_reach | (not must_reach), spent[some] + risk, np.inf)
        return cost

    def _risk(self, back: np.ndarray, entries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the risk of missing the goal, in control steps, and whether it may be reached, as `_with_risk`."""
        enough = self.measure.enough
        score = self.measure(compose(back, self.library.relative[entries]))
        if len(self.sampled.outcomes) == 1:
            safe = enough + SAFE_SCORE * (1 - enough)
            return RISK_COST * np.maximum(safe - score, 0), score > enough
        push, index = self.library.entries[entries].T
        reached = self.measure(compose(back, self.sampled.outcomes[:, push, index])) > enough
        chance = np.average(reached, axis=0, weights=self.weight)
        return self.retry * (1 - chance), (chance > 0) | (score > enough)

    def _more_pushes(self, pose: np.ndarray, transit_time: np.ndarray) -> list[PushChoice]:
        """Return the best first of two pushes, if there is one, or else the best by the cost to go."""
        entries, reached = self._first_pushes(pose, transit_time)
        if not len(entries):
            return []
        spent = transit_time[self.push[entries]] + self.push_time[entries]
        total = spent + self._estimate(reached, quick=True)
        best = np.argpartition(total, min(CANDIDATES, len(total) - 1))[:CANDIDATES]
        entries, reached, spent = entries[best], reached[best], spent[best]
        two = self._two_pushes(pose, entries, reached, spent) if self.look_ahead else None
        if two is not None:
            return [two]
        total = spent + self._estimate(reached, quick=False)
        k = self._least(total, (np.broadcast_to(pose, reached.shape), entries))
        if k is None:
            return []
        return [PushChoice(PlanStatus.COST_TO_GO, int(entries[k]), reached[k].astype(float), float(total[k]))]

    def _first_pushes(self, pose: np.ndarray, transit_time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the entries that can come next, and the poses that they lead to."""
        reachable = np.isfinite(transit_time)
        entries = self.coarse[reachable[self.push[self.coarse]]]
        if self.space is not None:
            likely = self.space.probably_free(self.library, pose, np.flatnonzero(reachable))
            entries = entries[likely[self.push[entries], self.library.entries[entries, 1] // GRID_STRIDE]]
        here = pose.astype(np.float32)
        entries = entries[self.workspace.allows_finger(to_world(here, self.ends[entries]))]
        reached = compose(here, self.library.relative[entries])
        outside = self.extent.outside(reached, self.workspace)
        # a slider that is outside must come back, or at least not go farther if it cannot
        now, allowance = float(self.extent.outside(here, self.workspace)), OUTSIDE * self.library.length
        good = outside <= max(0.0, now - 2 * allowance)
        if not good.any():
            good = outside <= now + allowance
        return entries[good], reached[good]

    def _estimate(self, poses: np.ndarray, quick: bool) -> np.ndarray:
        """Return the control steps from poses to the goal."""
        if self.value is not None:
            return self.value.nearest(poses) if quick else INTERPOLATION_FACTOR * self.value(poses)
        goal = self.library.features(self.goal.astype(np.float32))
        apart = np.sqrt(((self.library.features(poses) - goal) ** 2).sum(-1))
        return STEPS_PER_LENGTH * apart / self.library.length

    def _two_pushes(
        self, pose: np.ndarray, entries: np.ndarray, reached: np.ndarray, spent: np.ndarray
    ) -> PushChoice | None:
        """Return the best of the first pushes that a second one continues to the goal."""
        goal = self.goal.astype(np.float32)
        wanted = compose(inverse(reached), np.broadcast_to(goal, reached.shape))
        distance, second = self.searched.nearest(wanted, NEIGHBORS, 0.5 * self.measure.reach)
        first, column = np.nonzero(np.isfinite(distance))
        if not len(first):
            return None
        second, distance = second[first, column], distance[first, column]
        starts = self.library.starts[self.push[second], :2].astype(np.float32)
        allowed = self.workspace.allows_finger(to_world(reached[first], starts)) & self.usable[self.push[second]]
        allowed &= self.workspace.allows_finger(to_world(reached[first], self.ends[second]))
        between = self.after_push[self.place[entries[first]], self.push[second]]
        total = np.where(allowed, spent[first] + between + self.push_time[second], np.inf)
        total = self._with_risk(total, inverse(wanted[first]), second, must_reach=False)
        k = self._least(total, (np.broadcast_to(pose, wanted[first].shape), entries[first]), (reached[first], second))
        if k is None:
            return None
        best = first[k]
        return PushChoice(PlanStatus.TWO_PUSHES, int(entries[best]), reached[best].astype(float), float(total[k]))

    def _least(self, cost: np.ndarray, *pushes: tuple[np.ndarray, np.ndarray]) -> int | None:
        """Return the index of the least finite cost of a choice whose pushes are all free, or None."""
        # `pushes` are the poses of the slider before each push, (choices, 3), and its entries, (choices,). Only the
        # `CHECKED` choices of least cost are considered.
        if self.space is None:
            best = int(np.argmin(cost))
            return best if np.isfinite(cost[best]) else None
        order = np.argsort(cost, kind="stable")[:CHECKED]
        order = order[np.isfinite(cost[order])]
        for some in np.split(order, range(CHECKED_AT_A_TIME, len(order), CHECKED_AT_A_TIME)):
            free = [self.space.free(self.library, poses[some], entries[some]) for poses, entries in pushes]
            free = np.all(free, axis=0)
            if free.any():
                return int(some[np.argmax(free)])
        return None
