"""Outcomes of straight pushes in the body frame of a slider.

Quasi-static motion depends neither on time nor on where the slider is. So the outcome of a push that is given in the
body frame is one relative pose, and pushes that follow each other compose: if push a moves the slider by A and push b
by B, a and then b move it from pose q to compose(compose(q, A), B).

A slider at pose q is brought to the goal g by one push if the push's outcome is the relative pose compose(inverse(q),
g). So one k-d tree of all outcomes answers from which poses one push reaches any goal, and all plans of two pushes are
one query with the poses that first pushes lead to. The distance in the tree is that of `pose_features`; it is not
changed by a motion of the world, so it is the distance of the final pose from the goal.
"""

import hashlib
import re
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.spatial import KDTree

import pushjax
from pushjax._internal.checks import check_count, check_type
from pushjax.friction.friction_model import FrictionModel
from pushjax.geometry.polygon_numpy import offset_curve, outline_vertices
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning.array_files import check_arrays, load_arrays, save_arrays
from pushjax.planning.friction_samples import draw_friction
from pushjax.planning.push_batch import simulate_pushes
from pushjax.simulation.hand import Hand
from pushjax.simulation.slider import Slider

# Lengths in units of the surface's length, which is about the slider's radius.
GAP = 0.04  # between finger and slider where a push starts
STEP = 0.0275  # of the simulation, and between neighboring lengths of a push
TRAVEL = 2.3  # longest push
LEAST_MOTION = 0.005  # a push that moves the slider less than this is not valid

FORMAT = 2  # of the file, and of what is computed here: raise it when either changes
SHAPES = {
    "starts": ("pushes", "dof"),
    "directions": ("pushes", 2),
    "travel": ("lengths",),
    "outcomes": ("samples", "pushes", "lengths", 3),
    "valid": ("pushes", "lengths"),
    "length": (),
    "center": (2,),
    "slider": ("numbers",),
    "radius": (),
    "friction": (),
}


