"""The library's push with the same arithmetic, but written on small arrays, as one would at first: for comparison.

Shapes (2,), (3,), (vertices, 2) and (15,) in one example, and `vmap` over pushes. Quartic, polygon, one round finger.
"""

import jax
import jax.numpy as jnp
import numpy as np

from pushjax.limit_surface import MONOMIALS

CUBICS = np.array([e for e in np.ndindex(4, 4, 4) if sum(e) == 3])
QUADRATICS = np.array([e for e in np.ndindex(3, 3, 3) if sum(e) == 2])


def _derivative_tables():
    first, second = np.zeros((3, len(CUBICS), 15)), np.zeros((3, 3, len(QUADRATICS), 15))
    for m, e in enumerate(MONOMIALS):
        for i in range(3):
            d = e - np.eye(3, dtype=int)[i]
            if d.min() >= 0:
                first[i, np.argmax((CUBICS == d).all(axis=1)), m] += e[i]
            for j in range(3):
                dd = d - np.eye(3, dtype=int)[j]
                if dd.min() >= 0:
                    second[i, j, np.argmax((QUADRATICS == dd).all(axis=1)), m] += e[i] * d[j]
    return first, second


FIRST, SECOND = _derivative_tables()


def gradient(g, f):
    return g @ jnp.prod(f ** jnp.asarray(CUBICS, f.dtype), axis=1)


def perp(v):
    return jnp.stack([-v[1], v[0]])


def turned(angle, v):
    c, s = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([c, -s]), jnp.stack([s, c])]) @ v


def edges_of(vertices):
    edge = jnp.roll(vertices, -1, axis=0) - vertices
    length = jnp.linalg.norm(edge, axis=1)
    along = edge / length[:, None]
    return vertices, along, length, jnp.stack([along[:, 1], -along[:, 0]], axis=1)


def closest(edges, x):
    start, along, length, normal = edges
    s = jnp.sum((x - start) * along, axis=1)
    foot = start + jnp.clip(s, 0, length)[:, None] * along
    k = jnp.argmin(jnp.sum((x - foot) ** 2, axis=1))
    diff = x - foot[k]
    over = (s[k] >= 0) & (s[k] <= length[k])
    far = jnp.linalg.norm(diff)
    sign = jnp.where(jnp.dot(normal[k], diff) >= 0, 1.0, -1.0)
    n = jnp.where(over, normal[k], sign * diff / jnp.where(far > 0, far, 1.0))
    return jnp.where(over, jnp.dot(normal[k], x - start[k]), sign * far), foot[k], n


def sweep(edges, x, path, radius):
    start, along, length, normal = edges
    rel = x - start
    approach, gap = -normal @ path, jnp.sum(normal * rel, axis=1) - radius
    t = gap / jnp.where(approach > 0, approach, 1.0)
    foot = jnp.sum(rel * along, axis=1) + t * (along @ path)
    hits = (approach > 0) & (gap >= 0) & (foot >= 0) & (foot <= length)
    a, b, c = path @ path, rel @ path, jnp.sum(rel**2, axis=1) - radius**2
    disc = b**2 - a * c
    corner = (b < 0) & (c >= 0) & (disc > 0)
    u = c / jnp.where(corner, jnp.sqrt(jnp.where(corner, disc, 1.0)) - b, 1.0)
    return jnp.minimum(jnp.min(jnp.where(hits, t, jnp.inf)), jnp.min(jnp.where(corner, u, jnp.inf)))


