"""The scene of a plan: sliders, hand, friction and fixtures; and samples of its friction.

All candidates of a search share the samples, so that their costs differ by the candidates and not by the draw.
"""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pushjax._internal.checks import ArrayLike, check_count, check_key, check_type
from pushjax._internal.jit import quick_jit
from pushjax.friction.friction_model import FrictionModel
from pushjax.friction.limit_surface import LimitSurface
from pushjax.simulation.arguments import check_slider_and_hand, checked_fixtures, checked_friction_range
from pushjax.simulation.fixtures import Fixtures
from pushjax.simulation.hand import Hand, RoundFinger
from pushjax.simulation.random_rollout import Distributions, Draws, draw
from pushjax.simulation.slider import Slider


class PushScene(eqx.Module):
    """What is pushed, with what, under which friction, and among which fixtures.

    Libraries, planners, filters and plans of pushes share one scene.

    Args:
        slider: The slider; its limit surface is the mean one if friction is random. For `plan_pushes` also a tuple of
            several, which push each other; the goal is that of the first one.
        hand: The hand. Libraries and planners need one round finger, `pj.Hand.finger`.
        friction: Coefficient of contact friction, if it is known, and the limit surface too. Otherwise a
            `pj.FrictionModel`, the distribution of both. The attribute is a model in both cases.
        fixtures: Walls and fixed bodies.
        between: Coefficient of friction of several sliders with each other, as in `random_rollout`. The attribute is
            the lowest and the highest, (2, sliders, sliders), or None for one slider.

    Raises:
        TypeError: If an argument is of another type.
        ValueError: If `friction` is negative or not finite, or a model that samples again within a push; if `between`
            is missing for several sliders, given for one, negative or not finite; and for two sliders neither of which
            is a disk or a polygon.
    """

    slider: Slider | tuple[Slider, ...]
    hand: Hand
    friction: FrictionModel
    fixtures: Fixtures
    between: Float[Array, "2 sliders sliders"] | None

    def __init__(
        self,
        slider: Slider | Sequence[Slider],
        hand: Hand,
        friction: ArrayLike | FrictionModel = 0.0,
        fixtures: Fixtures = (),
        between: ArrayLike | None = None,
    ):
        self.slider, self.hand = slider if isinstance(slider, Slider) else tuple(slider), hand
        for each in self.sliders:
            check_slider_and_hand(each, hand)
        self.friction = friction if isinstance(friction, FrictionModel) else FrictionModel(None, friction)
        _check_model(self.friction)
        self.fixtures = checked_fixtures(fixtures, jnp.result_type(float))
        is_one = isinstance(self.slider, Slider)
        if is_one and between is not None:
            raise ValueError("between is for several sliders; got one")
        self.between = None if is_one else checked_friction_range(self.sliders, between, jnp.result_type(float))

    @property
    def sliders(self) -> tuple[Slider, ...]:
        """All sliders."""
        return self.slider if isinstance(self.slider, tuple) else (self.slider,)

    @property
    def one_slider(self) -> Slider:
        """The slider. Raises ValueError if there are several."""
        if isinstance(self.slider, tuple):
            raise ValueError(f"scene: only `plan_pushes` takes several sliders; got {len(self.slider)}")
        return self.slider

    @property
    def length(self) -> float:
        """Characteristic length of the limit surface, the shortest of several, m."""
        return min(float(each.surface.length) for each in self.sliders)

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


def draw_friction(
    key: PRNGKeyArray,
    surface: LimitSurface | tuple[LimitSurface, ...],
    model: FrictionModel,
    samples: int,
    between: Array | None = None,  # as of a `PushScene`
) -> Draws:
    """Sample limit surfaces of mean `surface` and friction at contacts, with the leading axes (samples, 1)."""
    # Each push keeps its friction.
    check_key(key)
    check_type("model", model, FrictionModel)
    check_count("samples", samples)
    _check_model(model)
    return _draw(key, Distributions.of(surface, model, between), model, jnp.arange(samples))


def _check_model(model: FrictionModel) -> None:
    if model.resample_every is not None:
        raise ValueError(f"model.resample_every must be None for a plan; got {model.resample_every}")


@quick_jit
def _draw(key: PRNGKeyArray, distributions: Distributions, model: FrictionModel, indices: Array) -> Draws:
    return jax.vmap(lambda index: draw(jax.random.fold_in(key, index), distributions, model, 1))(indices)


def mean_friction(
    surface: LimitSurface | tuple[LimitSurface, ...], model: FrictionModel, between: Array | None = None
) -> Draws:
    """Return the mean of the friction that `draw_friction` samples, with the leading axes (1, 1)."""
    friction = jnp.mean(model.friction)
    mean = Draws(surface, friction, jnp.zeros_like(friction), None if between is None else jnp.mean(between, axis=0))
    return jax.tree.map(lambda leaf: leaf[None, None], mean)
