"""First contact of a disc that moves straight with a closed cubic spline.

A disc of radius r touches at u where x + t path = p(u) + r n(u), so g(u) = cross(path, p + r n - x) = 0, and the first
contact is the root of least t: at every root the disc is no farther than r from the outline. Its derivative,
g' = cross(path, p') (1 + r kappa), changes sign only where the outline runs along the path, which a quadratic per piece
tells exactly, and where the disc is as round as the hollow it is in, which does not depend on the path. Between those
places g is monotone: its values there tell whether there is a root, and nothing slips through.
"""

from itertools import pairwise
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._vec import Scalar, Vec2, select, settle
from pushjax.shapes._base import rounding
from pushjax.shapes._pieces import Piece, normal_of

SWEEP_ROUNDS = 10
# How many of the places where the path's line enters the outline are solved for, nearest first: their order is known
# beforehand only approximately.
ENTRIES = 3
# Nodes a piece at which it is judged whether the disc is rounder than the hollow it is in.
HOLLOW_SAMPLES = 16


def first_contact(pieces: Piece, x: Vec2, path: Vec2, radius: Scalar, *, convex: bool) -> Scalar:
    """Fraction of `path` after which a disc that starts at `x` first touches, as of `Outline.sweep`."""
    fixed = jax.lax.stop_gradient((pieces, x, path, radius))
    index, t, fraction = _first_root(*fixed, convex=convex)
    # its derivatives
    return jnp.where(fraction <= 1, _met(pieces.chosen(index), t, x, path, radius), jnp.inf)


class Offset(NamedTuple):
    """Where the centre of a disc is that touches a piece, and its derivative by the piece's parameter."""

    center: Vec2
    velocity: Vec2

    @staticmethod
    def of(piece: Piece, t: Scalar, radius: Scalar) -> "Offset":
        point, first, second = piece.at(t)
        normal, speed = normal_of(first)
        # negative where the disc is too round for the hollow
        room = 1 + radius * first.cross(second) / (speed * speed * speed)
        return Offset(point + normal.scale(radius), first.scale(room))

    def over(self, x: Vec2, path: Vec2) -> tuple[Scalar, Scalar, Scalar]:
        """g, the height over a path from `x`; its derivative; and how far along the path (both times its length)."""
        rel = Vec2(self.center.x - x.x, self.center.y - x.y)
        return path.cross(rel), path.cross(self.velocity), path.dot(rel)


