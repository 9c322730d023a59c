"""Outcomes of straight pushes in the body frame of a slider.

Quasi-static motion depends neither on time nor on where the slider is. So the outcome of a push that is given in the
body frame is one relative pose, and pushes that follow each other compose: if push a moves the slider by A and push b
by B, a and then b move it from pose q to compose(compose(q, A), B).

A slider at pose q is brought to the goal g by one push if the push's outcome is the relative pose compose(inverse(q),
g). So one k-d tree of all outcomes answers from which poses one push reaches any goal, and all plans of two pushes are
one query with the poses that first pushes lead to. The distance in the tree, that of `PushLibrary.features`, is not
changed by a motion of the world, so it is the distance of the final pose from the goal.
"""

import hashlib
import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import jax
import numpy as np
from jaxtyping import PRNGKeyArray
from scipy.spatial import KDTree

import pushjax
from pushjax._internal.checks import check_count
from pushjax.geometry.polygon_numpy import offset_curve, outline_vertices
from pushjax.geometry.se2_numpy import to_world
from pushjax.planning.push_batch import simulate_pushes
from pushjax.planning.scene import PushScene, draw_friction, mean_friction
from pushjax.simulation.slider import Slider

# Lengths in units of the surface's length, which is about the slider's radius.
GAP = 0.04  # between finger and slider where a push starts
STEP = 0.0275  # of the simulation, and between neighboring lengths of a push
TRAVEL = 2.3  # longest push
LEAST_MOTION = 0.005  # a push that moves the slider less than this is not valid

FORMAT = 3  # of the file, and of what is computed here: raise it when either changes


@dataclass(frozen=True)
class PushLibrary:
    """Outcomes of straight pushes of one slider, in its body frame.

    Attributes:
        starts: Centers of the finger where each push starts, (pushes, 2), body frame, m.
        directions: Unit vectors along which the finger moves, (pushes, 2), body frame.
        travel: Distances of the finger from its start, (lengths,), m.
        outcomes: Poses of the slider after each push, relative to its pose before, (samples, pushes, lengths, 3). There
            is one sample if friction is known.
        valid: Whether the push moves the slider and nothing failed or jammed in any sample, (pushes, lengths).
        length: Characteristic length of the slider's limit surface, m.
        center: Centroid of the slider, (2,), body frame, m.
        slider: Numbers of the slider, its outline and its limit surface, (numbers,).
        radius: Radius of the finger, (1,), m.
        friction: Numbers of the `pj.FrictionModel`, (numbers,).
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
    radius: np.ndarray
    friction: np.ndarray
    digest: str

    @staticmethod
    def build(
        scene: PushScene,
        *,
        contacts: int = 240,
        angles: int = 9,
        max_angle: float = np.pi / 3,
        samples: int = 1,
        key: PRNGKeyArray | None = None,
        cache: Path | None = None,
    ) -> "PushLibrary":
        """Simulate the pushes of a round finger from all around the slider.

        Args:
            scene: Slider, finger and friction; its fixtures do not matter.
            contacts: Number of places around the slider, at equal spacing.
            angles: Number of directions at each place.
            max_angle: Largest angle between a direction and the inward normal, rad.
            samples: Number of draws of random friction. All pushes share them, so that differences between pushes are
                not due to the draws.
            key: Key of the draws, which are those of `FrictionFilter.init`.
            cache: Folder in which the library is kept. The pushes are simulated only if it is not there.

        Returns:
            The library.

        Raises:
            ValueError: If a number is out of its range, the hand is not one round finger, `key` is missing for random
                friction, or there are several samples of friction that is known.
        """
        check_count("samples", samples)
        starts, directions = fan(scene, contacts, angles, max_angle)
        if scene.is_known and samples > 1:
            raise ValueError(f"samples must be 1, because the scene's friction is known; got {samples}")
        if not scene.is_known and key is None:
            raise ValueError("key: draws of random friction need a PRNG key; got None")
        wanted = digest(scene, starts, directions, samples, key)
        if cache is None:
            return _simulated(scene, starts, directions, samples, key, wanted)
        path = cache / f"pushes-{wanted[:16]}.npz"
        with suppress(FileNotFoundError, ValueError):  # there is none, or it is damaged
            found = PushLibrary.load(path)
            if found.digest == wanted:
                return found
        built = _simulated(scene, starts, directions, samples, key, wanted)
        cache.mkdir(parents=True, exist_ok=True)
        built.save(path)
        return built

    def save(self, path: str | Path) -> None:
        """Write the library to a file in NumPy's format "npz", as a whole or not at all."""
        target = Path(path).expanduser()
        partial = target.with_name(f".{target.name}-{os.getpid()}")
        try:
            with partial.open("wb") as file:
                np.savez_compressed(
                    file, format_version=FORMAT, **{name: getattr(self, name) for name in self.__dataclass_fields__}
                )
            os.replace(partial, target)
        finally:
            partial.unlink(missing_ok=True)

    @staticmethod
    def load(path: str | Path) -> "PushLibrary":
        """Read a library that `save` wrote.

        Raises:
            ValueError: If the file holds no library, or one in another format.
        """
        try:
            with np.load(Path(path).expanduser()) as file:
                if (written := file["format_version"]) != FORMAT:
                    raise ValueError(f"its format is {written}; this program reads {FORMAT}")
                found: dict[str, Any] = {name: file[name] for name in PushLibrary.__dataclass_fields__}
        except FileNotFoundError:
            raise
        except (KeyError, ValueError, TypeError, EOFError, OSError, BadZipFile) as error:
            raise ValueError(f"{path} does not hold a library of pushes: {error}") from error
        return PushLibrary(**found | {"length": float(found["length"]), "digest": str(found["digest"])})

    def check_made_for(self, scene: PushScene) -> None:
        """Check that slider, finger and friction are those of a scene.

        Args:
            scene: The scene; its fixtures do not matter.

        Raises:
            ValueError: If one of them is another.
        """
        for name, given in _numbers(scene).items():
            expected = getattr(self, name)
            if given.shape != expected.shape or not np.allclose(given, expected, rtol=1e-5, atol=1e-7):
                numbers = ", ".join(f"{number:.4g}" for number in given)
                wanted = ", ".join(f"{number:.4g}" for number in expected)
                raise ValueError(f"library was made for another {name} than the scene's, {numbers}; expected {wanted}")

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
        """Return four features of poses (..., 3) whose Euclidean distance is a distance of poses, (..., 4), m."""
        # They are the position of the centroid, and `length` times cosine and sine of the angle. So angles that differ
        # by a full turn are the same, and for small differences the distance is sqrt(dx^2 + dy^2 + (length dtheta)^2).
        center, theta = to_world(poses, self.center.astype(poses.dtype)), poses[..., 2]
        direction = self.length * np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        return np.concatenate([center, direction.astype(poses.dtype)], axis=-1)

    def averaged(self, weight: np.ndarray | None = None) -> "PushLibrary":
        """Return the library whose only sample is the mean outcome of each push.

        Args:
            weight: Weights of the samples, (samples,), which add up to one. None: all alike.
        """
        if (count := len(self.outcomes)) == 1:
            return self
        weights = np.full(count, 1 / count, np.float32) if weight is None else np.asarray(weight, np.float32)
        if weights.shape != (count,):
            raise ValueError(f"weight has shape {weights.shape}; expected ({count},), the samples of the library")
        return replace(self, outcomes=np.tensordot(weights, self.outcomes, 1)[None])

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


