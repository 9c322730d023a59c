"""A second implementation, in plain Python, of a push of a convex polygon by one round finger.

It has the same scheme as `pushjax.simulation.step` and nothing else. There is no arithmetic for cases that do not
occur: only the actual contact mode is solved, and only the nearest edge is evaluated. There are no batches, no
derivatives and no checks.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

from pushjax.friction.quartic import MONOMIALS


class Push(NamedTuple):
    """A slider with a quartic limit surface, and a round finger.

    Attributes:
        vertices: Vertices of the slider's outline, counterclockwise, m, body frame.
        coefficients: Coefficients of the quartic.
        length: Characteristic length, m.
        radius: Radius of the finger, m.
        friction: Coefficient of friction between finger and slider.
        tolerance: Largest sine of the angle that may remain between motion and push where the finger sticks.
    """

    vertices: list[tuple[float, float]]
    coefficients: list[float]
    length: float
    radius: float
    friction: float
    tolerance: float = 1e-12


def push(task: Push, path: list[tuple[float, float]], pose: tuple[float, float, float]) -> list[float]:
    """Return the final pose of the slider. The finger must touch the slider and press on it along the whole path.

    Args:
        task: Slider and finger.
        path: Positions of the finger's center, m, world frame.
        pose: Initial pose of the slider, m and rad.

    Returns:
        The final pose: x, y, angle.
    """
    state = list(pose)
    for before, after in pairwise(path):
        state = _step(task, before, after, state)
    return state


def _step(task: Push, before: tuple[float, float], after: tuple[float, float], pose: list) -> list:
    start = list(before)
    along = [b - a for a, b in zip(start, after, strict=True)]
    turn = _turn(pose[2])
    local = _unrotate([start[0] - pose[0], start[1] - pose[1]], turn)
    free = _free(task, local, _unrotate(along, turn))
    if free > 0:
        start = [s + a * free for s, a in zip(start, along, strict=True)]
        along = [a * (1 - free) for a in along]
        local = _unrotate([start[0] - pose[0], start[1] - pose[1]], turn)
    gap, point, normal = _nearest(task, local)
    motion = _contact(task, point, normal, _unrotate(along, turn), gap)
    there, seen = _moved(pose, turn, point, [m * 0.5 for m in motion], turn)
    finger = [s + a * 0.5 for s, a in zip(start, along, strict=True)]
    local = _unrotate([finger[0] - there[0], finger[1] - there[1]], seen)
    _, point, normal = _nearest(task, local)
    motion = _contact(task, point, normal, _unrotate(along, seen), gap)
    moved, _ = _moved(pose, turn, point, motion, seen)
    return moved


def _turn(angle: float) -> tuple[float, float]:
    return math.cos(angle), math.sin(angle)


def _rotate(v: list, turn: tuple) -> list:
    return [turn[0] * v[0] - turn[1] * v[1], turn[1] * v[0] + turn[0] * v[1]]


def _unrotate(v: list, turn: tuple) -> list:
    return [turn[0] * v[0] + turn[1] * v[1], turn[0] * v[1] - turn[1] * v[0]]


def _moved(pose: list, turn: tuple, point: Any, motion: Any, seen: tuple) -> tuple[list, tuple]:
    """Move the contact point in a straight line and rotate the slider about it.

    The motion is that of the points, along chords, so the angle is the one whose chord is `motion[2]`.
    """
    angle = pose[2] + 2 * math.asin(motion[2] / 2)
    after = _turn(angle)
    straight = _rotate([motion[0] - motion[2] * point[1], motion[1] + motion[2] * point[0]], seen)
    swing = [a - b for a, b in zip(_rotate(point, after), _rotate(point, turn), strict=True)]
    return [pose[0] + straight[0] - swing[0], pose[1] + straight[1] - swing[1], angle], after


def _nearest(task: Push, x: list) -> tuple[float, list, list]:
    """Return distance to the finger's rim, the slider's contact point, and the inward normal.

    The finger's center must not be deep inside the slider. The nearest edge is the one over whose line the center is
    highest. A corner takes one more square root.
    """
    count, best = len(task.vertices), None
    for k in range(count):
        a, b = task.vertices[k], task.vertices[(k + 1) % count]
        side = math.hypot(b[0] - a[0], b[1] - a[1])
        unit = ((b[0] - a[0]) / side, (b[1] - a[1]) / side)
        rel = [x[0] - a[0], x[1] - a[1]]
        height = rel[0] * unit[1] - rel[1] * unit[0]
        if best is None or height > best[0]:
            best = (height, unit, rel, a, b, side)
    assert best is not None
    height, unit, rel, a, b, side = best
    s = rel[0] * unit[0] + rel[1] * unit[1]
    if 0 < s < side:
        point = [s * unit[0] + a[0], s * unit[1] + a[1]]
        return height - task.radius, point, [-unit[1], unit[0]]
    corner = a if s <= 0 else b
    off = [x[0] - corner[0], x[1] - corner[1]]
    far = math.sqrt(off[0] * off[0] + off[1] * off[1])
    return far - task.radius, list(corner), [-(off[0] / far), -(off[1] / far)]


def _free(task: Push, x: list, along: list) -> Any:
    """Return the fraction of the step in which the finger moves freely; the last step leaves a gap of third order."""
    distance, point, normal = _nearest(task, x)
    approach = normal[0] * along[0] + normal[1] * along[1]
    if distance <= 0 or approach <= 0:
        return 0.0
    rel = [x[0] - point[0], x[1] - point[1]]
    if tuple(point) not in task.vertices:  # over an edge
        return distance / approach
    a = along[0] * along[0] + along[1] * along[1]
    b = rel[0] * along[0] + rel[1] * along[1]
    side = rel[0] * along[1] - rel[1] * along[0]
    root = math.sqrt(a * (task.radius * task.radius) - side * side)
    return (rel[0] * rel[0] + rel[1] * rel[1] - task.radius * task.radius) / (root - b)


def _contact(task: Push, point: list, n: list, motion: list, gap: float) -> list:
    """Return the slider's twist, body frame (`contact.single`)."""
    t = [-n[1], n[0]]
    v = [n[0] * motion[0] + n[1] * motion[1] - gap, t[0] * motion[0] + t[1] * motion[1]]
    inverse = 1 / task.length
    a = [*n, (point[0] * n[1] - point[1] * n[0]) * inverse]
    b = [*t, (point[0] * t[1] - point[1] * t[0]) * inverse]
    curve = _curve(task.coefficients, a, b)
    s, slides = None, False
    for edge, sign in ((task.friction, 1), (-task.friction, -1)):
        g = _motion(curve, edge)
        if g[0] > 0 and sign * float(g[0] * v[1] - g[1] * v[0]) > 0:
            s, slides = edge, True
            break
    if s is None:
        s = _root(curve, v, task)
        g = _motion(curve, s)
    scale = v[0] / g[0] if slides else (v[0] * g[0] + v[1] * g[1]) / (g[0] * g[0] + g[1] * g[1])
    aside = scale * g[1] if slides else v[1]
    ray = [p + s * q for p, q in zip(a, b, strict=True)]
    omega = scale * _spin(task.coefficients, ray) * inverse
    return [
        n[0] * v[0] + t[0] * aside + omega * point[1],
        n[1] * v[0] + t[1] * aside - omega * point[0],
        omega,
    ]


