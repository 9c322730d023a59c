"""The scene of a plan: slider, hand, friction and fixtures; and samples of its friction.

All candidates of a search share the samples, so that their costs differ by the candidates and not by the draw.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_key, check_type
from pushjax._internal.jit import quick_jit
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.simulation.arguments import check_slider_and_hand, checked_fixtures
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.random_rollout import Distributions, Draws, draw
from pushjax.simulation.slider import Slider


class PushScene(eqx.Module):
    """What is pushed, with what, under which friction, and among which fixtures.

    Libraries, planners, filters and plans of pushes share one scene.

    Args:
        slider: The slider; its limit surface is the mean one if friction is random.
        hand: The hand. Libraries and planners need one round finger, `pj.Hand.finger`.
        friction: Coefficient of contact friction, if it is known, and the limit surface too. Otherwise a
            `pj.FrictionModel`, the distribution of both. The attribute is a model in both cases.
        fixtures: Walls and fixed bodies.

    Raises:
        TypeError: If an argument is of another type.
        ValueError: If `friction` is negative or not finite, or a model that samples again within a push.
    """

    slider: Slider
    hand: Hand
    friction: FrictionModel
    fixtures: Fixtures

    def __init__(self, slider: Slider, hand: Hand, friction: ArrayLike | FrictionModel = 0.0, fixtures: Fixtures = ()):
        check_slider_and_hand(slider, hand)
        self.slider, self.hand = slider, hand
        self.friction = friction if isinstance(friction, FrictionModel) else FrictionModel(None, friction)
        _check_model(self.friction)
        self.fixtures = checked_fixtures(fixtures, jnp.result_type(float))

    @property
    def length(self) -> float:
        """Characteristic length of the limit surface, m."""
        return float(self.slider.surface.length)

    @property
    def has_one_finger(self) -> bool:
        """Whether the hand is one round finger."""
        return self.hand.dof == 2 and len(self.hand.fingers) == 1 and isinstance(self.hand.fingers[0], RoundFinger)

    @property
    def radius(self) -> float:
        """Radius of the finger, m. Raises ValueError for other hands."""
        if not self.has_one_finger:
            raise ValueError("hand must be one round finger, such as `pj.Hand.finger`; this one is another hand")
        return float(str(np.asarray(self.hand.radius)[0]))  # the number that was given, also where it is in float32

    @property
    def mean_friction(self) -> float:
        """Mean coefficient of contact friction."""
        return float(np.mean(np.asarray(self.friction.friction, np.float64)))

    @property
    def is_known(self) -> bool:
        """Whether all samples of friction are the same."""
        low, high = np.asarray(self.friction.friction)
        return self.friction.dof is None and bool(low == high)


def draw_friction(key: PRNGKeyArray, surface: LimitSurface, model: FrictionModel, samples: int) -> Draws:
    """Sample limit surfaces of mean `surface` and contact friction, with the leading axes (samples, 1)."""
    # Each push keeps its friction.
    check_key(key)
    check_type("model", model, FrictionModel)
    check_count("samples", samples)
    _check_model(model)
    return _draw(key, Distributions(model.around(surface), None), model, jnp.arange(samples))


def _check_model(model: FrictionModel) -> None:
    if model.resample_every is not None:
        raise ValueError(f"model.resample_every must be None for a plan; got {model.resample_every}")


@quick_jit
def _draw(key: PRNGKeyArray, distributions: Distributions, model: FrictionModel, indices: jax.Array) -> Draws:
    return jax.vmap(lambda index: draw(jax.random.fold_in(key, index), distributions, model, 1))(indices)


def mean_friction(surface: LimitSurface, model: FrictionModel) -> Draws:
    """Return the mean of the friction that `draw_friction` samples, with the leading axes (1, 1)."""
    mean = Draws(surface, jnp.mean(model.friction), jnp.zeros_like(surface.length))
    return jax.tree.map(lambda leaf: leaf[None, None], mean)
