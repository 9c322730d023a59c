"""The same pushes by MuJoCo and MJX, compared with the exact Coulomb answer and with pushjax."""

import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest

import pushjax as pj
from benchmarks import grasps, reference_push
from benchmarks.peers import coulomb, grasp, mujoco, rows
from benchmarks.peers.mujoco import error_mm, fan, push
from benchmarks.peers.scene import Scene, Settings, build
from benchmarks.timing import both_dtypes

pytest.importorskip("mujoco")

THREE = ((-0.03, -0.02), (0.03, -0.02), (0.0, 0.03))
FOUR = ((-0.045, -0.045), (0.045, -0.045), (0.045, 0.045), (-0.045, 0.045))
FINE = 0.0025
# Errors left by soft contacts, creep and inertia; a wrong sign or a wrong friction causes many millimeters.
SOFT_MM = 0.3
EXACT_STEPS = 20  # second order: error of 0.02 mm


def exact(scene, which, friction=0.25):
    starts, ends = fan(scene)
    points = np.array(scene.supports)
    return np.array([coulomb.push(points, starts[k], ends[k], friction, steps=EXACT_STEPS)[0] for k in which])


@pytest.mark.parametrize(("supports", "friction"), [(THREE, 0.25), (THREE, 0.1), (FOUR, 0.25), (FOUR, 0.5)])
def test_ends_where_exact_friction_says(supports, friction):
    scene, which = Scene(supports, friction_tip=friction), [1, 3, 5, 7]
    starts, ends = fan(scene)
    found = push(scene, Settings(), FINE, starts[which], ends[which])
    assert error_mm(found.pose, exact(scene, which, friction)).max() < SOFT_MM


def test_friction_of_the_table_does_not_matter():
    starts, ends = fan(Scene(THREE))
    found = [push(Scene(THREE, friction_table=mu), Settings(), FINE, starts, ends).pose for mu in (0.25, 0.35)]
    assert error_mm(*found).max() < SOFT_MM


def test_pushjax_agrees_to_what_a_quartic_can():
    """A quartic smooths the facets and edges of a limit surface of points: 0.75 mm here, 2.8 mm on three points."""
    scene, which = Scene(FOUR), [0, 1, 2, 3, 5, 7]
    starts, ends = (each[which] for each in fan(scene))
    support = pj.Support.points(np.array(FOUR))
    surface = pj.fit_limit_surface(*support.wrench_twist_pairs(jax.random.key(0), 400), degree=4)
    slider, hand = pj.Slider(pj.Polygon.rectangle(0.09, 0.09), surface), pj.Hand.finger(scene.tip_radius)
    paths = jnp.asarray(starts)[:, None] + jnp.linspace(0, 1, 101)[None, :, None] * jnp.asarray(ends - starts)[:, None]
    final = jax.jit(jax.vmap(lambda p: pj.rollout(slider, hand, p, pose=jnp.zeros(3), friction=0.25).pose[-1]))(paths)
    assert error_mm(push(scene, Settings(), FINE, starts, ends).pose, np.asarray(final)).max() < 1.5


def test_a_sticking_tip_hardly_creeps():
    starts, ends = (each[:3] for each in fan(Scene(THREE)))
    slip = np.abs(push(Scene(THREE), Settings(), FINE, starts, ends).slip)
    assert slip.max() < 3e-5
    assert slip[2] > 1e-7  # soft friction always slips; zero would mean that it is not measured


def test_the_tip_hardly_sinks_in():
    scene = Scene(FOUR)
    starts, ends = (each[:5] for each in fan(scene))
    x, y, theta = push(scene, Settings(), FINE, starts, ends).pose.T
    gap = -(np.cos(theta) * (ends[:, 0] - x) + np.sin(theta) * (ends[:, 1] - y)) - scene.side / 2 - scene.tip_radius
    assert np.all(gap < 0)
    assert np.all(gap > -1e-4)


def test_settings_out_of_the_box_are_far_off():
    """MuJoCo's defaults are far off: a sliding contact dilates, and a pyramidal cone is not isotropic."""
    plain = Settings("pyramidal", "Newton", "Euler", 1.0, 0.02, 0.0, 0.0, (0.9, 0.95))
    scene, which = Scene(THREE), [2, 4]
    starts, ends = (each[which] for each in fan(scene))
    for settings in (plain, replace(plain, cone="elliptic")):
        found = push(scene, settings, FINE, starts, ends)
        assert error_mm(found.pose, exact(scene, which)).max() > 0.45


def test_smaller_steps_converge_and_cost_more():
    found = mujoco.accuracy(Scene(FOUR), Settings(), (0.04, 0.01, 0.0025, 0.00125))
    errors = [row.error_mm for row in found]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.1
    assert found[2].us_per_push > found[0].us_per_push
    assert mujoco.largest(found, 1e-4).timestep < 0.04
    with pytest.raises(ValueError, match="at no timestep"):
        mujoco.largest(found, 1e-12)


