"""From logs of pushes to friction, limit surface and calibration, with intervals, and a report.

What cannot be learned from is left out, counted and named. Several logs are pushes of one object under one friction,
unless they are `separate`: then each has its own, and they share how the set-up is off.
"""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import pushjax as pj
from pushjax.datasets import LogError, Recordings, load_recordings
from pushjax.experiments.identify_logs import setting
from pushjax.experiments.identify_logs.findings import Findings, parameters, predictions
from pushjax.experiments.identify_logs.setting import Options
from pushjax.identify.noise import Noise, identify_noise
from pushjax.identify.recorded import paired, recorded, seen_after
from pushjax.identify.screening import screened
from pushjax.identify.uncertainty import Profile, profile, scalars
from pushjax.report import envelope

FEWEST = 3  # pushes: fewer tell nothing about how far off they are
LEVEL = 0.9
# Of how far the objects moved, and of what was expected before, that deviations may be before one is warned.
POOR, NO_BETTER = 0.4, 0.9


def run(
    logs: list[Path],
    options: Options,
    seed: int = 0,
    out: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
    say: Callable[[str], None] = lambda words: None,
) -> dict[str, Any]:
    """say: told what is done next.

    Raises LogError for a log that cannot be used, ValueError for options that do not fit."""
    findings = find(logs, options, seed, progress, say)
    found = findings.found
    pictures, saved = [], None
    if out is not None:
        from pushjax.experiments.identify_logs.picture import draw

        pictures = draw(findings, out)
        saved = out / "identified.json"
        found.save(saved)
    chosen = {field.name: getattr(options, field.name) for field in fields(Options)}
    own = {name: value for name, value in chosen.items() if value is not None}
    noise = None if findings.noise is None else _noise(findings.noise)
    predicted = predictions(findings)
    return envelope(
        "identify",
        {"seed": seed, "logs": [str(log) for log in logs], "level": LEVEL} | own,
        rows=parameters(findings, LEVEL),
        sigma_mm=1e3 * float(found.sigma),
        direction=float(found.direction),
        converged=int(found.status) == pj.Status.MOVING,
        steps=int(found.steps),
        poses=len(findings.pushes.rows),
        wrenches=int(np.sum(np.asarray(findings.pushes.paired))),
        **predicted,
        warning=_warning(predicted),
        noise=noise,
        problems=[str(problem) for problem in findings.problems],
        identified=None if saved is None else str(saved),
        pictures=pictures,
    )


def find(
    logs: list[Path],
    options: Options,
    seed: int,
    progress: Callable[[int, int], None],
    say: Callable[[str], None],
) -> Findings:
    if not logs:
        raise ValueError("PATH: expected at least one file of recorded pushes; got none")
    recordings, useless = _each(logs, load_recordings)
    shape = setting.shape_of(options.shape, recordings)
    hand = setting.hand_of(options.hand, options.radius, recordings)
    for one in recordings:
        columns = one.pushes[0].hand.shape[1]
        if columns != hand.dof:
            raise ValueError(f"{one.source}: the hand has {columns} numbers; a hand {options.hand} has {hand.dof}")
    _check_forces(recordings, options)
    recordings, no_better = _each(recordings, lambda one: screened(one, shape, hand))
    problems = (*useless, *no_better, *(problem for one in recordings for problem in one.problems))
    count = sum(len(one.pushes) for one in recordings)
    if count < FEWEST:
        why = f"; the first problem: {problems[0]}" if problems else ""
        raise ValueError(f"expected at least {FEWEST} usable pushes; found {count} in {len(logs)} logs{why}")
    pushes, slider = conditions(recordings, shape, options, seed)
    unknowns = pj.Unknowns(
        options.friction,
        dof=options.dof,
        center=options.center,
        inset=options.inset,
        end=options.end,
        lag=options.lag,
        offset=options.offset,
        marker=options.marker,
    )
    touching = options.touching
    say(f"fitting to {count} pushes (the first time this compiles, for up to a minute)")
    found = pj.identify(pushes, slider, hand, unknowns, touching=touching)
    labels = list(scalars(found))
    total = len(labels) + 1
    progress(1, total)
    profiles: list[Profile] = []
    for label in labels:
        say(f"interval of {label}")
        profiles.append(profile(found, pushes, slider, hand, label))
        progress(1 + len(profiles), total)
    noise = None
    if options.noise:
        say("fitting how much friction scatters")
        # of pushes that were learned from too little is left over: every second about what the others tell
        odd = jnp.broadcast_to(jnp.arange(pushes.weight.shape[-1]) % 2, pushes.weight.shape)
        others = pj.identify(pushes.weighted(pushes.weight * (1 - odd)), slider, hand, unknowns, touching=touching)
        second = pushes.weighted(pushes.weight * odd)
        noise = identify_noise(jax.random.key(seed), others, second, slider, hand, progress=progress)
    lengths = [one.length for one in recordings if one.length is not None]
    length = lengths[0] if lengths else float(found.length)
    say("predicting the pushes again")
    predicted = found.predict(pushes, slider, hand)
    return Findings(problems, slider, hand, pushes, found, predicted, tuple(profiles), noise, length)


def _check_forces(recordings: list[Recordings], options: Options) -> None:
    if not options.forces:
        return
    if options.parts < 2:
        needs = "the parts of a push, each of which gives a wrench, to be 2 at least"
        raise ValueError(f"--forces needs --parts, {needs}; got {options.parts}")
    for one in recordings:
        if not paired(one):
            raise ValueError(f"--forces: {one.source} does not have the forces of a single finger for every push")


