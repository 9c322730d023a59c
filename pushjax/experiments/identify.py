"""Identify friction, limit surface and calibration from logs of pushes, with intervals, and write a report.

Pushes and logs that cannot be learned from are left out, counted and named. Several logs are pushes of one object under
one friction, unless they are `separate`. Then each log has its own friction and surface, and all logs share the
calibration of the setup.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro

import pushjax as pj
from pushjax._internal.progress import ProgressCallback, no_progress
from pushjax.datasets import LogError, Recordings, load_recordings
from pushjax.experiments._cli_option import cli_option
from pushjax.experiments._identify_report import Findings, figures, parameters, predictions, warning
from pushjax.experiments._identify_report import summary as summary
from pushjax.experiments._record import result_record
from pushjax.experiments._report import saved
from pushjax.experiments._slider_options import SHAPES, fitted_surface, parse_numbers, parse_shape, parse_support
from pushjax.identification.noise import Noise, identify_noise
from pushjax.identification.pushes import Pushes
from pushjax.identification.pushes_of_recordings import has_wrenches, observed_often_enough, screen
from pushjax.identification.uncertainty import Profile, scalar_positions
from pushjax.identification.unknowns import LENGTHS

MIN_PUSHES = 3  # pushes; from fewer the size of their errors cannot be told
LEVEL = 0.9
HANDS = "finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (width and thickness of a pad)"
Meters = Annotated[float | None, cli_option("M")]


@dataclass
class Options:
    """What is known and what is to be found, as options of the command line."""

    shape: Annotated[str | None, cli_option("SHAPE")] = None
    """The object: rectangle:0.1x0.05, disk:0.05 (radius), ellipse:0.06x0.04 (semi-axes), regular:6x0.05 (corners,
    distance of each), all in m, or a CSV file of vertices. Default: what the logs tell."""
    hand: str = "finger"
    """finger, two_fingers, three_fingers, or parallel_jaw:0.05x0.01 (m, a pad's width and thickness)."""
    radius: Meters = None
    """Radius of the fingers, m. Default: what the logs tell."""
    support: Annotated[str | None, cli_option("SUPPORT")] = None
    """Pressure distribution under the object, which gives the prior of the limit surface: uniform, rim, or
    points:x,y;x,y;x,y (m). Default: what the logs tell, else uniform."""
    surface: Literal["quartic", "ellipsoid"] = "quartic"
    """Kind of limit surface."""
    surface_dof: float = 50.0
    """How well the limit surface is known beforehand: degrees of freedom of its prior; fewer, less well."""
    friction: tuple[float, float] = (0.0, 1.0)
    """Lowest and highest friction coefficient of the fingers."""
    pressure_center: Meters = None
    """Estimate the center of pressure too; the value is the standard deviation of its prior, m. Likewise for the next
    five options."""
    inset: Meters = None
    """Estimate by how much the outline is smaller."""
    overshoot: Meters = None
    """Estimate how far the hand went on after the end of its path."""
    lag_distance: Meters = None
    """Estimate the distance by which the hand was behind its path."""
    hand_offset: Meters = None
    """Estimate the displacement of the hand from its path."""
    frame_offset: Meters = None
    """Estimate the pose of the object's frame in the tracked frame; its angle times the length of the surface."""
    contact_at_end: bool = False
    """The finger touches the object at the end of most pushes: use the gap that was measured there."""
    separate: bool = False
    """Each log has its own friction and surface; all logs share the calibration."""
    steps: int = 40
    """Number of steps of each push."""
    parts: int = 1
    """Number of equally spaced poses per push to fit, if the object was tracked during the push (1: only the final
    pose)."""
    forces: bool = False
    """Use measured forces too; needs parts."""
    noise: bool = False
    """Also estimate how much pushes scatter."""


def run(
    logs: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="LOG …", help_behavior_hint=""), tyro.conf.Positional],
    options: Options,
    seed: int = 0,
    out: Path | None = None,
    progress: ProgressCallback = no_progress,
    say: Callable[[str], None] = lambda words: None,
    note: Callable[[str], None] = lambda words: None,
) -> dict[str, Any]:
    """Identify from logs, and draw and save the result.

    Args:
        logs: Files of recorded pushes: CSV with the columns push, hand_x, hand_y, object_x, object_y, object_theta (SI
            units, world frame; blank where the object was not seen), NPZ with start, path, end, MIT pushing data (JSON,
            HDF5), or triangle logs (text).
        options: What is known, and what is to be found.
        seed: Seed of the wrench-twist pairs of the expected surfaces, and of the noise.
        out: Folder for the pictures and `identified.json`. None: neither.
        progress: Called with the number of parts done and their total.
        say: Called with a description of what is done next.
        note: Called with the problem of each push or log that is left out, before the fit begins.

    Returns:
        The record: one row per number that is no part of the surface, how well the pushes are predicted, the noise if
        asked for, a warning or None, and the problems of what was left out.

    Raises:
        LogError: If no log, or no push of any log, can be used.
        ValueError: If the options do not fit together or to the logs, or there are too few pushes.
    """
    findings = find(logs, options, seed, progress, say, note)
    found = findings.found
    pictures = saved(out, lambda: figures(findings))
    if out is not None:
        found.save(out / "identified.json")
    chosen = {name: value for name, value in vars(options).items() if value is not None}
    predicted = predictions(findings)
    return result_record(
        "identify",
        {"seed": seed, "logs": [str(log) for log in logs], "level": LEVEL} | chosen,
        rows=parameters(findings, LEVEL),
        sigma_mm=1e3 * float(found.sigma),
        direction_sigma=float(found.direction_sigma),
        converged=bool(found.converged),
        steps=int(found.steps),
        poses=len(findings.pushes.observed_steps),
        wrenches=int(np.sum(np.asarray(findings.pushes.has_pair))),
        **predicted,
        warning=warning(predicted),
        noise=None if findings.noise is None else _noise(findings.noise),
        problems=[str(problem) for problem in findings.problems],
        identified=None if out is None else str(out / "identified.json"),
        pictures=pictures,
    )


