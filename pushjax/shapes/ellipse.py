"""Ellipses.

The point of the outline at the unit vector q = (c, s) is (a c, b s), its outward normal (b c, a s) normalised. Both
queries are one root in q, found in a bracket by a fixed number of rounds outside the derivative; one more,
differentiable round then gives the root its derivatives. Angles appear only as small turns of q.

Closest point to x: a q is a critical point of the distance where f(q) = (a^2 - b^2) s c - a |x| s + b |y| c = 0; in the
quadrant of (|x|, |y|) exactly one, where f falls through zero, and that is the nearest. The rounds are Halley's: third
order, so that after one of them second derivatives are right too, and fast at the evolute's cusps, where the root is
threefold.

Sweep: the disc of radius r touches at q where x + t path = p(q) + r n(q), so g(q) = cross(path, p + r n - x) = 0. On
the half of the outline that faces the path g falls monotonically, so its ends decide whether there is a hit, and there
is one root to find.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, positive, shaped
from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.shapes._base import Closest, Facing, Outline, Shape, equally_spaced, rounding

# Most points take 6 rounds to rounding; but near the evolute's cusps each round gains only a digit, in float32 too.
CLOSEST_ROUNDS = {False: 8, True: 16}  # by whether it is float64
SWEEP_ROUNDS = 8
# Between two of these many nodes the integrand of the arc length is smooth, down to axes of 1 : 100.
ARC_NODES = 512


class EllipseOutline(Outline):
    center: Vec2
    semi: Vec2

    def _at(self, q: Vec2) -> tuple[Vec2, Vec2, Scalar]:
        """The outline's point at `q`, its outward normal, and the speed: arc length per angle of q."""
        across = Vec2(self.semi.y * q.x, self.semi.x * q.y)
        speed = jnp.sqrt(across.dot(across))
        return Vec2(self.semi.x * q.x, self.semi.y * q.y), across.scale(1 / speed), speed

    def closest(self, x: Vec2) -> Closest:
        rel = x - self.center
        q = _foot(self.semi, rel)
        foot, normal, _ = self._at(q)
        return Closest(normal.dot(rel - foot), self.center + foot, normal)

    def facing(self, direction: Vec2) -> Facing:
        across = Vec2(self.semi.x * direction.x, self.semi.y * direction.y)
        reach = jnp.sqrt(across.dot(across))
        point = self.center + Vec2(self.semi.x * across.x, self.semi.y * across.y).scale(1 / reach)
        return Facing(jax.tree.map(lambda entry: entry[None], point), jnp.ones(1, bool))

    def sweep(self, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
        rel = x - self.center
        rounded = jax.lax.stop_gradient((self.semi, rel, path, radius))
        q, crosses = _meeting(*rounded)
        height, slope, *_ = _height(self.semi, rel, path, radius, q)
        # to first order in q, and so to third in what follows: there q only chooses the tangent that is hit
        q = _turned(q, -height / jnp.where(slope < 0, slope, -jnp.inf))
        foot, normal, _ = self._at(q)
        gap = normal.dot(rel - foot) - radius
        approach = -normal.dot(path)
        size = jnp.abs(rel.x) + jnp.abs(rel.y) + radius + self.semi.x + self.semi.y
        hits = crosses & (approach > 0) & (gap >= -rounding(size)) & (gap <= approach)
        fraction = gap / jnp.where(hits, approach, 1.0)
        return jnp.where(hits, jnp.maximum(fraction, 0), jnp.inf)


def _unit(v: Vec2) -> Vec2:
    """`v` at length one; it is never zero."""
    return v.scale(1 / jnp.sqrt(v.dot(v)))


def _turned(q: Vec2, angle: Scalar) -> Vec2:
    """`q` turned by an angle, which is right to second order; always of length one."""
    return _unit(q + q.perp().scale(angle))


def _between(q: Vec2, low: Vec2, high: Vec2) -> Array:
    """Whether `q` lies from `low` to `high`, counter-clockwise, to rounding."""
    slack = -4 * jnp.finfo(q.x.dtype).eps
    return (low.cross(q) >= slack) & (q.cross(high) >= slack)


def _middle(low: Vec2, high: Vec2) -> Vec2:
    """Halfway from `low` to `high`, counter-clockwise, also where they are opposite."""
    return _unit(low + high + low.perp().scale(float(jnp.finfo(low.x.dtype).eps)))


def _falling_root(function, q: Vec2, low: Vec2, high: Vec2, small: Scalar, rounds: int, witness: Scalar) -> Vec2:
    """Where a function of q, positive after `low` and negative before `high`, falls through zero; not differentiated.

    function: of q, its value, its slope by angle, and the step to take. small: a value that is zero but for rounding.
    """

    def round_(_, carry):
        q, low, high = carry
        value, slope, step = function(q)
        there = _turned(q, step)
        above, done = settle((value > 0, jnp.abs(value) <= small), witness)
        low, high = select(above, q, low), select(above, high, q)
        (inside,) = settle((_between(there, low, high) & (slope < 0) & (jnp.abs(step) < 1),), witness)
        return select(done, q, select(inside, there, _middle(low, high))), low, high

    return jax.lax.fori_loop(0, rounds, round_, (q, low, high))[0]


def _imbalance(excess: Scalar, a: Scalar, b: Scalar, q: Vec2, flat: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """f(q) = excess s c - a s + b c, its slope, and Halley's step to its root; no slope counts as less than `flat`."""
    c, s = q
    value = excess * s * c - a * s + b * c
    slope = excess * (c * c - s * s) - a * c - b * s
    bend = -4 * excess * s * c + a * s - b * c
    steep = jnp.where(jnp.abs(slope) > flat, slope, -flat)
    newton = -value / steep
    return value, slope, newton / (1 - jnp.clip(-newton * bend / (2 * steep), -1.0, 0.5))


def _foot(semi: Vec2, rel: Vec2) -> Vec2:
    """q of the outline's point nearest to `rel`."""
    x, y = jnp.where(rel.x < 0, -1.0, 1.0), jnp.where(rel.y < 0, -1.0, 1.0)
    excess = (semi.x + semi.y) * (semi.x - semi.y)
    a, b = semi.x * x * rel.x, semi.y * y * rel.y
    fixed, fixed_semi = jax.lax.stop_gradient(((excess, a, b), semi))
    q = _nearest_quadrant(*fixed, fixed_semi)
    # On the evolute the nearest point has no derivative, and close to it only rounding would be magnified
    flat = jnp.sqrt(jnp.finfo(a.dtype).eps) * (jnp.abs(fixed[0]) + fixed[1] + fixed[2] + fixed_semi.dot(fixed_semi))
    *_, step = _imbalance(excess, a, b, q, flat)
    q = _turned(q, step)
    return Vec2(x * q.x, y * q.y)


def _nearest_quadrant(excess: Scalar, a: Scalar, b: Scalar, semi: Vec2) -> Vec2:
    one, zero = jnp.ones_like(a), jnp.zeros_like(a)
    # A root at the quadrant's end can be overshot where f has the right sign beyond it; where it has not, that end is
    # a critical point that is not the nearest, and the search must not begin there.
    past_start, past_end = settle((a > excess, b > -excess), a)
    low = select(past_start, Vec2(0.8 * one, -0.6 * one), Vec2(one, zero))
    high = select(past_end, Vec2(-0.6 * one, 0.8 * one), Vec2(zero, one))
    # where a bound on the distance would put it
    t = jnp.maximum(a - semi.x * semi.x, b - semi.y * semi.y)
    guess = Vec2(a * (t + semi.y * semi.y), b * (t + semi.x * semi.x))
    size = jnp.abs(guess.x) + jnp.abs(guess.y)
    least = 0.05 * size + jnp.finfo(size.dtype).tiny
    guess = Vec2(jnp.where(past_end, guess.x, guess.x + least), jnp.where(past_start, guess.y, guess.y + least))
    guess = guess.scale(1 / (jnp.abs(guess.x) + jnp.abs(guess.y) + jnp.finfo(size.dtype).tiny))
    undirected = settle(guess.x + guess.y < 0.5, a)
    q = _unit(select(undirected, Vec2(one, one), guess))
    small = 2 * jnp.finfo(a.dtype).eps * (jnp.abs(excess) + a + b)
    tiny = jnp.full_like(a, jnp.finfo(a.dtype).tiny)
    rounds = CLOSEST_ROUNDS[a.dtype == jnp.float64]
    return _falling_root(lambda q: _imbalance(excess, a, b, q, tiny), q, low, high, small, rounds, a)


def _height(semi: Vec2, rel: Vec2, path: Vec2, radius: Scalar, q: Vec2) -> tuple[Scalar, Scalar, Scalar]:
    """g(q), the height of the disc's place at `q` over its path, its slope by the angle of q, and Newton's step."""
    across = Vec2(semi.y * q.x, semi.x * q.y)
    squared = across.dot(across)
    speed = jnp.sqrt(squared)
    normal = across.scale(1 / speed)
    place = Vec2(semi.x * q.x, semi.y * q.y) + normal.scale(radius)
    slope = path.dot(normal) * (speed + radius * semi.x * semi.y / squared)
    value = path.cross(place - rel)
    return value, slope, -value / jnp.where(slope < 0, slope, -jnp.inf)


def _meeting(semi: Vec2, rel: Vec2, path: Vec2, radius: Scalar) -> tuple[Vec2, Array]:
    """q where a disc first touches on its path, and whether the path's line meets the outline at all."""
    moves = path.dot(path) > 0
    along = select(moves, path, Vec2(jnp.ones_like(path.x), jnp.zeros_like(path.x)))
    end = _unit(Vec2(semi.x * along.y, -semi.y * along.x))  # there the outline runs along the path
    first, last = (_height(semi, rel, along, radius, side)[0] for side in (-end, end))
    (crosses,) = settle((moves & (first > 0) & (last < 0),), rel.x)
    # without a radius g is a cosine between its ends; with one, still nearly, and most of all at the ends
    share = jnp.clip((first + last) / jnp.where(crosses, first - last, 1.0), -1.0, 1.0)
    begin = _unit(end.scale(share) - end.perp().scale(jnp.sqrt((1 - share) * (1 + share))))
    size = jnp.abs(rel.x) + jnp.abs(rel.y) + semi.x + semi.y + radius
    small = 0.5 * jnp.finfo(size.dtype).eps * size * jnp.sqrt(along.dot(along))
    height = partial(_height, semi, rel, along, radius)
    return _falling_root(height, begin, -end, end, small, SWEEP_ROUNDS, rel.x), crosses


class Ellipse(Shape):
    """An ellipse about `center` (2,) m, with semi-axes `semi_x` and `semi_y` m along the body frame's axes.

    Raises ValueError for a semi-axis that is not positive and finite, or a centre of another shape.
    """

    semi_x: Float[Array, ""]
    semi_y: Float[Array, ""]
    center: Float[Array, "2"]

    def __init__(self, semi_x: Numeric, semi_y: Numeric, center: Numeric = (0.0, 0.0)):
        dtype = common_dtype(semi_x, semi_y, center)
        self.semi_x, self.semi_y = as_float(semi_x, dtype), as_float(semi_y, dtype)
        self.center = as_float(center, dtype)
        for name, value in (("semi_x", self.semi_x), ("semi_y", self.semi_y)):
            shaped(name, value, ())
            finite(name, value)
            positive(name, value)
        shaped("center", self.center, (2,))
        finite("center", self.center)

    @property
    def area(self) -> Float[Array, ""]:
        return jnp.pi * self.semi_x * self.semi_y

    @property
    def centroid(self) -> Float[Array, "2"]:
        return self.center

    @property
    def bounds(self) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        semi = jnp.stack([self.semi_x, self.semi_y])
        return self.center - semi, self.center + semi

    @property
    def perimeter(self) -> Float[Array, ""]:
        return self._equally_spaced(1)[1]

    def boundary(self, points: int) -> Float[Array, "points 2"]:
        angle, _ = self._equally_spaced(points)
        return self.center[None] + jnp.stack([self.semi_x * jnp.cos(angle), self.semi_y * jnp.sin(angle)], axis=1)

    def _equally_spaced(self, points: int):
        nodes = jnp.linspace(0, 2 * jnp.pi, ARC_NODES + 1, dtype=self.semi_x.dtype)
        return equally_spaced(
            lambda angle: jnp.hypot(self.semi_x * jnp.sin(angle), self.semi_y * jnp.cos(angle)), nodes, points
        )

    def outline(self) -> EllipseOutline:
        return EllipseOutline(Vec2.of(self.center), Vec2(self.semi_x, self.semi_y))