def fan(
    scene: PushScene,
    contacts: int = 240,  # places around the slider at equal spacing; in reflex corners some are left out
    angles: int = 9,  # directions at each place
    max_angle: float = np.pi / 3,  # between a direction and the inward normal, rad
) -> tuple[np.ndarray, np.ndarray]:
    """Return starts and directions of straight pushes of a round finger all around a slider, (pushes, 2) each."""
    # The starts are centers of the finger, m, a small gap away from the slider; the directions are unit vectors.
    check_count("contacts", contacts)
    check_count("angles", angles)
    if not 0 <= max_angle < np.pi / 2:
        raise ValueError(f"max_angle must be at least 0 and less than pi / 2; got {max_angle!r}")
    distance = scene.radius + GAP * scene.length
    curve = offset_curve(outline_vertices(scene.one_slider.shape), distance, contacts)
    angle = np.linspace(-max_angle, max_angle, angles) if angles > 1 else np.zeros(1)
    (x, y), c, s = curve.normals.T[..., None], np.cos(angle), np.sin(angle)
    directions = np.stack([c * x - s * y, s * x + c * y], axis=-1).reshape(-1, 2)
    return np.repeat(curve.points, angles, axis=0), directions


def _simulated(
    scene: PushScene,
    starts: np.ndarray,  # (pushes, 2), centers of the finger, body frame, m
    directions: np.ndarray,  # (pushes, 2), unit vectors, body frame
    samples: int,  # of friction
    key: PRNGKeyArray | None,  # of the samples
    name: str,  # digest of all this
) -> PushLibrary:
    """Simulate straight pushes."""
    slider, length = scene.one_slider, scene.length
    steps = round(TRAVEL / STEP)
    travel = length * STEP * np.arange(steps + 1)
    paths = starts[:, None] + travel[:, None] * directions[:, None]
    given = slider.surface, scene.friction
    draws = mean_friction(*given) if key is None else draw_friction(key, *given, samples)
    outcomes, valid, start = [], np.ones((len(starts), steps + 1), bool), np.zeros((len(starts), 3))
    for k in range(samples):
        surface, mu = jax.tree.map(lambda leaf, k=k: np.asarray(leaf)[k, 0], (draws.surface, draws.friction))
        poses, valid_steps = simulate_pushes(Slider(slider.shape, surface), scene.hand, paths, start, mu)
        moved = np.linalg.norm(poses * np.array([1, 1, length]), axis=-1)
        valid &= (np.arange(steps + 1) <= valid_steps[:, None]) & (moved > LEAST_MOTION * length)
        outcomes.append(poses)
    return PushLibrary(
        starts=starts,
        directions=directions,
        travel=travel,
        outcomes=np.stack(outcomes).astype(np.float32),
        valid=valid,
        length=length,
        center=np.asarray(slider.shape.centroid, np.float64),
        digest=name,
        **_numbers(scene),
    )


def _numbers(scene: PushScene) -> dict[str, np.ndarray]:
    """Return the numbers of slider, finger and friction, (numbers,) each."""
    parts = {"slider": scene.slider, "radius": scene.radius, "friction": scene.friction}
    return {
        name: np.concatenate([np.asarray(leaf, np.float64).ravel() for leaf in jax.tree.leaves(part)])
        for name, part in parts.items()
    }


def digest(scene: PushScene, starts: np.ndarray, directions: np.ndarray, samples: int, key: Any) -> str:
    """Return the hash of everything that the outcomes of pushes depend on."""
    parts = (scene.slider, scene.hand, scene.friction, starts, directions)
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
