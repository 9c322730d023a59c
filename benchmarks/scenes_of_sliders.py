"""Random scenes of several sliders in contact, and a judge of their motion, in NumPy."""

from typing import NamedTuple

import numpy as np

LENGTH = 0.03  # m
PERIOD = 0.04  # side of the squares of a grid, m


class Touch(NamedTuple):
    """A contact of a slider with another one, or with a pusher or a wall (-1)."""

    first: int
    second: int
    point: np.ndarray
    normal: np.ndarray  # into the first slider
    velocity: np.ndarray  # of the pusher
    friction: float


class Scenes(NamedTuple):
    """Scenes with the batch last; surfaces are means of squares F . P F, to the power of half the degree."""

    matrix: np.ndarray  # P: (terms, 3, 3, sliders, scenes)
    degree: int
    rows: np.ndarray  # (2, 3, sliders, contacts, scenes)
    goal: np.ndarray  # (2, contacts, scenes)
    friction: np.ndarray  # (contacts, scenes)
    active: np.ndarray

    def surfaces(self) -> np.ndarray:
        """Return the coefficients of the products F_i F_j in the Hessian: (3, 3, products, sliders, scenes)."""
        p = self.matrix
        if self.degree == 2:
            return 2 * np.mean(p, axis=0)[:, :, None]
        pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
        table = [
            (1 if a == b else 2)
            * (
                p * p[:, a, b][:, None, None]
                + p[:, :, a][:, :, None] * p[:, b][:, None]
                + p[:, :, b][:, :, None] * p[:, a][:, None]
            )
            for a, b in pairs
        ]
        return 4 * np.mean(np.stack(table, axis=3), axis=0)

    def value_and_gradient(self, wrench: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return H and its gradient at wrenches (3, sliders, scenes)."""
        along = np.einsum("tijbc,jbc->tibc", self.matrix, wrench)
        square = np.einsum("tibc,ibc->tbc", along, wrench)
        if self.degree == 2:
            return np.mean(square, axis=0), 2 * np.mean(along, axis=0)
        return np.mean(square**2, axis=0), 4 * np.mean(square[:, None] * along, axis=0)


def pile(rng: np.random.Generator, count: int) -> tuple[np.ndarray, list[Touch]]:
    """Disks that touch, one or two fingers."""
    radius = rng.uniform(0.03, 0.05, count)
    center = np.zeros((count, 2))
    for i in range(1, count):
        for _ in range(200):
            other, angle = rng.integers(0, i), rng.uniform(-1.2, 1.2)
            center[i] = center[other] + (radius[i] + radius[other]) * np.array([np.cos(angle), np.sin(angle)])
            if np.all(np.linalg.norm(center[i] - center[:i], axis=1) >= radius[i] + radius[:i] - 1e-9):
                break
    touches = []
    for i in range(count):
        for j in range(i):
            offset = center[i] - center[j]
            distance = np.linalg.norm(offset)
            if distance < radius[i] + radius[j] + 1e-6:
                normal = offset / distance
                touches.append(Touch(i, j, center[j] + normal * radius[j], normal, np.zeros(2), rng.uniform(0.1, 0.5)))
    for finger in range(rng.integers(1, 3)):
        i, angle = finger if finger < count else 0, rng.uniform(-0.7, 0.7)
        normal = np.array([np.cos(angle), np.sin(angle)])
        velocity = normal * rng.uniform(0.5, 1) + rng.normal(0, 0.3, 2)
        touches.append(Touch(i, -1, center[i] - normal * radius[i], normal, velocity, rng.uniform(0.1, 0.5)))
    return center, touches


def grid(rng: np.random.Generator, count: int, closes: bool = False) -> tuple[np.ndarray, list[Touch]]:
    """Squares of a grid, face to face: pads or fingers from the left, in half of the scenes a wall above.

    If it `closes`, there are pads on the right too, most of which are slower or come toward the others.
    """
    cells = [(0, 0)]
    while len(cells) < count:
        x, y = cells[rng.integers(len(cells))]
        dx, dy = [(1, 0), (0, 1), (-1, 0), (0, -1)][rng.integers(4)]
        if (x + dx, y + dy) not in cells:
            cells.append((x + dx, y + dy))
    center, common = PERIOD * np.array(cells, float), rng.uniform(0.1, 0.6)
    same = rng.random() < 0.5
    touches = []

    def face(i: int, j: int, normal: np.ndarray, velocity: np.ndarray) -> None:
        """Add the two ends of a face of slider i."""
        friction, tangent = common if same else rng.uniform(0.1, 0.6), np.array([-normal[1], normal[0]])
        for side in (-1, 1):
            point = center[i] + PERIOD / 2 * (side * tangent - normal)
            touches.append(Touch(i, j, point, normal, velocity, friction))

    still = np.zeros(2)
    for i in range(count):
        for j in range(count):
            step = np.array(cells[i]) - cells[j]
            if abs(step).sum() == 1 and step.sum() > 0:
                face(i, j, step.astype(float), still)
    left = min(x for x, _ in cells)
    for i in [i for i, (x, _) in enumerate(cells) if x == left][:2]:
        normal, velocity = np.array([1.0, 0.0]), np.array([1, rng.choice([0, rng.normal(0, 0.4)])])
        if rng.random() < 0.5:
            face(i, -1, normal, velocity)
        else:
            point = center[i] + PERIOD * np.array([-0.5, rng.choice([0, rng.uniform(-0.5, 0.5)])])
            touches.append(Touch(i, -1, point, normal, velocity, common))
    if closes:
        right, velocity = max(x for x, _ in cells), np.array([rng.uniform(-0.5, 1.2), 0.0])
        for i in [i for i, (x, _) in enumerate(cells) if x == right]:
            face(i, -1, np.array([-1.0, 0.0]), velocity)
    top = max(y for _, y in cells)
    if rng.random() < 0.5:
        for i in [i for i, (_, y) in enumerate(cells) if y == top]:
            face(i, -1, np.array([0.0, -1.0]), still)
    return center, touches


def scenes(kind, sliders: int, contacts: int, count: int, *, degree: int, seed: int, alike: bool = False) -> Scenes:
    """Return scenes of a kind, with a random surface for each slider, or the same round one for all."""
    rng = np.random.default_rng(seed)
    rows, goal = np.zeros((2, 3, sliders, contacts, count)), np.zeros((2, contacts, count))
    friction, active = np.zeros((contacts, count)), np.zeros((contacts, count), bool)
    for scene in range(count):
        center, touches = kind(rng, sliders)
        while len(touches) > contacts:
            center, touches = kind(rng, sliders)
        for k, touch in enumerate(touches):
            axes = np.array([touch.normal, [-touch.normal[1], touch.normal[0]]])
            for body, sign in ((touch.first, 1), (touch.second, -1)):
                if body >= 0:
                    x, y = touch.point - center[body]
                    moment = (x * axes[:, 1] - y * axes[:, 0]) / LENGTH
                    rows[:, :, body, k, scene] += sign * np.column_stack([axes, moment])
            goal[:, k, scene] = axes @ touch.velocity
            friction[k, scene], active[k, scene] = touch.friction, True
    terms = 1 if degree == 2 else 3
    factor = rng.normal(0, 0.3, (terms, 3, 3, sliders, count)) + np.eye(3)[None, :, :, None, None]
    matrix = np.einsum("tikbc,tjkbc->tijbc", factor, factor) / rng.uniform(0.5, 2, (sliders, count)) ** 2
    if alike:
        matrix = np.broadcast_to(np.eye(3)[None, :, :, None, None], matrix.shape)
    return Scenes(matrix, degree, rows, goal / np.abs(goal).max((0, 1)), friction, active)


def violations(given: Scenes, twist: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the largest violation of a condition in each scene, relative to the fastest motion and the forces."""
    slip = np.einsum("qibkc,ibc->qkc", given.rows, twist) - given.goal
    wrench = np.einsum("qibkc,qkc->ibc", given.rows, force)
    speed = np.maximum(1, np.abs(twist).max((0, 1)))
    normal, tangential = force / np.maximum(force[0].max(0), 1e-9)
    apart, along = slip / speed
    inside = given.friction * normal - np.abs(tangential)
    conditions = [-apart, -normal, np.abs(normal * apart), -inside, np.abs(along) * inside, tangential * along]
    of_contacts = np.where(given.active, np.stack(conditions), 0).max((0, 1))
    value, gradient = given.value_and_gradient(wrench)
    size = np.linalg.norm(twist, axis=0)
    moves = size > 1e-6 * speed
    direction = twist / np.where(moves, size, 1) - gradient / np.maximum(np.linalg.norm(gradient, axis=0), 1e-30)
    of_sliders = np.where(moves, np.maximum(np.abs(value - 1), np.abs(direction).max(0)), value - 1).max(0)
    return np.maximum(of_contacts, of_sliders)