def _curve(c: list[float], a: list, b: list) -> list:
    """Return the coefficients of H(a + s b), from products of quadratics in s (`QuarticForm.restrict`)."""

    def products(p, q):
        return [p[i] * q[j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]

    def mixed(p, q):
        squares = [(p[i] + p[i]) * q[i] for i in range(3)]
        return squares + [p[i] * q[j] + p[j] * q[i] for i, j in ((0, 1), (0, 2), (1, 2))]

    def factors(m):
        xx, yy, zz, xy, xz, yz = m
        return (
            xx * c[0] + xy * c[3] + xz * c[4] + yy * c[9] + zz * c[10] + yz * c[12],
            yy * c[1] + xy * c[5] + yz * c[6] + zz * c[11] + xz * c[13],
            zz * c[2] + xz * c[7] + yz * c[8] + xy * c[14],
        )

    monomials = [products(a, a), mixed(a, b), products(b, b)]
    linear = [factors(m) for m in monomials]
    found: list[Any] = [None] * 5
    for i in range(3):
        for j in range(3):
            for k in range(3):
                term = monomials[i][k] * linear[j][k]
                found[i + j] = term if found[i + j] is None else found[i + j] + term
    return found


def _motion(c: list, s: Any) -> list:
    """Return normal and tangential motion of the contact point at the force ratio s."""
    slope = ((c[4] * 4 * s + c[3] * 3) * s + c[2] * 2) * s + c[1]
    value = (((c[4] * s + c[3]) * s + c[2]) * s + c[1]) * s + c[0]
    return [value * 4 - s * slope, slope]


def _root(c: list, v: list, task: Push) -> float:
    """Return the force ratio of a sticking contact: Newton's method on the cubic v x motion(s) divided by sqrt(h)."""
    cubic = [
        v[0] * c[1] - v[1] * c[0] * 4,
        v[0] * c[2] * 2 - v[1] * c[1] * 3,
        v[0] * c[3] * 3 - v[1] * c[2] * 2,
        v[0] * c[4] * 4 - v[1] * c[3],
    ]
    s = v[1] / v[0]
    if abs(s) > task.friction:
        s = math.copysign(task.friction, s)
    size = abs(float(c[0]) * math.hypot(*v))
    for _ in range(60):
        r = ((cubic[3] * s + cubic[2]) * s + cubic[1]) * s + cubic[0]
        if abs(r) <= task.tolerance * size:
            break
        slope = (cubic[3] * 3 * s + cubic[2] * 2) * s + cubic[1]
        h = (((c[4] * s + c[3]) * s + c[2]) * s + c[1]) * s + c[0]
        bend = ((c[4] * 4 * s + c[3] * 3) * s + c[2] * 2) * s + c[1]
        s = s - r * h / (slope * h - r * bend * 0.5)
    return s


def _spin(coefficients: list[float], f: list) -> float:
    """Return dH/dz. Only 10 of the 15 monomials depend on z; their powers are computed once."""
    x, y, z = f
    xx, yy, zz = x * x, y * y, z * z
    power: dict[tuple[int, int, int], Any] = {
        (0, 0, 3): zz * z, (3, 0, 0): xx * x, (0, 3, 0): yy * y, (1, 0, 2): x * zz, (0, 1, 2): y * zz,
        (2, 0, 1): xx * z, (0, 2, 1): yy * z, (2, 1, 0): xx * y, (1, 2, 0): yy * x, (1, 1, 1): x * y * z,
    }  # fmt: skip
    total: Any = None
    for exponent, c in zip(MONOMIALS, coefficients, strict=True):
        if exponent[2]:
            i, j, k = (int(e) for e in exponent)
            term = power[i, j, k - 1] * (c * k)
            total = term if total is None else total + term
    return total