def find(
    logs: Sequence[Path],
    options: Options,
    seed: int,
    progress: ProgressCallback,
    say: Callable[[str], None],
    note: Callable[[str], None],
) -> Findings:
    """Identify from logs, with intervals, predictions and noise; logs that cannot be used become problems."""
    if not any(log.exists() for log in logs):
        missing = ", ".join(map(str, logs)) or "file"
        raise ValueError(f"LOG: give at least one file of recorded pushes; there is no {missing}")
    if options.forces and options.parts < 2:
        raise ValueError(f"--forces needs --parts of at least 2, each of which gives a wrench; got {options.parts}")
    say(f"reading {len(logs)} {'log' if len(logs) == 1 else 'logs'}")
    recordings, unreadable = _for_each(logs, load_recordings)
    shape = shape_of(options.shape, recordings)
    hand = hand_of(options.hand, options.radius, recordings)
    for one in recordings:
        columns = one.pushes[0].hand.shape[1]
        if columns != hand.dof:
            raise ValueError(f"{one.source}: the hand has {columns} numbers; a hand {options.hand} has {hand.dof}")
        if options.forces and not has_wrenches(one):
            raise ValueError(f"--forces: {one.source} does not have the forces of a single finger for every push")
    recordings, unusable = _for_each(recordings, lambda one: screen(one, shape, hand, options.parts))
    problems = (*unreadable, *unusable, *(problem for one in recordings for problem in one.problems))
    for problem in problems:
        note(f"left out: {problem}")
    count = sum(len(one.pushes) for one in recordings)
    if count < MIN_PUSHES:
        why = f"; the first problem: {problems[0]}" if problems else ""
        raise ValueError(f"expected at least {MIN_PUSHES} usable pushes; found {count} in {len(logs)} logs{why}")
    pushes, slider = conditions(recordings, shape, options, seed)
    asked = {name: getattr(options, name) for name in ("surface_dof", *LENGTHS)}
    unknowns = pj.Unknowns(options.friction, **asked)
    say(f"fitting to {count} pushes (the first time this compiles, for up to a minute)")
    found = pj.identify(pushes, slider, hand, unknowns, contact_at_end=options.contact_at_end)
    labels = list(scalar_positions(found))
    total = len(labels) + 1
    progress(1, total)
    profiles: list[Profile] = []
    for label in labels:
        say(f"interval of {label}")
        profiles.append(found.profile(pushes, slider, hand, label))
        progress(1 + len(profiles), total)
    noise = None
    if options.noise:
        say("fitting how much friction scatters")
        # Residuals of pushes that were learned from are too small. So the noise is fitted to every second push, about
        # what is identified from the others.
        is_odd = jnp.broadcast_to(jnp.arange(pushes.weight.shape[-1]) % 2, pushes.weight.shape)
        even = pushes.weighted(pushes.weight * (1 - is_odd))
        found_from_even = pj.identify(even, slider, hand, unknowns, contact_at_end=options.contact_at_end)
        odd = pushes.weighted(pushes.weight * is_odd)
        noise = identify_noise(jax.random.key(seed), found_from_even, odd, slider, hand, progress=progress)
    lengths = [one.length for one in recordings if one.length is not None]
    length = lengths[0] if lengths else float(found.length)
    say("predicting the pushes again")
    predicted = found.predict(pushes, slider, hand)
    return Findings(problems, slider, hand, pushes, found, predicted, tuple(profiles), noise, length)