@pytest.mark.parametrize("threshold", [0.0102, 0.0119, 0.0141])
def test_the_largest_timestep_is_bisected(threshold):
    """The threshold is found within the resolution of the bisection, whatever the grid."""
    tried = []

    def at(timestep):
        tried.append(timestep)
        return mujoco.StepError(timestep, 0.09 if timestep <= threshold else 0.11, 1.0)

    found = mujoco.refined([at(0.01 * 2**k) for k in (1.0, 0.5, 0.0, -0.5)], at)
    assert len(tried) == 4 + mujoco.BISECTIONS
    assert [row.timestep for row in found] == sorted(tried, reverse=True)
    resolution = 2 ** (0.5 / 2**mujoco.BISECTIONS)
    assert threshold / resolution < mujoco.largest(found).timestep <= threshold


def test_grasps_turn_the_square_as_far_as_it_must():
    """At the end both fingers touch, and the angle is geometry; it amplifies the penetration depth 2.6 times."""
    scene, poses = Scene(FOUR, friction_tip=grasps.FRICTION), grasps.fan()[[0, 10, 17, 26]]
    fine, coarse = (grasp.grasp(scene, grasp.SUPPORTED, grasp.Fingers(), h, poses).pose for h in (FINE, 0.01))
    assert np.abs(np.abs(fine[:, 2]) - grasps.END_ANGLE).max() * reference_push.LENGTH < 3e-4
    np.testing.assert_array_equal(np.sign(fine[:, 2]), np.sign(poses[:, 2]))
    assert 0 < error_mm(fine, coarse).max() < 0.2
    soft = grasp.Fingers(normal=0.02, impedance=(0.7, 0.7))
    assert np.abs(grasp.grasp(scene, grasp.SUPPORTED, soft, FINE, poses).pose[:, 2]).min() > grasps.END_ANGLE + 0.03


def test_rows_are_compared_with_their_own():
    """A row is compared with the fastest peer of the same case, of those that find the most motions."""
    named = ("fit_quartic", "gradient", "solve_2")
    mine = [{"case": name, "dtype": "float32", "batch": 10, "processor_s": 2.0} for name in named]
    mine = [row | {"peer_ratio": None} for row in mine]
    theirs = [{"of": "fit_quartic", "peer": name, "processor_s_each": t} for name, t in (("a", 3.0), ("b", 1.0))]
    rows.compare(mine, [*theirs, {"of": "solve_1", "peer": "c", "processor_s_each": 0.1}])
    assert (mine[0]["peer"], mine[0]["peer_ratio"]) == ("b", 5.0)
    assert mine[1]["peer_ratio"] is None
    theirs = [
        {"of": "solve_2", "peer": name, "processor_s_each": t, "found": part}
        for name, t, part in (("scipy", 4.0, 0.9), ("jaxopt", 0.1, 0.5))
    ]
    rows.compare(mine, theirs)
    assert (mine[2]["peer"], mine[2]["peer_ratio"]) == ("scipy", 20.0)


def peer(name, supports, each, **more):
    table = [{"timestep": h, "error_mm": e, "us_per_push": 1e3} for h, e in ((0.02, 0.3), (0.01, 0.05))]
    row = {"of": "push_quartic", "peer": name, "supports": supports, "timestep_s": 0.01, "error_mm": 0.05}
    row |= {"exact_error_mm": 0.15, "slip_um": [4.0, 11.0], "by_timestep": table}
    return row | {"processor_s_each": each, "processor_s_range": [each, each]} | more


def test_slip_and_errors_are_of_the_steps_of_the_row(monkeypatch, tmp_path):
    """Slip and error are computed for the steps of the row, and then compared, printed and drawn.

    The slow functions are replaced; the test checks their arguments.
    """
    asked = []
    monkeypatch.setattr(rows, "slip_um", lambda dtype, steps: asked.append((dtype, steps)) or [0.006, 0.09])
    monkeypatch.setattr(rows, "same_fan_error_mm", lambda dtype, steps: asked.append((dtype, steps)) or 0.024)
    drawn = {}
    monkeypatch.setattr(
        rows, "speed_figure", lambda curves, allowed: drawn.update(curves) or plt.figure(figsize=(1, 1))
    )
    push_row = {"case": "push_quartic", "dtype": "float32", "batch": 10, "processor_s": 2e-4, "steps": 7.99}
    push_row |= {"pose_error_mm": 0.06, "peer": None, "peer_ratio": None}
    other = push_row | {"case": "grasp_two_fingers", "steps": 6.0}
    theirs = [peer("mujoco", "three", 4e-3), peer("mujoco", "four", 3e-3), peer("mjx", "four", 9e-3)]
    rows.compare([push_row, other], theirs)
    assert asked == [("float32", 8), ("float32", 8)]
    assert (push_row["peer"], push_row["peer_ratio"]) == ("mujoco", pytest.approx(150))
    assert other["peer_ratio"] is None

    printed = "\n".join(rows.summary(theirs, [push_row, other]))
    assert "slip 0.006 and 0.09 um; 0.024 mm over the pushes of MuJoCo's" in printed
    assert "mjx: 9.00 ms of CPU time, four supports, 10 ms steps (0.050 mm), 0.15 mm from exact friction" in printed
    assert "grasp" not in printed

    by_steps = [push_row | {"steps": float(n)} for n in (4, 8)]
    path = rows.draw({"by_steps": by_steps, "peers": [*theirs, {"of": "fit_quartic"}]}, tmp_path)
    assert Path(path).stat().st_size > 0
    assert set(drawn) == {"pushjax, float32", "MuJoCo, three supports", "MuJoCo, four supports", "MJX, four supports"}
    assert drawn["MJX, four supports"] == [(1e-3, 0.3), (1e-3, 0.05)]


