"""Results of `python -m benchmarks` for speed and accuracy; no test depends on how long anything takes."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import pushjax as pj
from benchmarks import cases, contacts, grasps, numerics, reference_push, speed, timing
from benchmarks.__main__ import MODULES, listing, main
from benchmarks.hlo import traffic
from pushjax.testing.problems import random_contacts_problem


@pytest.mark.slow
def test_errors_fall_with_the_square_of_the_step():
    by_steps = reference_push.errors("quartic", "float64")
    assert by_steps[8] < reference_push.ALLOWED_MM < by_steps[5]
    assert reference_push.fewest_steps(by_steps) in (6, 8)
    assert by_steps[64] < by_steps[16] / 10
    single = reference_push.errors("quartic", "float32")
    assert single[16] == pytest.approx(by_steps[16], abs=2e-3)
    with pytest.raises(ValueError, match="within 1e-09 mm"):
        reference_push.fewest_steps(by_steps, 1e-9)


@pytest.mark.slow
def test_rows(tmp_path):
    """There is one row per case, type and batch; `slower` compares cost, and a record is not slower than itself."""
    seen = []
    record = speed.run(("push",), ("float32",), (64, 128), keep=lambda r: seen.append(len(r["rows"])))
    assert seen == [1, 2]
    for row, batch in zip(record["rows"], (64, 128), strict=True):
        assert (row["case"], row["dtype"], row["batch"]) == ("push_quartic", "float32", batch)
        assert row["steps"] == 8
        assert row["pose_error_mm"] <= reference_push.ALLOWED_MM
        assert row["run_s_middle_half"][0] <= row["run_s"] <= row["run_s_middle_half"][1]
        assert row["multiply_adds_per_step"] > 300  # a step needs some 750 operations
        # counts of the compiled program, which computes some values more than once; bytes are those moved between
        # kernels, not between memory and them
        assert 750 < row["flops_per_step"] < 10_000
        assert 1000 < row["bytes_per_step"] < 100_000
        assert 0 < row["near_copy_fraction"] < 1
        assert row["per_processor_s"] == pytest.approx(batch / row["processor_s"])
    lines = speed.summary(record).splitlines()
    assert lines[1].split()[:4] == ["push_quartic", "float32", "64", "8"]
    assert lines[1].index("mm") == lines[2].index("mm")
    rows = record["rows"]
    assert speed.slower(rows, record) == ([], [])
    half = [row | {"multiply_adds_per_step": row["multiply_adds_per_step"] / 2} for row in rows]
    # half the cost per step with twice the steps is the same cost
    assert speed.slower(rows, {"rows": [row | {"steps": 2 * row["steps"]} for row in half]}) == ([], [])
    found, new = speed.slower(rows, {"rows": half[:1]})
    assert [row["times"] for row in found] == pytest.approx([2])
    assert "not in the baseline: push_quartic, float32, 128" in speed.summary(record | {"new": new})
    with pytest.raises(ValueError, match="no row of what was measured"):
        speed.slower(rows, {"rows": []})
    (tmp_path / "half.json").write_text(json.dumps({"experiment": "bench", "rows": half, "settings": {"cores": 1}}))
    with pytest.raises(ValueError, match="is of --cores 1; got all"):
        speed.read_baseline(tmp_path / "half.json", None)


def test_traffic_counts_rounds():
    """Count a loop as often as it runs, a kernel's operands and result, and all branches of a conditional."""
    x = jnp.ones(1000, jnp.float32)

    def of(function):
        return traffic(jax.jit(function).lower(x).compile().as_text())

    once, often = of(lambda x: x * 2.5 + 1.5), of(lambda x: jax.lax.fori_loop(0, 7, lambda k, x: x * 2.5 + 1.5, x))
    assert once == (2000, 8000, 1)
    assert once.times(3) == (6000, 24000, 1)
    assert often.flops == pytest.approx(7 * once.flops, rel=0.01)  # and the loop's own counter
    assert 7 * once.bytes <= often.bytes < 7.2 * once.bytes + 8000  # and a copy of the initial value
    # arrays that are read and written in place count by row
    rows = jax.jit(lambda x: jax.lax.map(lambda row: 2 * row, x)).lower(jnp.ones((50, 1000), jnp.float32)).compile()
    assert 50 * 8000 <= traffic(rows.as_text()).bytes < 50 * 8000 * 3
    product = traffic(jax.jit(lambda x: x @ x.T).lower(jnp.ones((40, 30))).compile().as_text())
    assert product.flops == pytest.approx(2 * 40 * 40 * 30)


