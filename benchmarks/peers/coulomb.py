"""The exact quasi-static push of a slider on a few support points, with Coulomb friction at each. Slow and simple.

The dissipation D(V) = Σ l_i |v_i(V)| of a twist V is convex. Its gradient is the wrench with which the table resists.

A tip that sticks prescribes the velocity of the contact point. The slider's twist minimizes D among all twists with
that velocity. If the contact force then lies outside the friction cone, the tip slides instead. The force is then on
the edge of the cone, F. V is the twist that minimizes D subject to F·V = 1, scaled to the normal velocity of the tip.

|v| is smoothed to sqrt(|v|² + e²). The smoothing e decreases from a tenth to ten millionths (1e-5) of the tip's speed.

This module shares nothing with the solvers of pushjax or MuJoCo.
"""

import numpy as np

ROUNDING = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # the smoothing e, relative to the tip's speed
STEPS = 80  # for a push of 50 mm; the method is of second order and the error is 0.1 µm
ITERATIONS = 60


def loads(supports: np.ndarray) -> np.ndarray:
    """Return the share of the load on each support, (points,), with the weight above the origin."""
    # For three supports, statics determines the loads. For more, the solution of least norm is as even as statics
    # allows, which corresponds to supports of equal stiffness.
    balance = np.vstack([np.ones(len(supports)), supports.T])
    return np.linalg.lstsq(balance, np.array([1.0, 0.0, 0.0]), rcond=None)[0]


def push(
    supports: np.ndarray,  # (points, 2), m, body frame
    start: np.ndarray,  # of the tip's center, (2,), m
    end: np.ndarray,  # of the tip's center, (2,), m
    friction: float = 0.25,  # coefficient between tip and square
    side: float = 0.09,  # m
    steps: int = STEPS,
) -> tuple[np.ndarray, np.ndarray]:
    """Push a square from pose zero, by a round tip on its left side that moves in a straight line."""
    points, limit = np.asarray(supports, float), loads(np.asarray(supports, float))
    tip, step, pose = np.array(start, float), (np.array(end) - start) / steps, np.zeros(3)
    modes = np.zeros(steps, int)

    def moved(tip: np.ndarray, pose: np.ndarray) -> tuple[np.ndarray, int]:
        cos, sin = np.cos(pose[2]), np.sin(pose[2])
        to_body = np.array([[cos, sin], [-sin, cos]])
        contact = np.array([-side / 2, (to_body @ (tip - pose[:2]))[1]])
        speed = np.hypot(*step)
        twist, mode = _twist(points, limit, contact, to_body @ step / speed, friction)
        return speed * np.append(to_body.T @ twist[:2], twist[2]), mode

    for k in range(steps):
        first, modes[k] = moved(tip, pose)
        pose = pose + moved(tip + step / 2, pose + first / 2)[0]
        tip = tip + step
    return pose, modes  # (3,), m and rad; (steps,), 0 where the contact sticks, else the sign of the tangential force


def _twist(points, limit, contact, velocity, friction: float) -> tuple[np.ndarray, int]:
    """Return the slider's twist, (3,), and the mode. The inward normal is x; `velocity` of the tip is a unit vector."""
    normal, tangent = np.array([1.0, 0.0, -contact[1]]), np.array([0.0, 1.0, contact[0]])
    both = np.stack([normal, tangent])
    twist, wrench = _least(points, limit, both, velocity)
    force = np.linalg.lstsq(both.T, wrench, rcond=None)[0]
    if force[0] > 0 and abs(force[1]) <= friction * force[0]:
        return twist, 0
    edge = normal + np.sign(force[1]) * friction * tangent
    twist, _ = _least(points, limit, edge[None], np.ones(1))
    return twist * velocity[0] / (normal @ twist), int(np.sign(force[1]))


def _least(points, limit, rows, values) -> tuple[np.ndarray, np.ndarray]:
    """Return the twist V, (3,), of least dissipation with rows V = values, and its wrench, (3,), by Newton's method."""
    twist, free = np.linalg.lstsq(rows, values, rcond=None)[0], np.linalg.svd(rows)[2][len(rows) :].T
    for rounding in ROUNDING:
        for _ in range(ITERATIONS):
            dissipated, wrench, hessian = _dissipation(points, limit, twist, rounding)
            slope = free.T @ wrench
            by = -np.linalg.solve(free.T @ hessian @ free + 1e-14 * np.eye(len(slope)), slope)
            gain, share = slope @ by, 1.0
            if gain > -1e-20:
                break
            while share > 1e-10:
                trial = twist + share * free @ by
                if _dissipation(points, limit, trial, rounding)[0] <= dissipated + 1e-4 * share * gain:
                    break
                share /= 2
            twist = twist + share * free @ by
    return twist, _dissipation(points, limit, twist, ROUNDING[-1])[1]


def _dissipation(points, limit, twist, rounding: float) -> tuple[float, np.ndarray, np.ndarray]:
    """Return D, its gradient, (3,), and its Hessian, (3, 3)."""
    arm = np.stack([-points[:, 1], points[:, 0]], axis=1)
    sliding = twist[:2] + twist[2] * arm
    speed = np.sqrt(np.sum(sliding**2, axis=1) + rounding**2)
    jacobian = np.concatenate([np.broadcast_to(np.eye(2), (len(points), 2, 2)), arm[:, :, None]], axis=2)
    unit = sliding / speed[:, None]
    across = np.eye(2) - unit[:, :, None] * unit[:, None, :]
    hessian = np.einsum("p,pij,pik,pkl->jl", limit / speed, jacobian, across, jacobian)
    return float(limit @ speed), np.einsum("p,pij,pi->j", limit, jacobian, unit), hessian