def solve(tables, rho, point, n, path, mu, gap):
    g1, h2 = tables
    t = perp(n)
    jn, jt = (jnp.stack([d[0], d[1], (point[0] * d[1] - point[1] * d[0]) / rho]) for d in (n, t))
    v = jnp.stack([path @ n - gap, path @ t])
    pushes = v[0] > 0
    v = jnp.where(pushes, v, jnp.array([1.0, 0.0], v.dtype))
    gn, gt = gradient(g1, jn), gradient(g1, jt)
    hn = h2 @ jnp.prod(jn ** jnp.asarray(QUADRATICS, jn.dtype), axis=1)
    c = jnp.stack([jn @ gn / 4, jt @ gn, jt @ hn @ jt / 2, jn @ gt, jt @ gt / 4])
    k = jnp.arange(5)

    def motion(s):
        return jnp.stack([jnp.polyval(((4 - k) * c)[:4][::-1], s), jnp.polyval((k * c)[1:][::-1], s)])

    def cross(a, b):
        return a[0] * b[1] - a[1] * b[0]

    left, right = motion(mu), motion(-mu)
    is_left = (left[0] > 0) & (cross(left, v) > 0)
    is_right = (right[0] > 0) & (cross(right, v) < 0) & ~is_left
    s = jnp.clip(v[1] / v[0], -mu, mu)

    def body(i, state):
        s, low, high = state
        g = motion(s)
        r, power = cross(v, g), v @ g
        side = jnp.where(g[0] > 0, r, g[1])
        low, high = jnp.where(side > 0, low, s), jnp.where(side < 0, high, s)
        bend = jnp.polyval((k * (k - 1) * c)[2:][::-1], s)
        slope = v[0] * bend - v[1] * (3 * g[1] - s * bend) - 2 * r * g[1] / (g[0] + s * g[1])
        newton = s - r / jnp.where(slope > 0, slope, 1.0)
        trusted = (slope > 0) & (power > 0) & (newton >= low) & (newton <= high)
        trusted &= (i < 2) | (3 * r * r < power * power)
        return jnp.where(trusted, newton, (low + high) / 2), low, high

    s, _, _ = jax.lax.fori_loop(0, 12, body, (s, -mu, mu))
    s = jnp.where(is_left, mu, jnp.where(is_right, -mu, s))
    g = motion(s)
    slides = is_left | is_right
    scale = jnp.where(slides, v[0] / jnp.where(slides, g[0], 1.0), v @ g / (g @ g))
    follow = jnp.stack([v[0], jnp.where(slides, scale * g[1], v[1])])
    omega = scale * gradient(g1, jn + s * jt)[2] / rho
    linear = follow[0] * n + follow[1] * t - omega * perp(point)
    return jnp.where(pushes, jnp.append(linear, omega), 0.0)


def moved(pose, point, twist, angle):
    straight = turned(angle, twist[:2] + twist[2] * perp(point))
    theta = pose[2] + twist[2]
    return jnp.append(pose[:2] + straight - turned(theta, point) + turned(pose[2], point), theta)


def final_pose(coefficients, rho, vertices, radius, path, pose, mu):
    """Pose (3,) after a finger's path (steps + 1, 2); arguments as the library's, in arrays."""
    tables = jnp.asarray(FIRST, path.dtype) @ coefficients, jnp.asarray(SECOND, path.dtype) @ coefficients
    edges = edges_of(vertices)

    def step(pose, ends):
        u0, u1 = ends
        d = u1 - u0
        x, local = turned(-pose[2], u0 - pose[:2]), turned(-pose[2], d)
        distance, _, normal = closest(edges, x)
        gap = distance - radius
        pressing = (gap <= 0) & (-normal @ local > gap)
        hit = sweep(edges, x, local, radius)
        reached = pressing | (hit <= 1)
        start = jnp.where(pressing, 0.0, jnp.where(reached, hit, 1.0))
        pushed = d * jnp.where(reached, 1 - start, 0.0)
        gap = jnp.where(reached, jnp.where(pressing, gap, 0.0), 1.0)

        def stage(carry, share):
            twist, point, angle = carry
            there = moved(pose, point, twist * share, angle)
            _, point, normal = closest(edges, turned(-there[2], u0 + start * d + share * pushed - there[:2]))
            twist = solve(tables, rho, point, -normal, turned(-there[2], pushed), mu, gap)
            return (twist, point, there[2]), None

        zero = jnp.zeros(3, pose.dtype), jnp.zeros(2, pose.dtype), pose[2]
        (twist, point, angle), _ = jax.lax.scan(stage, zero, jnp.array([0.0, 0.5], pose.dtype))
        return moved(pose, point, twist, angle), None

    final, _ = jax.lax.scan(step, pose, (path[:-1], path[1:]))
    return final