@dataclass(frozen=True)
class PushLibrary:
    """Outcomes of straight pushes of one slider, in its body frame.

    Attributes:
        starts: Configurations of the hand where each push starts, (pushes, dof), body frame.
        directions: Unit vectors along which the hand moves, (pushes, 2), body frame.
        travel: Distances of the hand from its start, (lengths,), m.
        outcomes: Poses of the slider after each push, relative to its pose before, (samples, pushes, lengths, 3). There
            is one sample if friction is known.
        valid: Whether the push moves the slider and nothing failed or jammed in any sample, (pushes, lengths).
        length: Characteristic length of the slider's limit surface, m.
        center: Centroid of the slider, (2,), body frame, m.
        slider: Numbers of the slider, its outline and its limit surface, (numbers,).
        radius: Radius of the hand's first finger, m.
        friction: Coefficient of contact friction; the mean one if it is random.
        digest: Hash of everything that the outcomes depend on.
    """

    starts: np.ndarray
    directions: np.ndarray
    travel: np.ndarray
    outcomes: np.ndarray
    valid: np.ndarray
    length: float
    center: np.ndarray
    slider: np.ndarray
    radius: float
    friction: float
    digest: str

    @staticmethod
    def build(
        slider: Slider,
        radius: float,
        *,
        friction: float = 0.0,
        contacts: int = 240,
        angles: int = 9,
        max_angle: float = np.pi / 3,
        model: FrictionModel | None = None,
        samples: int = 1,
        key: PRNGKeyArray | None = None,
    ) -> "PushLibrary":
        """Simulate the pushes of a round finger from all around the slider.

        Args:
            slider: The slider.
            radius: Radius of the finger, m.
            friction: Coefficient of contact friction.
            contacts: Number of places around the slider, at equal spacing.
            angles: Number of directions at each place.
            max_angle: Largest angle between a direction and the inward normal, rad.
            model: Distribution of friction. If it is given, `friction` is not used.
            samples: Number of draws from `model`. All pushes share them, so that differences between pushes are not
                due to the draws.
            key: Key of the draws, which are those of `draw_friction`.

        Returns:
            The library.

        Raises:
            ValueError: If a number is out of its range, or if `model` is given without `key`.
        """
        starts, directions = fan(slider, radius, contacts, angles, max_angle)
        hand = Hand.finger(radius)
        return PushLibrary.simulate(
            slider, hand, starts, directions, friction=friction, model=model, samples=samples, key=key
        )

    @staticmethod
    def simulate(
        slider: Slider,
        hand: Hand,
        starts: np.ndarray,
        directions: np.ndarray,
        *,
        friction: float = 0.0,
        model: FrictionModel | None = None,
        samples: int = 1,
        key: PRNGKeyArray | None = None,
    ) -> "PushLibrary":
        """Simulate given straight pushes of any hand.

        Args:
            slider: The slider.
            hand: The hand. The first two numbers of its configuration are a position, which moves; the others rest.
            starts: Configurations of the hand at the start, (pushes, dof), in the body frame of the slider.
            directions: Unit vectors of the motion, (pushes, 2), body frame.
            friction: Coefficient of contact friction.
            model: Distribution of friction, as in `build`.
            samples: Number of draws from `model`.
            key: Key of the draws.

        Returns:
            The library.

        Raises:
            ValueError: If `samples` is less than one, or if `model` is given without `key`.
            TypeError: If `slider` is not a `Slider`.
        """
        check_type("slider", slider, Slider)
        check_count("samples", samples)
        length = float(slider.surface.length)
        steps = round(TRAVEL / STEP)
        travel = length * STEP * np.arange(steps + 1)
        pushes = len(starts)
        paths = np.repeat(np.asarray(starts, np.float64)[:, None], steps + 1, axis=1)
        paths[..., :2] += travel[:, None] * directions[:, None]
        if model is None:
            surfaces, mus, mean = [slider.surface], [friction], friction
        else:
            if key is None:
                raise ValueError("key: draws from a FrictionModel need a PRNG key; got None")
            draws = draw_friction(key, slider.surface, model, samples)
            surfaces = [jax.tree.map(lambda leaf, k=k: leaf[k, 0], draws.surface) for k in range(samples)]
            mus, mean = np.asarray(draws.friction[:, 0]).tolist(), np.mean(np.asarray(model.friction))
        outcomes, valid = [], np.ones((pushes, steps + 1), bool)
        for surface, mu in zip(surfaces, mus, strict=True):
            poses, valid_steps = simulate_pushes(Slider(slider.shape, surface), hand, paths, np.zeros((pushes, 3)), mu)
            moved = np.linalg.norm(poses * np.array([1, 1, length]), axis=-1)
            valid &= (np.arange(steps + 1) <= valid_steps[:, None]) & (moved > LEAST_MOTION * length)
            outcomes.append(poses)
        return PushLibrary(
            starts=np.asarray(starts, np.float64),
            directions=np.asarray(directions, np.float64),
            travel=travel,
            outcomes=np.stack(outcomes).astype(np.float32),
            valid=valid,
            length=length,
            center=np.asarray(slider.shape.centroid, np.float64),
            slider=_numbers(slider),
            radius=float(hand.radius[0]),
            friction=float(mean),
            digest=digest(slider, hand, starts, directions, friction, model, samples, key),
        )

    def save(self, path: str | Path) -> None:
        """Write the library to a file in NumPy's format "npz"."""
        save_arrays(path, FORMAT, {name: getattr(self, name) for name in self.__dataclass_fields__})

    @staticmethod
    def load(path: str | Path, digest: str | None = None) -> "PushLibrary":
        """Read a library that `save` wrote.

        Args:
            path: The file.
            digest: Digest that the library must have, from `push_library.digest`. None: any.

        Raises:
            ValueError: If the file holds no library, or one of another slider, hand or set of pushes.
        """
        content = "a library of pushes"
        fields: dict[str, Any] = load_arrays(path, content, FORMAT, PushLibrary.__dataclass_fields__)
        check_arrays(path, content, fields, SHAPES)
        fields |= {name: float(fields[name]) for name in ("length", "radius", "friction")}
        library = PushLibrary(**fields | {"valid": fields["valid"].astype(bool), "digest": str(fields["digest"])})
        if digest is not None and library.digest != digest:
            raise ValueError(
                f"{path} holds a library of another slider, hand, friction or set of pushes; build it again "
                f"(its digest is {library.digest[:12]}, expected {digest[:12]})"
            )
        return library

    def check_made_for(self, slider: Slider, radius: float) -> None:
        """Raise ValueError if this is the library of another slider or finger."""
        numbers = _numbers(slider)
        if numbers.shape != self.slider.shape or not np.allclose(numbers, self.slider, rtol=1e-5, atol=1e-7):
            raise ValueError("library was made for another slider: its outline or limit surface differ from `slider`'s")
        if not np.isclose(radius, self.radius, rtol=1e-5):
            raise ValueError(f"library was made for a finger with a radius of {self.radius:.6g} m; got {radius!r}")

    @cached_property
    def entries(self) -> np.ndarray:
        """Valid outcomes as rows of the indices (push, length), (entries, 2)."""
        return np.argwhere(self.valid)

    @cached_property
    def relative(self) -> np.ndarray:
        """Relative poses of the entries in the first sample, (entries, 3); after `averaged`, that is their means."""
        return self.outcomes[0].reshape(-1, 3)[self.valid.ravel()]

    @cached_property
    def tree(self) -> KDTree:
        """The k-d tree of the features of `relative`."""
        return KDTree(self.features(self.relative), balanced_tree=False, compact_nodes=False)

    def features(self, poses: np.ndarray) -> np.ndarray:
        """Return `pose_features` about this slider's centroid, (..., 4)."""
        return pose_features(poses, self.center, self.length)

    def averaged(self, weight: np.ndarray | None = None) -> "PushLibrary":
        """Return the library whose only sample is the mean outcome of each push.

        Args:
            weight: Weights of the samples, (samples,), which add up to one. None: all alike.
        """
        if len(self.outcomes) == 1:
            return self
        mean = np.tensordot(self._weights(weight), self.outcomes, 1)
        return replace(self, outcomes=mean[None])

    def _weights(self, weight: np.ndarray | None) -> np.ndarray:
        count = len(self.outcomes)
        weights = np.full(count, 1 / count, np.float32) if weight is None else np.asarray(weight, np.float32)
        if weights.shape != (count,):
            raise ValueError(f"weight has shape {weights.shape}; expected ({count},), the samples of the library")
        return weights

    def nearest(self, relative: np.ndarray, count: int, max_distance: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the entries whose outcomes are nearest to relative poses.

        Args:
            relative: Relative poses, (poses, 3).
            count: Number of entries for each.
            max_distance: Largest distance, m.

        Returns:
            Distances (poses, count), m, and indices into `entries`, (poses, count). Where fewer are near enough, the
            rest has infinite distance, and the number of all entries as index.
        """
        wanted = np.arange(1, count + 1)
        distance, index = self.tree.query(
            self.features(relative),
            k=wanted,  # pyright: ignore[reportArgumentType]  # an array keeps the axis also for one
            distance_upper_bound=max_distance,
        )
        return np.asarray(distance), np.asarray(index)


def pose_features(poses: np.ndarray, center: np.ndarray, length: float) -> np.ndarray:
    """Return four features of poses (..., 3) whose Euclidean distance is a distance of poses, (..., 4), m."""
    # They are the position of `center`, (2,), body frame, and `length`, m, times cosine and sine of the angle. So
    # angles that differ by a full turn are the same, and for small differences the distance is sqrt(dx^2 + dy^2 +
    # (length dtheta)^2).
    theta = poses[..., 2]
    center_position = to_world(poses, np.asarray(center, poses.dtype))
    return np.concatenate(
        [center_position, np.stack([length * np.cos(theta), length * np.sin(theta)], axis=-1).astype(poses.dtype)],
        axis=-1,
    )


def fan(
    slider: Slider,
    radius: float,  # of the finger, m
    contacts: int = 240,  # places around the slider at equal spacing; in reflex corners some are left out
    angles: int = 9,  # directions at each place
    max_angle: float = np.pi / 3,  # between a direction and the inward normal, rad
) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and directions of straight pushes of a round finger all around a slider, (pushes, 2) each."""
    # The starts are centers of the finger, m, a small gap away from the slider; the directions are unit vectors.
    check_count("contacts", contacts)
    check_count("angles", angles)
    if not radius >= 0:
        raise ValueError(f"radius must not be negative; got {radius!r}")
    if not 0 <= max_angle < np.pi / 2:
        raise ValueError(f"max_angle must be at least 0 and less than pi / 2; got {max_angle!r}")
    gap = GAP * float(slider.surface.length)
    curve = offset_curve(outline_vertices(slider.shape), radius + gap, contacts)
    angle = np.linspace(-max_angle, max_angle, angles) if angles > 1 else np.zeros(1)
    (x, y), c, s = curve.normals.T[..., None], np.cos(angle), np.sin(angle)
    directions = np.stack([c * x - s * y, s * x + c * y], axis=-1).reshape(-1, 2)
    return np.repeat(curve.points, angles, axis=0), directions


def _numbers(slider: Slider) -> np.ndarray:
    """Return all leaves of a slider as one vector, (numbers,)."""
    return np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in jax.tree.leaves(slider)])


def digest(slider, hand, starts, directions, friction=0.0, model=None, samples=1, key=None) -> str:
    """Return the hash of what the outcomes of `PushLibrary.simulate` depend on; the arguments are the same."""
    parts = (slider, hand, model, np.asarray(starts), np.asarray(directions), np.asarray(friction))
    # types and static fields, without the addresses of functions, which differ from process to process
    structure = re.sub("0x[0-9a-f]+", "", str(jax.tree.structure(parts)))
    content = hashlib.sha256(
        f"{pushjax.__version__} {FORMAT} {GAP} {LEAST_MOTION} {STEP} {TRAVEL} {samples} {structure}".encode()
    )
    for leaf in jax.tree.leaves(parts):
        content.update(np.round(np.asarray(leaf, np.float64), 9).tobytes())
    if key is not None:
        content.update(np.asarray(jax.random.key_data(key)).tobytes())
    return content.hexdigest()