def _met(piece: Piece, t: Scalar, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
    """Fraction of the path after which a disc touches at the root `t` of g; infinite if it does not on its way.

    The value is where the disc's place projects to, which is well-conditioned even where the path only grazes. The
    derivatives are those of the time at which the tangent at `t` is met: it is the same time, and one round of Newton's
    method, whose value where the path grazes is a rounding magnified and so left out, makes it right to third order.
    """
    height, slope, along = Offset.of(piece, t, radius).over(x, path)
    step = -height / jnp.where(slope < 0, slope, -jnp.inf)
    t = t + step - jax.lax.stop_gradient(step)
    point, first, _ = piece.at(t)
    normal, _ = normal_of(first)
    rel, squared, approach = x - point, path.dot(path), -normal.dot(path)
    fraction = jax.lax.stop_gradient(along / jnp.where(squared > 0, squared, 1.0))
    loose = rounding(jnp.abs(x.x) + jnp.abs(x.y) + jnp.abs(point.x) + jnp.abs(point.y) + radius)
    hits = (approach > 0) & (fraction * approach >= -loose) & (fraction <= 1)
    by_tangent = (normal.dot(rel) - radius) / jnp.where(hits, approach, 1.0)
    fraction = jnp.maximum(fraction, 0) + by_tangent - jax.lax.stop_gradient(by_tangent)
    return jnp.where(hits, fraction, jnp.inf)


class Slot(NamedTuple):
    """A part of a piece on which g is monotone, or arrays of them: the piece's parameter, g and the way along the path
    at both ends, and whether g is flat there."""

    start: Scalar
    end: Scalar
    height_start: Scalar
    height_end: Scalar
    along_start: Scalar
    along_end: Scalar
    flat_start: Bool[Array, ""]
    flat_end: Bool[Array, ""]

    def begin(self) -> tuple[Array, Array, Array]:
        """About where g falls through zero, as a share of the slot: linear, or parabolic from an end where it is flat;
        and whether it is parabolic from the start, or from the end."""
        fall = self.height_start - self.height_end
        share = jnp.clip(self.height_start / jnp.where(fall > 0, fall, 1.0), 0, 1)
        both = self.flat_start & self.flat_end
        rooted, rest = (jnp.sqrt(part / jnp.where(both, 2, 1)) for part in (share, 1 - share))
        early = self.flat_start & (~both | (share < 0.5))
        late = self.flat_end & ~early
        return jnp.where(early, rooted, jnp.where(late, 1 - rest, share)), early, late


class Room(NamedTuple):
    """A part of a piece where a disc can touch from outside, empty if low = high, or arrays of them; and where the disc
    is at both ends."""

    low: Scalar
    high: Scalar
    at_low: Offset
    at_high: Offset


def _slots(piece: Piece, rooms: list[Room], x: Vec2, path: Vec2, radius: Scalar) -> list[Slot]:
    """The monotone parts of a piece, or of all pieces in arrays; some are empty."""
    # where the outline runs along the path
    constant, linear, square = (path.cross(c.scale(k)) for k, c in enumerate((piece.c1, piece.c2, piece.c3), start=1))
    inside = linear * linear - 4 * constant * square
    half = -(linear + jnp.where(linear < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(inside, 0))) / 2
    one, other = half / jnp.where(square == 0, jnp.inf, square), constant / jnp.where(half == 0, jnp.inf, half)
    turning = [jnp.where(inside > 0, jnp.clip(f(one, other), 0, 1), 0) for f in (jnp.minimum, jnp.maximum)]
    turned = [Offset.of(piece, t, radius).over(x, path) for t in turning]
    slots = []
    for low, high, *ends in rooms:
        first, last = (end.over(x, path) for end in ends)

        def within(t, there, low=low, high=high, first=first, last=last):
            before, after = t <= low, t >= high
            height, _, along = select(before, first, select(after, last, there))
            return jnp.clip(t, low, high), height, along, ~before & ~after

        stops = [within(t, there) for t, there in zip(turning, turned, strict=True)]
        stops = [(low, first[0], first[2], low > 0), *stops, (high, last[0], last[2], high < 1)]
        # both ends' values by turns
        slots += [Slot(*(end[k] for k in range(4) for end in ends)) for ends in pairwise(stops)]
    return slots


def _roomy(pieces: Piece, radius: Scalar, convex: bool) -> list[tuple[Array, Array]]:
    """The parts of each piece where a disc can touch from outside: the first and the last, empty if there is none."""
    zero = jnp.zeros_like(pieces.c0.x)
    if convex:
        return [(zero, zero + 1)]
    grid = jnp.linspace(0, 1, HOLLOW_SAMPLES + 1, dtype=zero.dtype)
    spread = jax.tree.map(lambda field: field[:, None], pieces)

    def room(pieces, t):
        _, first, second = pieces.at(t)
        _, speed = normal_of(first)
        return speed * speed * speed + radius * first.cross(second)

    inside = room(spread, jnp.broadcast_to(grid[None], (zero.size, grid.size))) > 0
    closed = jnp.pad(inside, ((0, 0), (1, 1)))
    rises, falls = inside & ~closed[:, :-2], inside & ~closed[:, 2:]

    def edge(at, outward):
        """From the last node with room towards the next, which has none."""
        within, beyond = grid[at], jnp.clip(grid[at] + outward / HOLLOW_SAMPLES, 0, 1)
        values = room(pieces, within), room(pieces, beyond)
        for _ in range(6):  # false position, with the stale end's value halved
            t = within + (beyond - within) * values[0] / jnp.where(
                values[0] == values[1], jnp.inf, values[0] - values[1]
            )
            value = room(pieces, t)
            kept = value > 0
            within, beyond = jnp.where(kept, t, within), jnp.where(kept, beyond, t)
            values = jnp.where(kept, value, values[0] / 2), jnp.where(kept, values[1] / 2, value)
        return within

    last = grid.size - 1
    low, high = edge(jnp.argmax(rises, axis=1), -1), edge(jnp.argmax(falls, axis=1), 1)
    low_2, high_2 = (
        edge(last - jnp.argmax(rises[:, ::-1], axis=1), -1),
        edge(last - jnp.argmax(falls[:, ::-1], axis=1), 1),
    )
    some, two = jnp.any(inside, axis=1), jnp.sum(rises, axis=1) > 1
    return [(jnp.where(some, low, 0), jnp.where(some, high, 0)), (jnp.where(two, low_2, 1), jnp.where(two, high_2, 1))]


def _order(slot: Slot, squared: Scalar, loose: Scalar) -> Scalar:
    """About how far along the path it enters the outline in a slot; infinite where it does not."""
    fall = slot.height_start - slot.height_end
    enters = (slot.height_start >= -loose) & (slot.height_end <= loose) & (fall > 0)
    begin, *_ = slot.begin()
    along = slot.along_start + begin * (slot.along_end - slot.along_start)
    # a hollow's places lie at most so much beyond its ends
    spread = fall + jnp.abs(slot.along_end - slot.along_start)
    on_path = (along + spread >= -loose) & (along - spread <= squared + loose)
    return jnp.where(enters & on_path, along, jnp.inf)


def _first_root(pieces: Piece, x: Vec2, path: Vec2, radius: Scalar, *, convex: bool):
    """The root of g on the path that is met first: its piece, the piece's parameter, the fraction of the path."""
    # the same for all paths of a batch, and so worked out here and not for each
    known = pieces.c0.x[0]
    rooms = [
        Room(low, high, Offset.of(pieces, low, radius), Offset.of(pieces, high, radius))
        for low, high in settle(_roomy(pieces, radius, convex), known)
    ]
    rooms, extent = settle((rooms, jnp.max(jnp.abs(pieces.c0.x)) + jnp.max(jnp.abs(pieces.c0.y))), known)
    squared = path.dot(path)
    length = jnp.sqrt(jnp.where(squared > 0, squared, 1.0))
    loose = rounding(extent + jnp.abs(x.x) + jnp.abs(x.y) + radius) * length
    order = jnp.concatenate([_order(slot, squared, loose) for slot in _slots(pieces, rooms, x, path, radius)])

    def entry(_, carry):
        order, best = carry
        chosen = jnp.argmin(order)
        part, index = jnp.divmod(chosen, pieces.c0.x.size)
        piece, around = jax.tree.map(lambda field: field[index], (pieces, rooms))
        slots = _slots(piece, around, x, path, radius)
        slot = slots[0]
        for k, candidate in enumerate(slots[1:], start=1):
            slot = select(part == k, candidate, slot)
        t = _root(piece, slot, x, path, radius)
        fraction = _met(piece, t, x, path, radius)
        (sooner,) = settle(((order[chosen] < jnp.inf) & (fraction < best[2]),), x.x)
        order = jnp.where(jnp.arange(order.size) == chosen, jnp.inf, order)
        return order, select(sooner, (index, t, fraction), best)

    none = jnp.zeros_like(jnp.argmin(order)), jnp.zeros_like(loose), jnp.full_like(loose, jnp.inf)
    return jax.lax.fori_loop(0, ENTRIES, entry, (order, none))[1]


def _root(piece: Piece, slot: Slot, x: Vec2, path: Vec2, radius: Scalar) -> Scalar:
    """Where g falls through zero in a slot: Newton's method, in the squared distance from the end about which g is
    nearly a parabola, with halving where it would leave the bracket."""
    begin, early, late = slot.begin()
    flat, parabolic = jnp.where(early, slot.start, slot.end), early | late

    def round_(_, carry):
        t, low, high = carry
        height, slope, _ = Offset.of(piece, t, radius).over(x, path)
        low, high = jnp.where(height > 0, t, low), jnp.where(height > 0, high, t)
        step = -height / jnp.where(slope < 0, slope, -jnp.inf)
        arm = t - flat
        squared = arm * (arm + 2 * step)
        root = flat + jnp.where(arm < 0, -1.0, 1.0) * jnp.sqrt(jnp.maximum(squared, 0))
        there = jnp.where(parabolic & (squared >= 0), root, t + step)
        # once converged, it may leave the bracket by a rounding
        inside = (slope < 0) & (((there >= low) & (there <= high)) | (jnp.abs(there - t) < 1e-6))
        return jnp.where(inside, there, (low + high) / 2), low, high

    start = slot.start + begin * (slot.end - slot.start)
    t, *_ = jax.lax.fori_loop(0, SWEEP_ROUNDS, round_, (start, slot.start, slot.end))
    return settle(t, x.x)