@pytest.mark.slow
def test_cases_work():
    """Each case runs, and moves what it should."""
    problems = cases.solve("float64", 16, 2)
    twist = np.asarray(jax.jit(problems.function)(*problems.args))
    assert twist.shape == (16, 3)
    assert np.abs(twist).max() > 0
    sampled = cases.sampling("float64", 4)
    surface = jax.jit(sampled.function)(*sampled.args)
    assert all(pj.Quartic(c, surface.length[0]).is_convex() for c in surface.coefficients)
    one, args = cases.each_push("quartic", "float64", 3, 2)
    by = jax.jit(jax.grad(lambda *args: jnp.sum(jax.vmap(one)(*args).pose[:, -1]), argnums=(0, 1, 2)))(*args)
    assert all(np.isfinite(leaf).all() and np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(by))
    # with a surface for each grasp the square turns as with one shared surface: the surfaces differ by a scale only
    shared, own = (cases.grasp("float64", 4, steps=4, varied=varied) for varied in (False, True))
    assert (shared.case, own.case) == ("grasp_two_fingers", "grasp_surfaces")
    poses = [np.asarray(jax.jit(work.function)(*work.args)) for work in (shared, own)]
    np.testing.assert_allclose(*poses, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_grasps_begin_at_the_touch_and_end_where_the_square_fits():
    poses = grasps.random_poses(jax.random.key(2), 8, "float64")
    square = pj.Polygon.rectangle(reference_push.SIDE, reference_push.SIDE)
    for (x, y, theta), path in zip(np.asarray(poses), np.asarray(grasps.paths(poses, 3)), strict=True):
        opening = path[:, 3]
        away = np.array([[0, opening[0] / 2], [0, -opening[0] / 2]]) - [x, y]
        cos, sin = np.cos(theta), np.sin(theta)
        centers = away @ np.array([[cos, -sin], [sin, cos]])
        nearest = min(float(square.signed_distance(center)) for center in centers)
        assert nearest == pytest.approx(reference_push.RADIUS, abs=1e-12)
        assert opening[-1] == pytest.approx(grasps.STRAIGHT_OPENING + grasps.CLEARANCE)
        assert np.all(np.diff(opening) < 0)
    by_steps = grasps.errors("float64")
    assert by_steps[4] < reference_push.ALLOWED_MM < by_steps[3]
    assert by_steps[12] < by_steps[4] / 20  # the step in which the second finger touches limits the error from here on
    assert by_steps[64] < 5e-4
    turned = np.abs(grasps.reference()[:, 2])
    # If both fingers touch, the angle is geometry. If one finger arrives far before the other, it turns the square
    # more.
    assert turned.max() == pytest.approx(grasps.END_ANGLE, abs=1e-9)
    assert np.median(turned) == pytest.approx(grasps.END_ANGLE, abs=1e-9)


@pytest.mark.parametrize("where", ["side", "hull", "corner"])
def test_pushes_of_a_t_begin_at_the_touch(where):
    """The finger touches the T from outside, and then presses."""
    block = reference_push.t_block(hull=where == "hull")
    path, _ = cases.push_t("float64", 5, where).args
    first, second = (np.asarray(jax.vmap(block.signed_distance)(path[:, k])) for k in (0, 1))
    np.testing.assert_allclose(first, reference_push.RADIUS, atol=1e-12)
    assert second.max() < reference_push.RADIUS - 1e-3


def test_two_fingers_begin_at_the_touch():
    """Both fingers touch the side of the square that they push, and then press."""
    square = pj.Polygon.rectangle(reference_push.SIDE, reference_push.SIDE)
    path, _ = cases.push_two_fingers("float64", 5).args
    centers = grasps.hand("float64").poses(path)[:, :2, :, :2]
    first, second = np.moveaxis(jax.vmap(jax.vmap(jax.vmap(square.signed_distance)))(centers), 1, 0)
    np.testing.assert_allclose(first, reference_push.RADIUS, atol=1e-12)
    assert second.max() < reference_push.RADIUS - 1e-3


def test_a_jaw_begins_at_the_touch():
    """One pad touches the square, at a corner of either, and none overlaps it; at the end the jaw nearly holds it."""
    shapely = pytest.importorskip("shapely")
    hand, half = grasps.jaw("float64"), reference_push.SIDE / 2
    poses, path = cases.grasp_jaw("float64", 12).args
    # in the first of these a corner of the square touches the pad's face, in the second a corner of the pad the side
    more = jnp.array([[-0.005, 0.005, 0.4], [0.005, 0.005, 0.4]])
    openings = np.concatenate([path[:, 0, 3], grasps.touching_jaw(more)])
    corners = jnp.array([(-half, -half), (half, -half), (half, half), (-half, half)])
    for pose, opening in zip(np.concatenate([poses, more]), openings, strict=True):
        square = shapely.Polygon(pj.se2.transform(jnp.asarray(pose), corners))
        pads = [np.asarray(finger.shape.vertices) for finger in hand.fingers]
        placed = [pad + np.array([0, sign * opening / 2]) for pad, sign in zip(pads, (1, -1), strict=True)]
        assert min(square.distance(shapely.Polygon(pad)) for pad in placed) == pytest.approx(0, abs=1e-12)
        assert max(square.intersection(shapely.Polygon(pad)).area for pad in placed) < 1e-12
    np.testing.assert_allclose(path[:, -1, 3], reference_push.SIDE + grasps.CLEARANCE, atol=1e-12)


@pytest.mark.slow
def test_rows_of_fits_and_of_monte_carlo():
    """Cases that are not pushes have rows with the same names."""
    names = None
    for case, kind in (("fit", "float64"), ("monte_carlo", "float32")):
        record = speed.run((case,), (kind,), (64,))
        for row in record["rows"]:
            names = names or set(row)
            assert set(row) == names
            assert (row["dtype"], row["batch"]) == (kind, 64)
            assert row["run_s"] > 0
            assert row["compile_s"] >= 0
        assert record["rows"][0]["case"] in speed.summary(record)
    work = cases.monte_carlo("float32", 64)
    found = work.function(*work.args)
    assert found["n"] == 64
    assert found["modes"][0]["SEPARATED"] == 0  # the finger touches in every step


@pytest.mark.slow
def test_float32_beside_float64(monkeypatch):
    monkeypatch.setattr(numerics, "MODELS", ("quartic",))
    monkeypatch.setattr(numerics, "STEPS", (8,))
    monkeypatch.setattr(numerics, "CHUNK", 128)
    record = numerics.run(scale=0.002)
    assert len(record["rows"]) == 1
    for row in record["rows"]:
        assert row["pushes"] == 200
        assert row["failed_steps"] == 0
        assert row["same_bits_again"]
        assert 0 < row["median_mm"] < 1e-3
        assert row["mode_flips"] < 1e-2
    assert "same bits" in numerics.summary(record)
    with pytest.raises(ValueError, match="one push"):
        numerics.run(scale=1e-9)


def test_turns():
    """All programs run equally often, medians lie between quartiles, and the kernels compute what they claim."""
    calls = []
    timings = timing.alternate({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert set(timings) == {"a", "b"}
    for each in timings.values():
        assert each.low <= each.median <= each.high
    top = timing.ceiling("float32")
    values = np.asarray(top.multiply_add.run())
    assert values.dtype == np.float32
    assert np.isfinite(values).all()
    assert top.multiply_add.traffic.flops == pytest.approx(top.flops, rel=0.1)
    size = timing.sizes()
    copied = 2 * 4 * size.near * size.near_passes
    assert top.near.traffic.bytes == pytest.approx(copied, rel=0.01)
    np.testing.assert_allclose(np.asarray(top.near.run()), 1.000001**size.near_passes, rtol=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["contacts", "--contacts", "2", "9"], "contacts must be from 1 to 8; got 9"),
        (["push", "--batch", "0"], "batch must be positive; got 0"),
        (["push", "--cores", "0"], "--cores must be from 1 to"),
        (["sampling", "--peers"], "--peers is for push, grasp, fit, solve; got it with sampling"),
        (["push", "--baseline", "README.md"], "holds no record of python -m benchmarks"),
    ],
)
def test_wrong_options(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 1
    assert message in capsys.readouterr().err


def test_every_case_is_listed_with_a_line(capsys):
    main([])
    lines = capsys.readouterr().out.splitlines()
    assert lines == listing().splitlines()
    assert {"push", *MODULES} <= {line.split()[0] for line in lines}
    assert all(len(line.split()) > 2 for line in lines)


@pytest.mark.parametrize("case", ["", *MODULES])
def test_every_case_describes_its_options_and_writes_a_record(case, capsys):
    with pytest.raises(SystemExit) as end:
        main([*case.split(), "--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    assert "--json FILE" in text
    assert "--progress" not in text


@pytest.mark.slow
def test_only_new_shapes_are_compiled():
    """Only new shapes compile; new values of outline, path, friction, or more batches of `monte_carlo` do not."""
    here = reference_push.task("quartic", "float64")
    path = reference_push.paths(jnp.array([0.01]), jnp.array([0.1]), 6)[0]
    model = pj.FrictionModel(dof=20, friction=(0.15, 0.35))
    made = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, seconds, **more: made.append(event) if event.endswith("backend_compile_duration") else None
    )

    def other(scale):
        surface = pj.Quartic(scale * here.slider.surface.coefficients, here.slider.surface.length)
        slider = pj.Slider(pj.Polygon.rectangle(0.09 * scale, 0.09), surface)
        here._replace(slider=slider, pose=here.pose + 1e-4 * scale).push(path - 1e-3 * scale, 0.3 * scale)

    def slope(scale):
        """Take the gradient directly, not inside a `jit` of the user."""
        jax.grad(lambda mu: here.push(path * scale, mu).pose[-1, 2])(0.3 * scale)

    def grasp(scale):
        poses = scale * grasps.random_poses(jax.random.key(3), 1, "float64")
        hand = pj.Hand.two_fingers(reference_push.RADIUS * scale)
        pj.rollout(here.slider, hand, grasps.paths(poses, 2)[0], pose=poses[0], friction=0.1 * scale)

    def solved(scale):
        problem = random_contacts_problem(jax.random.key(5), contacts=1)
        pj.solve_contacts(pj.Quartic(scale * problem.surface.coefficients, problem.surface.length), problem.contacts)

    def many(n):
        pj.monte_carlo(jax.random.key(n), n, here.slider, here.hand, path, pose=here.pose, model=model, batch_size=64)

    def compiled_by(*calls):
        before = len(made)
        for call in calls:
            call()
        return len(made) - before

    calls = (other, slope, grasp, solved)
    assert all(compiled_by(lambda call=call: call(1.0)) > 0 for call in (*calls, lambda _: many(128)))
    assert [compiled_by(lambda call=call: call(1.01)) for call in calls] == [0] * len(calls)
    assert compiled_by(lambda: many(320), lambda: many(1000)) == 0


@pytest.mark.slow
def test_contacts(monkeypatch):
    """Judge two thousand problems of two contacts by the independent solver."""
    monkeypatch.setattr(contacts, "MODELS", {"quartic": 4})
    kept = []
    record = contacts.run(scale=0.0, contacts=(2,), starts=20, keep=lambda so_far: kept.append(len(so_far["rows"])))
    assert kept == [len(record["rows"])] == [1]
    for row in record["rows"]:
        assert row["problems"] == 2000
        assert row["wrong"] == row["not_converged"] == 0
        assert row["solved"] + row["jammed"] == 2000
        assert row["jammed"] > 100
        assert row["worst_violation"] < 1e-8
    assert "wrong" in contacts.summary(record)
