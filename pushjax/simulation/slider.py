"""The pushed object, and how deep the fingers of a hand are in it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from pushjax._internal.checks import ArrayLike, check_type
from pushjax._internal.jit import quick_jit
from pushjax._math.vec import Vec3
from pushjax.friction.feet import Feet
from pushjax.friction.fit import fit_limit_surface
from pushjax.friction.limit_surface import LimitSurface
from pushjax.friction.support import Support
from pushjax.geometry.shape import Shape
from pushjax.simulation.finger_motion import finger_motions, fixture_motions, max_penetration, unstack_finger_poses
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand

FIT_PAIRS = 400  # wrench-twist pairs of a fit; more change the fit by less than its own error


class Slider(eqx.Module):
    """The pushed object.

    Attributes:
        shape: Outline, in the slider's body frame.
        surface: Limit surface, in the slider's body frame.
    """

    shape: Shape
    surface: LimitSurface

    def __check_init__(self):
        check_type("shape", self.shape, Shape)
        check_type("surface", self.surface, LimitSurface)

    @staticmethod
    def uniform(shape: Shape, *, degree: int = 4, load: ArrayLike = 1.0) -> "Slider":
        """Slider that presses evenly on the table: the usual assumption if the pressure is not known.

        Args:
            shape: Outline, in the body frame. It must not be traced.
            degree: Degree of the limit surface, 2 (an ellipsoid) or 4.
            load: Total friction limit mu m g, N.

        Returns:
            The slider. Its limit surface is fitted to wrench-twist pairs of `Support.uniform(shape)`.

        Raises:
            ValueError: As in `Support.uniform` and `fit_limit_surface`.

        Examples:
            >>> import pushjax as pj
            >>> slider = Slider.uniform(pj.Polygon.rectangle(0.09, 0.06))
            >>> slider.surface.degree
            4
        """
        check_type("shape", shape, Shape)
        return Slider.on(shape, Support.uniform(shape, load=load), degree=degree)

    @staticmethod
    def on(shape: Shape, support: Support, *, degree: int = 4, exact: bool = False) -> "Slider":
        """Slider with a known distribution of pressure.

        Args:
            shape: Outline, in the body frame.
            support: Pressure under the slider, in the same frame.
            degree: Degree of the limit surface, 2 (an ellipsoid) or 4.
            exact: Whether to take the exact limit surface of the support in place of a polynomial. `solve_contacts`,
                other solvers of contact problems, and tables need a polynomial.

        Returns:
            The slider. Its limit surface is exact (`Feet`), or fitted to 400 wrench-twist pairs of the support, sampled
            with the key 0, so the same arguments give the same bits.

        Raises:
            ValueError: As in `Support.wrench_twist_pairs` and `fit_limit_surface`; for an exact surface, if all loads
                are on one point.
        """
        if exact:
            return Slider(shape, Feet(support.point, support.limit))
        pairs = support.wrench_twist_pairs(jax.random.key(0), FIT_PAIRS)
        return Slider(shape, fit_limit_surface(*pairs, degree=degree))


@quick_jit
def overlaps(slider: Slider, hand: Hand, poses: Array, configuration: Array) -> Array:
    """Return the depth of the deepest finger in the slider, m, for each pose of the slider (poses, 3), world."""

    def depth_of(pose: Array, configuration: Array) -> Array:
        finger_poses = unstack_finger_poses(hand.poses(configuration))
        motions = finger_motions(hand, jnp.zeros(len(hand.fingers), poses.dtype), finger_poses, finger_poses)
        return max_penetration(slider.shape.outline(), motions, Vec3.of(pose), 0.0)

    return jax.vmap(depth_of, (0, 0 if configuration.ndim == 2 else None))(poses, configuration)


@quick_jit
def fixture_overlaps(slider: Slider, fixtures: Fixtures, poses: Array) -> Array:
    """Return the depth of the slider in the fixture that it is deepest in, m, for each pose (poses, 3), world."""
    outline, fixed = slider.shape.outline(), fixture_motions(fixtures)
    return jax.vmap(lambda pose: max_penetration(outline, fixed, Vec3.of(pose), 0.0))(poses)