def _each(items: list, of: Callable[[Any], Recordings]) -> tuple[list[Recordings], list[LogError]]:
    """What is made of every item, and the errors of those of which nothing is: raised only if it is so of all."""
    good, bad = [], []
    for item in items:
        try:
            good.append(of(item))
        except LogError as error:
            bad.append(error)
    if not good:
        raise bad[0]
    return good, bad


def conditions(recordings: list[Recordings], shape, options: Options, seed: int) -> tuple[pj.Pushes, pj.Slider]:
    """Every log a condition, or all logs one."""
    degree = {"quartic": 4, "ellipsoid": 2}[options.surface]
    # the same of every log, for they become one array
    parts = options.parts if all(seen_after(one, options.parts) for one in recordings) else 1
    forces = options.forces and all(paired(one) for one in recordings)
    each = [recorded(one, options.steps, parts, shape if forces else None) for one in recordings]

    def expected(one: Recordings) -> pj.LimitSurface:
        return setting.expected_surface(setting.support_of(options.support, shape, one), degree, seed)

    if options.separate and len(each) > 1:
        several = jax.tree.map(lambda *leaves: jnp.stack(leaves), *(expected(one) for one in recordings))
        return pj.Pushes.conditions(each), pj.Slider(shape, several)
    whole = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *each)
    return whole, pj.Slider(shape, expected(recordings[0]))


def _warning(predicted: dict[str, Any]) -> str | None:
    """Of a fit that explains next to nothing: whatever it says of friction is worth as little."""
    mean, before, still = (predicted[f"{name}_mm"] for name in ("mean", "expected", "no_motion"))
    if mean < POOR * still or (mean < NO_BETTER * before and mean < still):
        return None
    return (
        f"what was found predicts final poses to {mean:.3g} mm in the mean, of {still:.3g} that the objects moved, and "
        f"to {before:.3g} before: are units, frames, outline and radius right?"
    )


def _noise(noise: Noise) -> dict[str, Any]:
    return {
        "dof": float(noise.dof),
        "friction": np.asarray(noise.friction),
        "offset_mm": 1e3 * float(noise.offset),
        "sigma_mm": 1e3 * float(noise.sigma),
        "relative": np.asarray(noise.relative),
        "tails": float(noise.tails),
        "score_mm": 1e3 * float(noise.score),
    }


def summary(record: dict[str, Any]) -> str:
    """What the command prints: a line for each number found."""
    problems, level = record["problems"], record["settings"]["level"]
    counted = "1 problem" if len(problems) == 1 else f"{len(problems)} problems"
    lines = [f"{record['pushes']} pushes used, {counted}."]
    chosen = record["settings"]
    if record["warning"] is not None:
        lines.insert(0, f"WARNING: {record['warning']}")
    if record["poses"] < chosen["parts"]:
        lines.append(f"only final poses: not every push was seen {chosen['parts'] - 1} times on the way")
    if chosen["forces"]:
        lines.append(f"{record['wrenches']} measured wrenches.")
    lines += [f"  {problem}" for problem in problems[:10]]
    if len(problems) > 10:
        lines.append(f"  and {len(problems) - 10} more (see the JSON)")
    lines += ["", f"{'':14}{'estimate':>10}{f'{level:.0%} interval':>20}{'profile':>20}{'determined':>12}"]
    for row in record["rows"]:
        normal, exact = (f"{row[name][0]:.3g} to {row[name][1]:.3g}" for name in ("interval", "profile"))
        name = row["label"] + (f" / {row['unit']}" if row["unit"] else "")
        lines.append(f"{name:14}{row['estimate']:10.4g}{normal:>20}{exact:>20}{row['determined']:12.0%}")
    lines += [
        f"limit surface: {record['surface_determined']:.1f} of the {record['surface_numbers']} numbers that its prior "
        "varies are determined",
        "",
        f"deviation of predicted final poses: {record['mean_mm']:.2f} mm in the mean, {record['worst_mm']:.2f} mm at "
        f"worst; as expected before any push, {record['expected_mm']:.2f} mm; the objects moved "
        f"{record['no_motion_mm']:.1f} mm",
        f"sigma: {record['sigma_mm']:.3g} mm; " + ("converged" if record["converged"] else "NOT converged"),
    ]
    if record["noise"] is not None:
        noise = record["noise"]
        friction = np.array2string(np.asarray(noise["friction"]), precision=3)
        way, turn = noise["relative"]
        lines.append(
            f"noise: dof {noise['dof']:.0f}, friction {friction}, hand off by {noise['offset_mm']:.2f} mm, poses by "
            f"{noise['sigma_mm']:.2f} mm, {100 * way:.1f} % of their way and {100 * turn:.1f} % of their turn; energy "
            f"score {noise['score_mm']:.2f} mm"
        )
    lines.append("interval: normal; profile: all else at its best; determined: how much of the doubt before is gone.")
    if record["failed_steps"]:
        lines.append(f"{record['failed_steps']} steps of the predicted pushes failed (see the JSON)")
    lines += [f"drew {path}" for path in record["pictures"]]
    if record["identified"] is not None:
        lines.append(f"wrote {record['identified']}, for pushjax.Identified.load")
    return "\n".join(lines)
