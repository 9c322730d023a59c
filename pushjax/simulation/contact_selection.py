"""Selection of a finger's or a fixture's contacts from the candidates.

A pad or a wall has more candidates than are needed to constrain it. The nearest of them is selected, and one or two
others that constrain most of the motions that are left free. So whatever lies flat rests on the two ends of what it
touches, however many vertices lie in between.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from pushjax._internal.xla import compute_once
from pushjax._math.vec import Scalar, Vec2
from pushjax.simulation.candidate import Candidates, Features, Touches, pick

# Two candidates nearer to each other than this, in units of the limit surface's length, count as one. The first is for
# a polygon. The second is for a smooth outline, where a corner of a pad and its edge both find the same bump.
SAME_PLACE, SAME_BUMP = 1e-3, 0.1
# A candidate counts as nearer by this fraction of its distance from the middle of all candidates. So of candidates that
# are equally near up to roundoff, the outermost is selected. This does not hold on a polygon that is not convex: there
# two more candidates are selected, and a pad in an inner corner has to rest on that corner.
SAME_DISTANCE = 1e-5


def select_contacts(
    candidates: Candidates,
    count: int,
    is_smooth: bool,  # whether the outline is no polygon
    share_place: bool,  # whether two contacts may be at one place, as in an inner corner of a polygon
    length: Scalar,
    displacement: Vec2,
) -> Features:
    """Return the candidates that are contacts, the likeliest first, given how far the finger moves at each."""
    # distances are compared after the displacement of the finger, with the slider at rest
    candidates, length, displacement = jax.lax.stop_gradient((candidates, length, displacement))
    places = candidates.touches
    places = places._replace(distance=places.distance - places.normal.dot(displacement))
    separation = SAME_BUMP if is_smooth else SAME_PLACE
    offset = places.point - _mean(places.point, places.exists)
    preferred = places.distance - (0.0 if share_place else SAME_DISTANCE) * jnp.sqrt(offset.dot(offset))
    # travel: how far the slider has to move to touch at each place while it stays in contact at those that are chosen
    eligible, travel = places.exists, jnp.zeros_like(preferred)
    chosen = [jnp.argmin(jnp.where(eligible, preferred, jnp.inf)).astype(jnp.int32)]
    present = [jnp.any(eligible)]
    for _ in range(count - 1):
        previous = pick(places, chosen[-1])
        differs, other = _distances_in_other_directions(places, previous, length)
        if not share_place:
            offset = places.point - previous.point
            differs &= offset.dot(offset) > (separation * length) ** 2
        eligible, travel = compute_once((eligible & differs, jnp.maximum(travel, other)), places.distance[0])
        present.append(jnp.any(eligible))
        best = jnp.argmin(jnp.where(eligible, travel, jnp.inf)).astype(jnp.int32)
        chosen.append(jnp.where(present[-1], best, chosen[0]))
    index = jnp.stack(chosen)
    return Features(pick(candidates.first, index), pick(candidates.second, index), jnp.stack(present))


def _mean(points: Vec2, mask: Bool[Array, "places"]) -> Vec2:
    """Return the mean of the points that a mask marks."""
    count = jnp.maximum(jnp.sum(mask), 1)
    return Vec2(*(jnp.sum(jnp.where(mask, entry, 0.0)) / count for entry in points))


def _distances_in_other_directions(
    places: Touches, previous: Touches, length: Scalar
) -> tuple[Bool[Array, "places"], Scalar]:
    """Return which places constrain a different motion than `previous`, and the distance to each, m."""
    # the distance: how far a slider that stays in contact at `previous` has to move until it touches there
    lever = (places.point - previous.point).cross(places.normal) / length
    shared = places.normal.dot(previous.normal)
    freedom = jnp.sqrt(jnp.maximum(1 - jnp.maximum(shared, 0) ** 2, 0) + lever**2)
    gap = jnp.maximum(places.distance - shared * previous.distance, 0) + SAME_PLACE * length
    return freedom > SAME_PLACE, gap / jnp.maximum(freedom, SAME_PLACE)
