"""The verifier, compared with recorded problems with known answers and with itself."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import nnls

from pushjax import Contacts, Ellipsoid, Quartic
from pushjax.testing import CLEAN, ProblemBatch, closing, search, squeeze_power, squeeze_power_enumerated, violations
from pushjax.testing.problems import ContactsProblem, random_contacts_problem

# Recorded answers are exact to roundoff. The flattest recorded surfaces lose digits of the angle (the smallest
# eigenvalue of their Hessian is 3e-6 of the largest).
RECORDED = 1e-9
# Two ways to the same vertex of a linear program.
SQUEEZE = 1e-10
COUNT = 1000
# Gradients and arms compared with those of the library.
SAME = 1e-12
# Fault in each condition that is injected into a right answer.
FAULT = 1e-3


def recorded_batch(rows: dict[str, Any]) -> ProblemBatch:
    """Return recorded problems of one degree and number of contacts; their normals point outwards, ours inwards."""
    n, m = len(rows["K"]), int(rows["K"].max())
    degree = 4 if rows["ls_type"][0] else 2
    return ProblemBatch(
        degree,
        rows["coeffs"] if degree == 4 else rows["A"],
        rows["rho"],
        rows["points"][:, :m],
        -rows["normals"][:, :m],
        rows["vels"][:, :m],
        np.repeat(rows["mu"][:, None], m, axis=1),
        np.zeros((n, m)),
        np.arange(m)[None] < rows["K"][:, None],
    )


@pytest.fixture(scope="module")
def recorded(oracle) -> dict[int, dict[str, Any]]:
    """Return the recorded problems by the degree of their limit surfaces."""
    with np.load(oracle / "multi_contact.npz") as file:
        rows = dict(file)
    return {degree: chosen(rows, rows["ls_type"] == (degree == 4)) for degree in (2, 4)}


def chosen(rows: dict[str, Any], where) -> dict[str, Any]:
    return {name: column[where] for name, column in rows.items()}


def forces_of(batch: ProblemBatch, twist: np.ndarray, wrench: np.ndarray) -> np.ndarray:
    """Return forces along the edges that a normalized twist allows, whose sum is the normalized wrench."""
    rows = batch.rows()
    slip = np.einsum("nmij,nj->nmi", rows, twist) - batch.approach()
    slip /= batch.speed()[:, None, None]
    force = np.zeros(slip.shape)
    for k, i in zip(*np.nonzero(batch.active & (slip[..., 0] < 1e-8)), strict=True):
        force[k, i] = np.nan  # this contact touches
    for k in range(len(batch)):
        edges = [
            (i, s * batch.friction[k, i])
            for i in np.flatnonzero(np.isnan(force[k, :, 0]))
            for s in (1, -1)
            if s * slip[k, i, 1] < 1e-8
        ]
        force[k] = 0
        shares, _ = nnls(np.stack([rows[k, i, 0] + s * rows[k, i, 1] for i, s in edges], axis=1), wrench[k])
        for (i, s), share in zip(edges, shares, strict=True):
            force[k, i] += share * np.array([1.0, s])
    return force


@functools.cache
def random_problems(**kw) -> ContactsProblem:
    draw = eqx.filter_jit(jax.vmap(functools.partial(random_contacts_problem, **kw)))
    return draw(jax.random.split(jax.random.key(0), COUNT))


def random_batch(**kw) -> ProblemBatch:
    problem = random_problems(**kw)
    return ProblemBatch.of(problem.surface, problem.contacts)


def with_arms(batch: ProblemBatch, twist, wrench) -> tuple[np.ndarray, np.ndarray]:
    """Convert normalized twist and wrench to SI units."""
    one = np.ones_like(batch.length)
    arms = np.stack([one, one, batch.length], axis=1)
    return twist / arms, wrench * arms


def test_recorded_answers_violate_nothing(recorded):
    for every in recorded.values():
        rows = chosen(every, every["status_true"] == "moving")
        batch = recorded_batch(rows)
        twist, wrench = with_arms(batch, rows["V_true"], rows["F_true_level1"])
        force = forces_of(batch, rows["V_true"], rows["F_true_level1"])
        parts = violations(batch, twist, force, wrench)
        assert {name: part.max() for name, part in parts._asdict().items() if part.max() > RECORDED} == {}
        assert (closing(batch) > 0).all()


def test_recorded_squeeze_power(recorded):
    for rows in recorded.values():
        batch, speed, power = recorded_batch(rows), rows["max_speed"], rows["squeeze_power"]
        np.testing.assert_allclose(squeeze_power_enumerated(batch) / speed, power, rtol=0, atol=SQUEEZE)
        some = slice(0, None, 5)
        found = squeeze_power(batch.take(some)) / speed[some]
        np.testing.assert_allclose(found, power[some], rtol=0, atol=SQUEEZE)


def test_search_of_recorded_problems(recorded):
    """More than 99.5 % of the recorded motions are found; for jams that are not marked as ambiguous, none is."""
    for rows in recorded.values():
        status = rows["status_true"]
        batch = recorded_batch(chosen(rows, np.flatnonzero(status == "moving")[::2]))
        found = search(batch, 50)
        assert found.found.mean() > 0.995
        assert violations(batch, found.twist, found.force, found.wrench).worst()[found.found].max() <= CLEAN
        assert search(batch, 1, portions=()).found.mean() > 0.85

        jams = chosen(rows, np.flatnonzero((status == "jam") & ~rows["ambiguous"])[::4])
        assert not search(recorded_batch(jams), 50).found.any()

        batch = recorded_batch(chosen(rows, status == "receding"))
        assert (closing(batch) <= 0).all()
        found = search(batch)
        assert found.found.all()
        assert not found.twist.any()
        assert not found.force.any()


@pytest.mark.parametrize(("contacts", "degree"), [(4, 4), (3, 2)])
def test_both_squeeze_powers_agree(contacts, degree):
    batch = random_batch(contacts=contacts, slots=4, degree=degree).take(slice(300))
    program, vertices = squeeze_power(batch), squeeze_power_enumerated(batch)
    assert np.isfinite(program).any()
    assert not np.isfinite(program).all()
    np.testing.assert_allclose(
        vertices / batch.speed(), program / batch.speed(), rtol=0, atol=SQUEEZE, err_msg="enumerated, by program"
    )


@pytest.mark.parametrize(("contacts", "degree"), [(4, 4), (3, 2)])
def test_no_squeeze_power_means_an_answer(contacts, degree):
    """The existence theorem on random problems: if there is no squeeze power, the search finds the answer."""
    batch = random_batch(contacts=contacts, slots=4, degree=degree)
    batch = batch.take(squeeze_power_enumerated(batch) < 0)
    found = search(batch)
    assert found.found.mean() > 0.99
    assert violations(batch, found.twist, found.force, found.wrench).worst()[found.found].max() <= CLEAN


@pytest.mark.parametrize(("contacts", "degree"), [(4, 4), (3, 2)])
def test_surface_is_the_librarys(contacts, degree, rng):
    problem = random_problems(contacts=contacts, slots=4, degree=degree)
    batch = ProblemBatch.of(problem.surface, problem.contacts)
    wrench = rng.normal(size=(len(batch), 3))
    _, si = with_arms(batch, wrench, wrench)
    value = eqx.filter_vmap(lambda s, w: s.value(w))(problem.surface, jnp.asarray(si))
    twist = eqx.filter_vmap(lambda s, w: s.twist(w))(problem.surface, jnp.asarray(si))
    ours, _ = with_arms(batch, batch.gradient(wrench), wrench)
    np.testing.assert_allclose(batch.value(wrench), value, rtol=SAME)
    np.testing.assert_allclose(ours, twist, rtol=0, atol=SAME * np.abs(twist).max())


def test_each_fault_is_named():
    """For a square pushed straight by two contacts on one side, each fault in a tampered answer is named."""
    surface = Ellipsoid(np.eye(3), 0.05)
    contacts = Contacts(
        [[-0.05, 0.01], [-0.05, -0.01], [0.05, 0.0]],
        [[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]],
        [[2e-3, 0.0], [2e-3, 0.0], [3e-3, 0.0]],
        0.5,
        active=[True, True, False],
    )
    batch = ProblemBatch.of(surface, jax.tree.map(lambda leaf: leaf[None], contacts))
    twist = np.array([[2e-3, 0.0, 0.0]])
    force = np.array([[[0.5, 0.0], [0.5, 0.0], [0.0, 0.0]]])
    wrench = np.array([[1.0, 0.0, 0.0]])
    assert batch.speed() == 2e-3

    def faults(
        d_twist=(0, 0, 0), d_force=((0, 0), (0, 0), (0, 0)), scale=1.0, d_wrench=(0, 0, 0), given=True
    ) -> set[str]:
        answer = twist + 2e-3 * np.array(d_twist), scale * (force + np.array(d_force))
        parts = violations(batch, *answer, wrench + np.array(d_wrench) if given else None)
        return {name for name, part in parts._asdict().items() if part[0] > 0.1 * FAULT}

    assert faults() == set()
    assert faults(d_twist=(-FAULT, 0, 0)) == {"penetration"}
    assert faults(d_twist=(FAULT, 0, 0)) == {"complementarity"}
    assert faults(d_twist=(0, FAULT, 0)) == {"friction", "flow"}
    assert faults(d_force=((0, 0), (0, 0), (FAULT, 0))) == {"inactive"}
    assert faults(d_force=((0, 0.3), (0, -0.3), (0, 0))) == {"cone"}
    assert faults(d_force=((1, 0), (-1, 0), (0, 0))) == {"negative", "wrench"}
    assert faults(d_force=((1, 0), (-1, 0), (0, 0)), given=False) == {"negative", "flow"}
    assert faults(d_wrench=(0, FAULT, 0)) == {"flow", "wrench"}
    assert faults(scale=1 + FAULT, d_wrench=(FAULT, 0, 0)) == {"level"}
    assert violations(batch, -twist, -force).flow == 0  # a force and its flow, both reversed: others detect it
    assert violations(batch, twist, np.full_like(force, np.nan)).worst() == np.inf
    still = violations(batch, 0 * twist, 0 * force, 0 * wrench)
    assert still.worst() == still.penetration == closing(batch) == 1


def test_padding_may_hold_anything():
    surface = Quartic([1.0, 1, 1, 0, 0, 0, 0, 0, 0, 2, 2, 2, 0, 0, 0], 0.05)
    given = [[-0.05, 0.0], [0.0, 0.0]], [[1.0, 0.0], [0.0, 1.0]], [[1e-3, 0.0], [0.0, 0.0]]
    contacts = Contacts(*given, 0.5, active=[True, False])
    spoilt = eqx.tree_at(lambda c: c.displacement, contacts, contacts.displacement.at[1].set(jnp.nan))
    batch = ProblemBatch.of(surface, jax.tree.map(lambda leaf: leaf[None], spoilt))
    found = search(batch, 5)
    assert found.found.all()
    np.testing.assert_allclose(found.twist, [[1e-3, 0, 0]], atol=1e-10)
    np.testing.assert_allclose(found.wrench, [[1, 0, 0]], atol=1e-7)
    assert (squeeze_power_enumerated(batch) == -np.inf).all()


def test_problems_are_the_mix_they_say():
    batch = random_batch(contacts=3, slots=4, degree=2)
    on = batch.active
    assert (on.sum(axis=1) == 3).all()
    assert on.mean(axis=0).min() > 0.7  # padding anywhere among the contacts
    np.testing.assert_allclose(np.linalg.norm(batch.normal, axis=2)[on], 1, atol=1e-12)
    size = np.linalg.norm(batch.displacement, axis=2)
    assert (size > 0).sum() >= on.sum()
    assert 1e-4 <= np.where(on, size, 0).max(axis=1).max() <= 1e-2
    gaps = np.where(on, batch.gap, 0.0)
    assert 0.4 < (gaps != 0).any(axis=1).mean() < 0.55
    assert -5e-4 <= gaps.min() < 0
    assert 2e-3 < gaps.max() <= 3e-3
    assert 0.05 < (batch.friction[on] == 0).mean() < 0.15
    assert batch.friction.max() > 4
    power = squeeze_power_enumerated(batch)
    assert 0.2 < (power > 0).mean() < 0.6
    assert 0.02 < (closing(batch) <= 0).mean() < 0.25
    parallel = np.abs(np.einsum("nmi,nki->nmk", batch.normal, batch.normal) - 1) < 1e-12
    assert ((parallel & on[:, None] & on[:, :, None]).sum(axis=(1, 2)) > 3).mean() > 0.4
