"""A table whose friction is not the same everywhere, or in every direction."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from pushjax._checks import Numeric, as_float, common_dtype, finite, shaped
from pushjax._vec import Scalar, Vec3, entries, turn
from pushjax.limit_surface.warped import Warp

SIZES = {"grain": 2, "slope": 2, "curvature": 3, "origin": 2}
NEAR_ZERO = 1e-3  # squared: below, sinh(r) / r by its series


class Table(eqx.Module):
    """How the friction between slider and table depends on direction and place, in the world; of an even table all are
    zero, and how large friction is does not matter.

    grain: (2,). Friction along x is exp(2 grain[0]) times that along y; along the diagonal exp(2 grain[1]) times that
    across. slope: (2,), 1/m, by what part friction rises along x and y at `origin` (2,), m. curvature: (3,), 1/m^2, how
    that changes with place: the second derivatives xx, yy, xy of its logarithm.

    Friction that rises to one side moves the centre of pressure there, by length^2 / 2 of the limit surface times the
    slope at the slider's origin: exact to first order for a slider that stands on its rim at that distance, and for
    others but for a factor. Friction that depends on direction stretches the forces of the limit surface: exact for
    translations.

    Raises ValueError for arrays of other shapes or values that are not finite.

    Source: goes beyond Zhou et al. 2017, where the table is even.
    """

    grain: Float[Array, "2"]
    slope: Float[Array, "2"]
    curvature: Float[Array, "3"]
    origin: Float[Array, "2"]

    def __init__(
        self,
        grain: Numeric = (0.0, 0.0),
        slope: Numeric = (0.0, 0.0),
        curvature: Numeric = (0.0, 0.0, 0.0),
        origin: Numeric = (0.0, 0.0),
    ):
        given = {"grain": grain, "slope": slope, "curvature": curvature, "origin": origin}
        dtype = common_dtype(*given.values())
        for name, value in given.items():
            array = as_float(value, dtype)
            shaped(name, array, (SIZES[name],))
            finite(name, array)
            setattr(self, name, array)

    def warp(self, pose: Vec3, length: Scalar) -> Warp:
        """What it does to a slider at a pose, in the slider's frame."""
        angle = turn(pose.z)
        # a symmetric matrix without trace turns twice as fast
        a, b = entries(self.grain)
        cos, sin = angle.x * angle.x - angle.y * angle.y, 2 * angle.x * angle.y
        a, b = cos * a + sin * b, cos * b - sin * a
        squared = a * a + b * b
        small = squared < NEAR_ZERO
        r = jnp.sqrt(jnp.where(small, 1.0, squared))
        even = jnp.where(small, 1 + squared / 2 * (1 + squared / 12 * (1 + squared / 30)), jnp.cosh(r))
        odd = jnp.where(small, 1 + squared / 6 * (1 + squared / 20 * (1 + squared / 42)), jnp.sinh(r) / r)
        sx, sy = entries(self.slope)
        xx, yy, xy = entries(self.curvature)
        ox, oy = entries(self.origin)
        x, y = pose.x - ox, pose.y - oy
        rise_x, rise_y = sx + xx * x + xy * y, sy + xy * x + yy * y
        half = length / 2  # of the squared length, over the length
        cx, cy = half * (angle.x * rise_x + angle.y * rise_y), half * (angle.x * rise_y - angle.y * rise_x)
        # friction that is higher along x: forces along x count less
        return Warp(even - odd * a, even + odd * a, -odd * b, cx, cy)
