"""Record contact problems with the answers of the independent search: python -m tests.oracles.record.

A problem is kept if its answer is clear: searches from five seeds find the same motion, or find none while there is
squeeze power. Nothing in the record comes from the solvers.
"""

from pathlib import Path
from typing import Any

import jax
import numpy as np

from pushjax.testing import ProblemBatch, closing, search, squeeze_power
from pushjax.testing.problems import random_contacts_problem

RECORD = Path(__file__).with_name("contacts.npz")
SLOTS, DRAWN, KEPT = 4, 150, 40  # contacts of the arrays; problems for each degree and number of contacts
SEEDS, STARTS = range(5), 50
SAME = 1e-7  # twists of two searches, relative to the speed
MOVING, FREE, JAMMED = 0, 1, 2


def problems(degree: int, contacts: int) -> ProblemBatch:
    """Return random problems with their active contacts in front."""

    def draw(key):
        return random_contacts_problem(key, contacts=contacts, degree=degree, slots=SLOTS)

    surface, drawn = jax.jit(jax.vmap(draw))(jax.random.split(jax.random.key(10 * degree + contacts), DRAWN))
    order = np.argsort(~np.asarray(drawn.active), axis=1, kind="stable")
    row = np.arange(DRAWN)[:, None]
    return ProblemBatch.of(surface, jax.tree.map(lambda leaf: leaf[row, order], drawn))


def answered(batch: ProblemBatch) -> dict[str, np.ndarray]:
    """Return status, twist, wrench and squeeze power of all problems, and which of them are clear."""
    found = [search(batch, STARTS, seed) for seed in SEEDS]
    scale = np.stack([np.ones(len(batch)), np.ones(len(batch)), batch.length], axis=1)
    apart = [np.linalg.norm((each.twist - found[0].twist) * scale, axis=1) for each in found]
    every, power = np.stack([each.found for each in found]), squeeze_power(batch)
    moves = every.all(axis=0) & (np.max(apart, axis=0) < SAME * batch.speed())
    jams = ~every.any(axis=0) & (power > 1e-6 * batch.speed())
    status = np.where(closing(batch) <= 0, FREE, np.where(moves, MOVING, JAMMED))
    return {
        "clear": moves | jams, "status": status, "twist": found[0].twist, "wrench": found[0].wrench, "power": power,
    }  # fmt: skip


def record() -> dict[str, np.ndarray]:
    """Return the arrays of the record, named by the degree of their limit surfaces."""
    arrays = {}
    for degree in (2, 4):
        parts: list[dict[str, Any]] = []
        for contacts in range(1, SLOTS + 1):
            batch = problems(degree, contacts)
            answers = answered(batch)
            kept = np.flatnonzero(answers.pop("clear"))[:KEPT]
            fields = vars(batch.take(kept)) | {name: answer[kept] for name, answer in answers.items()}
            parts.append({name: value for name, value in fields.items() if name != "degree"})
        arrays |= {f"{name}_{degree}": np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return arrays


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    np.savez_compressed(RECORD, **record())
