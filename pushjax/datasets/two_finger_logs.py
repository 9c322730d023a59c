"""Read original logs of the aluminum triangle pushed with two fingers.

Each session has two files, `exp_<time>_sensor<N>.txt` and `exp_<time>_pushaction<N>.txt`. The first is laid out as a
log of one finger (`triangle_text`). The second has the number of pushes, and then for each the type of its motion and
eleven numbers (`Action`). Push i follows action i; the shorter of the two files counts.

The origin of the hand's frame is midway between the fingers, which are at (0, +-spacing / 2). Its x axis is the
direction in which the hand first approaches. Only the object's poses are taken from the sensor's file. The hand's path
is the commanded one, from the measured start pose, because the robot's own stream ends after half of the rotation.
"""

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pushjax.datasets import triangle
from pushjax.datasets.mit_shapes import nearest_on_outline
from pushjax.datasets.planar import rotation
from pushjax.datasets.recordings import Floats, LogError, Recording, Recordings, collect
from pushjax.datasets.triangle_text import Record, read_records

SPACING = 0.05  # m, between the centers of the fingers
PATH_STEPS = 120  # of the commanded path; the arc of a turn is off the chords between them by at most 1 um
# At the end one finger touches the outline, as far as the motion capture and an unknown outline allow: its center is
# between these distances from the outline, m. If not, the motion capture jumped or the hand did not reach the object.
MIN_END_GAP, MAX_END_GAP = -0.002, 0.004
MAX_TURN = np.radians(60)  # no action turns the object so far; the motion capture jumped
NUMBERS_PER_LINE = (3, 3, 3, 2)  # on the lines of an action after its type


class Action(NamedTuple):
    """A planned push, in the body frame of the object before the push."""

    turns: bool  # whether the hand turns; else it moves straight
    contact: Floats  # (2,), point midway between the fingers when they touch, m
    target: Floats  # (2,), center of rotation, m; or unit vector of the straight motion
    approach: Floats  # (2,), unit vector of the approach
    amount: float  # angle of the rotation, rad, or length of the straight motion, m
    closing: float  # distance from the point midway between the fingers to `contact` at the start, along `approach`, m

    @property
    def nominal(self) -> Floats:
        """(9,) numbers that are equal for its repetitions."""
        return np.concatenate([[self.turns, self.amount, self.closing], self.contact, self.target, self.approach])


def load_two_finger_logs(folder: str | PathLike[str]) -> Recordings:
    """Read all sessions in a folder of one arrangement of the supports.

    The object is tracked at the first and the last sample of each push. The hand's path is the commanded one, in 120
    equal steps. `Recordings.about` has "action" and "began".

    A push becomes a problem if its record is damaged, if neither finger is at the outline at the end, or if the object
    turns by more than 60 degrees. A session becomes a problem if one of its files cannot be read.

    Args:
        folder: The folder, whose name gives the arrangement: it contains "3pts1", say, or the coordinates of the
            support points in the authors' form.

    Returns:
        The usable pushes, in the order of time, and the problems of the others. The surface is unknown.

    Raises:
        LogError: If there are no such files, or if no push is usable.
    """
    path = Path(folder).expanduser()
    sensors = sorted(path.glob("exp_*_sensor*.txt"))
    if not sensors:
        raise LogError(path, "expected logs exp_…_sensor….txt, found none")
    found: list[Recording | LogError] = []
    for sensor in sensors:
        try:
            actions = _read_actions(sensor.with_name(sensor.name.replace("_sensor", "_pushaction")))
            records, problems = read_records(sensor)
        except LogError as error:  # of the whole session
            found.append(error)
            continue
        found += [_convert_push(sensor, *each) for each in zip(records, actions, strict=False)]
        found += [each for each in problems if each.push is None or each.push < len(actions)]
    known = triangle.facts(None, *triangle.support_from_name(path / "any"))
    log = collect(path, found, **known | {"tip_radius": None})
    pushes = sorted(log.pushes, key=lambda push: push.about["began"])
    action = np.unique([push.about["action"] for push in pushes], axis=0, return_inverse=True)[1].reshape(-1)
    numbered = (
        replace(push, index=index, about={**push.about, "action": int(action[index])})
        for index, push in enumerate(pushes)
    )
    return replace(log, pushes=tuple(numbered))


