"""What was identified, and noise, in files."""

from pathlib import Path
from typing import Any

import jax.numpy as jnp

from pushjax._files import numbers, read_record, write_record
from pushjax.identify.identified import Identified
from pushjax.identify.noise import Noise
from pushjax.identify.unknowns import SIDES, SPREADS, Layout, Mean, Prior, Unknowns

FORMAT, NOISE_FORMAT, VERSION = "pushjax identified", "pushjax noise", 1
ARRAYS = ("z", "precision", "sigma", "direction", "gap", "residual", "information", "loss", "length")
NOISE_ARRAYS = ("dof", "friction", "offset", "sigma", "relative", "tails", "score", "history")


def save(found: Identified, path: str | Path) -> None:
    write_record(path, FORMAT, VERSION, found.z.dtype, _record(found))


def save_noise(noise: Noise, path: str | Path) -> None:
    record = {"sampler": noise.sampler, "found": _record(noise.found)}
    record |= {name: numbers(getattr(noise, name)) for name in NOISE_ARRAYS}
    write_record(path, NOISE_FORMAT, VERSION, noise.score.dtype, record)


def _record(found: Identified) -> dict[str, Any]:
    unknowns, mean = found.prior.unknowns, found.prior.mean
    record: dict[str, Any] = {"single": found.single, "robust": found.robust, "touching": found.touching}
    record |= {"steps": int(found.steps), "status": int(found.status), "labels": found.labels}
    record |= {name: numbers(getattr(found, name)) for name in ARRAYS}
    record["unknowns"] = {name: numbers(getattr(unknowns, name)) for name in ("friction", "dof", *SPREADS)}
    record["sides"] = unknowns.sides
    record["shared"] = unknowns.shared
    record["origin"] = numbers(found.prior.origin)
    record["known_friction"] = numbers(found.prior.friction)
    record["mean"] = {name: numbers(getattr(mean, name)) for name in ("lower", "spread", "length")}
    # for who reads the file: not read back
    estimates = found.physical._asdict()
    record["estimates"] = {name: numbers(value) for name, value in estimates.items() if value is not None}
    return record


def load(path: str | Path) -> Identified:
    return read_record(path, "what pushjax identified", FORMAT, VERSION, _identified)


def load_noise(path: str | Path) -> Noise:
    return read_record(path, "noise that pushjax identified", NOISE_FORMAT, VERSION, _noise)


def _noise(record: dict[str, Any], dtype: Any) -> Noise:
    record.setdefault("relative", [0.0, 0.0])  # as in files of before there was any
    arrays = {name: jnp.asarray(record[name], dtype) for name in NOISE_ARRAYS}
    return Noise(found=_identified(record["found"], dtype), sampler=record["sampler"], **arrays)


def _identified(record: dict[str, Any], dtype: Any) -> Identified:
    def array(value: Any) -> Any:
        return None if value is None else jnp.asarray(value, dtype)

    known = {name: array(value) for name, value in record["unknowns"].items()}
    sides = record.get("sides", SIDES)  # files of before there were any
    unknowns = Unknowns(known.pop("friction"), **known, sides=sides, shared=tuple(record["shared"]))
    mean = Mean(**{name: array(value) for name, value in record["mean"].items()})
    conditions, terms = mean.lower.shape[:2]
    layout = Layout.of(unknowns, 4 if terms > 1 else 2, conditions)
    origin = array(record.get("origin", [0.0, 0.0]))
    prior = Prior(unknowns, array(record["known_friction"]), mean, origin, layout)
    record.setdefault("gap", 0.0)  # as in files of before it was asked for
    arrays = {name: array(record[name]) for name in ARRAYS}
    if arrays["z"].shape != (layout.size,) or arrays["precision"].shape != (layout.size, layout.size):
        raise ValueError(f"its z has shape {arrays['z'].shape}; what it says was unknown has ({layout.size},)")
    return Identified(
        **arrays,
        prior=prior,
        steps=jnp.asarray(record["steps"], jnp.int32),
        status=jnp.asarray(record["status"], jnp.int8),
        single=bool(record["single"]),
        robust=record["robust"],
        touching=record.get("touching", False),
    )
