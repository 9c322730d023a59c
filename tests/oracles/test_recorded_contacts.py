"""The solver has the answers that an independent search has to recorded contact problems (`oracles.record`)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import AS_USERS
from contact_batches import BATCH, MOST, first

import pushjax as pj
from oracles.record import FREE, JAMMED, KEPT, MOVING, RECORD, SLOTS
from pushjax.testing import CLEAN, ProblemBatch, violations

# Of the twist relative to the speed, of the direction of the wrench, and of the squeeze power relative to the speed
TWIST, WRENCH, POWER = 1e-6, 1e-5, 1e-9
# the program of `test_random_contacts`
solve_all = jax.jit(jax.vmap(pj.solve_contacts), compiler_options=AS_USERS)


@pytest.mark.parametrize("degree", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_recorded_answers(degree):
    with np.load(RECORD) as file:
        known = {name.removesuffix(f"_{degree}"): file[name] for name in file.files if name.endswith(f"_{degree}")}
    count = len(known["status"])
    assert count == SLOTS * KEPT
    for status in (MOVING, FREE, JAMMED):
        assert np.sum(known["status"] == status) > 10

    def filled(name):
        array = np.pad(known[name], [(0, 0), (0, MOST - SLOTS)] + [(0, 0)] * (known[name].ndim - 2))
        return jnp.asarray(np.resize(array, (BATCH, *array.shape[1:])))

    numbers, length = (
        jnp.asarray(np.resize(known[n], (BATCH, *known[n].shape[1:]))) for n in ("coefficients", "length")
    )
    surface = jax.vmap({2: pj.Ellipsoid, 4: pj.Quartic}[degree])(numbers, length)
    names = ("point", "normal", "displacement", "friction", "gap", "active")
    contacts = jax.vmap(pj.Contacts)(*(filled(name) for name in names))
    motion = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], solve_all(surface, contacts))

    expected = {MOVING: pj.Status.MOVING, FREE: pj.Status.FREE, JAMMED: pj.Status.JAMMED}
    np.testing.assert_array_equal(motion.status, [expected[status] for status in known["status"]])
    batch = ProblemBatch.of(first(surface, count), first(contacts, count))
    speed = batch.speed()
    scale = np.stack([np.ones(count), np.ones(count), known["length"]], axis=1)
    same = np.linalg.norm((motion.twist - known["twist"]) * scale, axis=1) / speed < TWIST
    # a problem that moves may have two answers: then the solver says so, and its own satisfies every condition
    assert (~same).sum() <= count // 20
    assert not motion.unique[~same].any()
    moving = known["status"] == MOVING
    worst = violations(batch, motion.twist, motion.force, motion.wrench).worst()
    assert worst[moving].max() < CLEAN
    assert not motion.twist[~moving].any()
    wrench, expected = (each[moving & same] / scale[moving & same] for each in (motion.wrench, known["wrench"]))
    assert np.max(np.linalg.norm(wrench - expected, axis=1) / np.linalg.norm(expected, axis=1)) < WRENCH
    several = known["active"].sum(axis=1) > 1
    np.testing.assert_allclose(
        -motion.margin[several] / speed[several], known["power"][several] / speed[several], atol=POWER
    )
