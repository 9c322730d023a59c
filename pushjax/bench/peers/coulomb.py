"""The exact answer: a tip and a slider on a few points with Coulomb friction at each, quasi-static. Slow, and plain.

The dissipation D(V) = Σ l_i |v_i(V)| of a twist V is convex, and its gradient is the wrench that the table resists. A
tip that sticks prescribes the velocity of the contact point: of all such twists the one of least D. If the force that
holds it leaves the friction cone, the tip slides, the force is on the cone's edge, F, and V is the twist of least D
with F·V = 1, scaled to the normal velocity. |v| is rounded off to sqrt(|v|² + e²) with e ten parts in a million of the
tip's speed, coarse to fine. Shares nothing with the solvers of pushjax or MuJoCo.
"""

import numpy as np

ROUNDING = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)  # e, relative to the tip's speed
STEPS = 80  # of a push of 50 mm: second order, 0.1 µm
ITERATIONS = 60


def loads(supports: np.ndarray) -> np.ndarray:
    """(points,) shares of the load at supports (points, 2), the weight above the origin: by statics for three, and as
    little uneven as statics allows for more (equal stiffness)."""
    balance = np.vstack([np.ones(len(supports)), supports.T])
    return np.linalg.lstsq(balance, np.array([1.0, 0.0, 0.0]), rcond=None)[0]


def push(
    supports: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    friction: float = 0.25,
    side: float = 0.09,
    radius: float = 0.00475,
    steps: int = STEPS,
) -> tuple[np.ndarray, np.ndarray]:
    """Final pose (3,) of a square that starts at pose zero, touched on its left side, as the tip's centre goes straight
    from `start` to `end` (2,), m; and the contact's mode at each step: 0 sticks, else the sign of the friction."""
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
    return pose, modes


def _twist(points, limit, contact, velocity, friction: float) -> tuple[np.ndarray, int]:
    """The slider's twist (3,) and the mode; the inward normal is x. velocity: (2,) of the tip, unit."""
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
    """The twist V of least dissipation with rows V = values, and its wrench: Newton's method with a line search."""
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
    """D, its gradient (3,) and Hessian (3, 3)."""
    arm = np.stack([-points[:, 1], points[:, 0]], axis=1)
    sliding = twist[:2] + twist[2] * arm
    speed = np.sqrt(np.sum(sliding**2, axis=1) + rounding**2)
    jacobian = np.concatenate([np.broadcast_to(np.eye(2), (len(points), 2, 2)), arm[:, :, None]], axis=2)
    unit = sliding / speed[:, None]
    across = np.eye(2) - unit[:, :, None] * unit[:, None, :]
    hessian = np.einsum("p,pij,pik,pkl->jl", limit / speed, jacobian, across, jacobian)
    return float(limit @ speed), np.einsum("p,pij,pi->j", limit, jacobian, unit), hessian