@pytest.mark.slow
def test_pushjax_converges_over_the_pushes_of_mujoco():
    with both_dtypes():
        errors = [rows.same_fan_error_mm("float64", steps) for steps in (4, 8, 16)]
    assert errors == sorted(errors, reverse=True)
    assert errors[2] < errors[1] / 2.5  # second order, except where sticking changes to sliding
    assert errors[1] < reference_push.ALLOWED_MM


@pytest.mark.slow
def test_mjx_converges_with_softened_contacts():
    """With softened contacts MJX converges, and another timestep uses the same compiled program."""
    mjx = pytest.importorskip("benchmarks.peers.mjx")
    scene, settings = Scene(FOUR, travel=0.02), mjx.softened(0.01)
    batch = mjx.Batch(scene, mjx.SETTINGS, 0.005, *fan(scene))
    coarse, converged = (batch.pushed(step, settings) for step in (0.01, FINE))
    assert 0 < error_mm(coarse.pose, converged.pose).max() < 0.1
    assert np.abs(converged.slip[:3]).max() < 3e-5
    assert error_mm(converged.pose, exact(scene, range(8))).max() < 0.2
    with pytest.raises(ValueError, match="two timesteps"):
        batch.pushed(0.01)


def test_without_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ValueError, match=r"pip install '\.\[bench\]'"):
        build(Scene(THREE), Settings(), FINE)


@pytest.mark.parametrize("wrong", [{"supports": THREE[:2]}, {"supports": THREE, "speed": 0.0}])
def test_scenes_that_cannot_be(wrong):
    with pytest.raises(ValueError, match="must be"):
        Scene(**wrong)


# Fixtures as MuJoCo and pushjax have them, the slider's start pose, and the tip's travel; the tip moves along +x from
# the origin. A wall on which the slider lies; a wall that it is pushed against and turns onto; a peg that turns it.
AMONG_FIXTURES = {
    "along a wall": (
        ('type="box" size="0.5 0.1 0.1" pos="0 -0.165 0"', pj.Wall((0.0, -0.065), (0.0, 1.0), 0.25)),
        (0.04975, -0.02, 0.0),
        0.05,
    ),
    "onto a wall": (
        ('type="box" size="0.1 0.5 0.1" pos="0.235 0 0"', pj.Wall((0.135, 0.0), (-1.0, 0.0), 0.25)),
        (0.06, -0.02, 0.35),
        0.04,
    ),
    "around a peg": (
        ('type="cylinder" size="0.02 0.1" pos="0.14 0.035 0"', pj.Fixture(pj.Disk(0.02), (0.14, 0.035, 0.0), 0.25)),
        (0.04975, 0.0, 0.0),
        0.028,  # at 0.03 the slider is wedged between tip and peg: a jam
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["along a wall", "around a peg"])
def test_pushes_among_fixtures_agree(name):
    """The poses agree to what a quartic and soft contacts allow; without the fixture they are far apart."""
    (geom, fixture), start, travel = AMONG_FIXTURES[name]
    scene, settings = Scene(FOUR), Settings()
    engine = pytest.importorskip("mujoco")
    model = build(scene, settings, FINE, conveyor=False, fixtures=(geom,))
    data = engine.MjData(model)
    data.qpos[:3] = *start[:2], mujoco.settle(model, settings)[2]
    data.qpos[3:7] = np.cos(start[2] / 2), 0, 0, np.sin(start[2] / 2)
    for _ in range(round(travel / scene.speed / FINE)):
        data.qvel[6] = scene.speed
        engine.mj_step(model, data)
    found = np.array([*data.qpos[:2], 2 * np.arctan2(data.qpos[6], data.qpos[3])])
    support = pj.Support.points(np.array(FOUR))
    slider = pj.Slider.on(pj.Polygon.rectangle(0.09, 0.09), support)
    hand, path = pj.Hand.finger(scene.tip_radius), pj.line((0.0, 0.0), (float(data.qpos[7]), 0.0), steps=100)
    ours, free = (
        pj.rollout(slider, hand, path, pose=start, friction=0.25, fixtures=fixtures) for fixtures in ((fixture,), ())
    )
    assert np.all(np.isin(ours.status, [pj.Status.MOVING, pj.Status.FREE]))
    assert error_mm(found[None], np.asarray(ours.pose[-1:])).max() < 1.5
    assert error_mm(found[None], np.asarray(free.pose[-1:])).max() > 2.5