def make_push(
    index: int,
    ends: tuple[Floats, Floats],  # poses (3,) of the object
    hands: tuple[Floats, Floats],  # poses (3,) of the hand, commanded
    turn: float,  # of the hand, rad; if it is zero, the hand moves straight
    center: Floats,  # (2,), about which the hand turns, m
    **about: Any,
) -> Recording:
    """Return the push of a hand along its commanded path, with the poses of the object before and after."""
    fraction = np.linspace(0.0, 1.0, PATH_STEPS + 1)
    start, end = hands
    if turn:
        position = center + np.einsum("sij,j->si", rotation(fraction * turn), start[:2] - center)
    else:
        position = start[:2] + fraction[:, None] * (end - start)[:2]
    path = np.column_stack([position, start[2] + fraction * turn, np.full(len(fraction), SPACING)])
    pose = np.full((len(path), 3), np.nan)
    pose[0], pose[-1] = ends
    return Recording(index, path, pose, about=about)


def _read_actions(path: Path) -> list[Action]:
    """Read the actions of a file of planned pushes."""
    try:
        lines = path.read_text("utf-8", errors="replace").splitlines()
    except OSError as error:
        raise LogError(path, f"expected planned pushes, but cannot read the file: {error.strerror or error}") from error
    size, center = 1 + len(NUMBERS_PER_LINE), triangle.CENTER_OF_MASS[:2]
    actions = []
    for index in range(1, len(lines) - size + 1, size):
        kind = lines[index].strip()
        turns = "Rotation" in kind
        try:
            values = [np.array(line.split(), float) for line in lines[index + 1 : index + size]]
            valid = all(len(v) == n and np.isfinite(v).all() for v, n in zip(values, NUMBERS_PER_LINE, strict=True))
            # the approach and, unless the push turns, the target are directions
            valid &= values[2][:2].any() and (turns or values[1][:2].any())
        except ValueError:
            valid = False
        if not kind or not valid:
            message = "expected the type of a push and 3, 3, 3 and 2 numbers on the lines after it"
            raise LogError(path, message, line=index + 1)
        # the numbers are in mm and degrees, and the points in the corner frame
        (contact, target, approach), (amount, closing) = (point[:2] for point in values[:3]), values[3]
        actions.append(
            Action(
                turns=turns,
                contact=contact / 1000 - center,
                target=target / 1000 - center if turns else target / np.linalg.norm(target),
                approach=approach / np.linalg.norm(approach),
                amount=float(np.radians(amount) if turns else amount / 1000),
                closing=float(closing / 1000),
            )
        )
    return actions


def _convert_push(path: Path, record: Record, action: Action) -> Recording | LogError:
    """Return the push of a record, or the error that says why it is not usable."""

    def error(message: str) -> LogError:
        return LogError(path, message, push=record.index, line=record.line)

    if not len(record.force):
        return error("expected force samples, found none")
    try:
        start, end = triangle.object_poses(record)
    except ValueError as fault:
        return error(str(fault))
    world_from_body = rotation(start[2])
    position = start[:2] + world_from_body @ (action.contact - action.closing * action.approach)
    heading = np.arctan2(*(world_from_body @ action.approach)[::-1])
    if action.turns:
        center, turn = start[:2] + world_from_body @ action.target, action.amount
        end_position = center + rotation(turn) @ (position - center)
    else:
        center, turn = np.full(2, np.nan), 0.0
        end_position = position + world_from_body @ (action.closing * action.approach + action.amount * action.target)
    hand_start, hand_end = np.append(position, heading), np.append(end_position, heading + turn)
    gap = _finger_gap(hand_end, end)
    if not MIN_END_GAP < gap < MAX_END_GAP:
        expected = f"between {1e3 * MIN_END_GAP:g} and {1e3 * MAX_END_GAP:g} mm from the outline at the end"
        return error(f"expected a finger {expected}, found {1e3 * gap:.3g} mm")
    if not abs(end[2] - start[2]) < MAX_TURN:
        found = f"found {np.degrees(end[2] - start[2]):.3g}: the motion capture jumped"
        return error(f"expected the object to turn by less than 60 degrees, {found}")
    about = {"action": action.nominal, "began": float(record.force[0, 0])}
    return make_push(record.index, (start, end), (hand_start, hand_end), turn, center, **about)


def _finger_gap(hand: Floats, pose: Floats) -> float:
    """Return the smallest signed distance of a finger's center from the outline, m, for poses of hand and object."""
    offsets = np.array([[0.0, SPACING / 2], [0.0, -SPACING / 2]])
    fingers = hand[:2] + offsets @ rotation(hand[2]).T
    return float(np.min(nearest_on_outline(triangle.VERTICES, (fingers - pose[:2]) @ rotation(pose[2]))[0]))