def _for_each(items: Sequence, function: Callable[[Any], Recordings]) -> tuple[list[Recordings], list[LogError]]:
    """Apply a function to each item, and return the results and the errors; raise if it fails for all."""
    good, bad = [], []
    for item in items:
        try:
            good.append(function(item))
        except LogError as error:
            bad.append(error)
    if not good:
        raise bad[0]
    return good, bad


def conditions(recordings: list[Recordings], shape, options: Options, seed: int) -> tuple[pj.Pushes, pj.Slider]:
    """Convert the logs to one condition each (`options.separate`) or else to a single one for all."""
    # Poses during the push and forces are used only if every log has them, because the logs become one array.
    parts = options.parts if all(observed_often_enough(one, options.parts) for one in recordings) else 1
    forces = options.forces and all(has_wrenches(one) for one in recordings)
    each = [Pushes.of(one, options.steps, parts=parts, shape=shape if forces else None) for one in recordings]

    supports = [support_of(options.support, shape, one) for one in recordings]
    if options.separate and len(each) > 1:
        surfaces = [fitted_surface(support, options.surface, seed) for support in supports]
        several = jax.tree.map(lambda *leaves: jnp.stack(leaves), *surfaces)
        return pj.Pushes.conditions(each), pj.Slider(shape, several)
    first, *others = map(jax.tree.leaves, supports)
    for one, leaves in zip(recordings[1:], others, strict=True):
        if not all(map(np.array_equal, first, leaves)):
            raise ValueError(
                f"{recordings[0].source} and {one.source} have different supports, so different limit surfaces are "
                "expected: give --separate, or --support for all"
            )
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *each)
    return whole, pj.Slider(shape, fitted_surface(supports[0], options.surface, seed))


def shape_of(text: str | None, recordings: list[Recordings]) -> pj.Polygon | pj.Disk | pj.Ellipse:
    """Return the outline of the object, m, from the option or else from the logs."""
    if text is not None:
        return parse_shape(text)
    known = [one.vertices for one in recordings if one.vertices is not None]
    if len(known) < len(recordings):
        raise ValueError(f"--shape: the logs do not tell the object's outline; give one of {SHAPES}")
    if any(v.shape != known[0].shape or not np.allclose(v, known[0]) for v in known):
        raise ValueError("the logs are of objects with different outlines: identify them one by one")
    return pj.Polygon(known[0])


def hand_of(text: str, radius: float | None, recordings: list[Recordings]) -> pj.Hand:
    """Return the hand; fingers have the given radius, m, or else that of the logs."""
    kind, _, rest = text.partition(":")
    if kind == "parallel_jaw":
        return pj.Hand.parallel_jaw(*parse_numbers("--hand", text, rest, "x", 2, HANDS))
    if kind not in ("finger", "two_fingers", "three_fingers") or rest:
        raise ValueError(f"--hand: expected {HANDS}; got {text!r}")
    if radius is None:
        known = {one.tip_radius for one in recordings}
        if len(known) > 1 or known == {None}:
            raise ValueError("--radius: the logs do not tell the finger's radius; give it in m")
        radius = known.pop()
    return getattr(pj.Hand, kind)(radius)


def support_of(text: str | None, shape: pj.Shape, recordings: Recordings) -> pj.Support:
    """Return the support with unit load: the option's, or else the log's points, or else uniform pressure."""
    if text is None and recordings.support_points is not None and len(recordings.support_points):
        return pj.Support.tripod(recordings.support_points)
    return parse_support(text or "uniform", shape)


def _noise(noise: Noise) -> dict[str, Any]:
    """Return the noise as numbers for the record, lengths in mm."""
    return {
        "surface_dof": float(noise.surface_dof),
        "friction": np.asarray(noise.friction),
        "hand_offset_mm": 1e3 * float(noise.hand_offset),
        "sigma_mm": 1e3 * float(noise.sigma),
        "relative_error": np.asarray(noise.relative_error),
        "student_dof": float(noise.student_dof),
        "score_mm": 1e3 * float(noise.score),
    }
