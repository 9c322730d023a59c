"""What was identified, and noise, in files."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from pushjax._files import read_record
from pushjax.identify.identified import Identified
from pushjax.identify.noise import Noise, Values
from pushjax.identify.unknowns import Layout, Mean, Prior, Unknowns

FORMAT, NOISE_FORMAT, VERSION = "pushjax identified", "pushjax noise", 1
SPREADS = ("dof", "center", "inset", "end", "lag", "offset")
ARRAYS = ("z", "precision", "sigma", "direction", "residual", "information", "loss", "length")


def save(found: Identified, path: str | Path) -> None:
    _write(_record(found), path)


def save_noise(noise: Noise, path: str | Path) -> None:
    dtype = str(noise.score.dtype)
    record = {"format": NOISE_FORMAT, "version": VERSION, "dtype": dtype, "sampler": noise.sampler}
    record["values"] = {name: _plain(value) for name, value in noise.values._asdict().items()}
    record |= {"score": _plain(noise.score), "history": _plain(noise.history), "found": _record(noise.found)}
    _write(record, path)


def _write(record: dict[str, Any], path: str | Path) -> None:
    Path(path).write_text(json.dumps(record, indent=1) + "\n")


def _record(found: Identified) -> dict[str, Any]:
    unknowns, mean = found.prior.unknowns, found.prior.mean
    record: dict[str, Any] = {"format": FORMAT, "version": VERSION, "dtype": str(found.z.dtype), "single": found.single}
    record["robust"] = found.robust
    record |= {"steps": int(found.steps), "status": int(found.status), "labels": found.labels}
    # repr of a float64 is exact, and a float32 is a float64
    record |= {name: _plain(getattr(found, name)) for name in ARRAYS}
    record["unknowns"] = {name: _plain(getattr(unknowns, name)) for name in ("friction", *SPREADS)}
    record["shared"] = unknowns.shared
    record["known_friction"] = _plain(found.prior.friction)
    record["mean"] = {name: _plain(getattr(mean, name)) for name in ("lower", "spread", "length")}
    # for who reads the file: not read back
    record["estimates"] = {name: _plain(value) for name, value in found.physical._asdict().items()}
    return record


def load(path: str | Path) -> Identified:
    return read_record(path, "what pushjax identified", FORMAT, VERSION, _identified)


def load_noise(path: str | Path) -> Noise:
    return read_record(path, "noise that pushjax identified", NOISE_FORMAT, VERSION, _noise)


def _noise(record: dict[str, Any], dtype: Any) -> Noise:
    values = Values(**{name: jnp.asarray(value, dtype) for name, value in record["values"].items()})
    score, history = (jnp.asarray(record[name], dtype) for name in ("score", "history"))
    return Noise(_identified(record["found"], dtype), values, score, history, record["sampler"])


def _identified(record: dict[str, Any], dtype: Any) -> Identified:
    def array(value: Any) -> Any:
        return None if value is None else jnp.asarray(value, dtype)

    known = {name: array(value) for name, value in record["unknowns"].items()}
    unknowns = Unknowns(known.pop("friction"), **known, shared=tuple(record["shared"]))
    mean = Mean(**{name: array(value) for name, value in record["mean"].items()})
    conditions, terms = mean.lower.shape[:2]
    layout = Layout.of(unknowns, 4 if terms > 1 else 2, conditions)
    prior = Prior(unknowns, array(record["known_friction"]), mean, layout)
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
    )


def _plain(value: Any) -> Any:
    return None if value is None else np.asarray(value, np.float64).tolist()
