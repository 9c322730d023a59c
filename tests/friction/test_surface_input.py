"""Files, convexity and bad input of limit surfaces."""

import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from surfaces import BATCH, one, surfaces

from pushjax import Ellipsoid, LimitSurface, Quartic
from pushjax.friction.quartic import CONVEXITY_TOLERANCE, MONOMIALS, least_curvature

DTYPES = [np.float32, np.float64]


# --- files ---


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", [2, 4])
def test_files_keep_every_bit(tmp_path, degree, dtype):
    surface = one(surfaces(degree, dtype))
    surface.save(tmp_path / "surface.json")
    for loaded in (LimitSurface.load(tmp_path / "surface.json"), type(surface).load(str(tmp_path / "surface.json"))):
        assert type(loaded) is type(surface)
        for a, b in zip(jax.tree.leaves(loaded), jax.tree.leaves(surface), strict=True):
            assert a.dtype == b.dtype == dtype
            assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_files_are_read_by_a_process_that_has_not_used_the_class(tmp_path):
    path = tmp_path / "surface.json"
    Ellipsoid(np.eye(3), 0.1).save(path)
    code = f"import pushjax as pj; print(type(pj.LimitSurface.load({str(path)!r})).__name__)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "Ellipsoid"


def test_wrong_files(tmp_path):
    path = tmp_path / "surface.json"
    Ellipsoid(np.eye(3), 0.1).save(path)
    record = json.loads(path.read_text())
    with pytest.raises(ValueError, match="holds a Ellipsoid, not a Quartic"):
        Quartic.load(path)
    damaged = {
        "empty": "",
        "no JSON": "{",
        "binary": b"\xff\xfe\x00",
        "a list": "[1, 2]",
        "a number": "7",
        "another format": json.dumps(record | {"format": "other"}),
        "another version": json.dumps(record | {"version": 2}),
        "another kind": json.dumps(record | {"kind": "sphere"}),
        "no A": json.dumps({k: v for k, v in record.items() if k != "A"}),
        "no dtype": json.dumps({k: v for k, v in record.items() if k != "dtype"}),
        "wrong dtype": json.dumps(record | {"dtype": "decimal"}),
        "text for A": json.dumps(record | {"A": "eye"}),
        "A too small": json.dumps(record | {"A": [[1, 0], [0, 1]]}),
        "indefinite": json.dumps(record | {"A": np.diag([1, 1, -1]).tolist()}),
        "no length": json.dumps(record | {"length": None}),
        "negative length": json.dumps(record | {"length": -1}),
    }
    for content in damaged.values():
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(ValueError, match=r"surface\.json is not a limit surface file"):
            LimitSurface.load(path)
    with pytest.raises(FileNotFoundError):
        LimitSurface.load(tmp_path / "none.json")


# --- convexity ---


def test_random_surfaces_are_convex():
    for degree in (2, 4):
        assert all(one(surfaces(degree), k).is_convex() for k in range(20))


def form_of(**coefficients: float) -> np.ndarray:
    """Return coefficients given by name: x4=1, x2y2=6, ..."""
    c = np.zeros(15)
    for name, value in coefficients.items():
        exponent = [int(name[name.index(v) + 1 :][:1] or 1) if v in name else 0 for v in "xyz"]
        (k,) = np.flatnonzero((MONOMIALS == exponent).all(axis=1))
        c[k] = value
    return c


def test_least_curvature():
    """x^4 + y^4 + a x^2 y^2 + z^4 is convex for 0 <= a <= 6: at 6, (x+y)^4 + (x-y)^4; its Hessian is then singular."""
    ball = form_of(x4=1, y4=1, z4=1, x2y2=2, x2z2=2, y2z2=2)  # |F|^4: eigenvalues 4, 4, 12
    assert least_curvature(ball) == pytest.approx(1 / 3, rel=1e-6)
    for scale in (1e-12, 1.0, 1e12):
        assert least_curvature(scale * ball) == pytest.approx(1 / 3, rel=1e-6)
    assert least_curvature(form_of(x4=1, y4=1, z4=1, x2y2=6)) == pytest.approx(0, abs=1e-12)
    # at x = y = 1/sqrt(2): 6 + 3 a and 6 - a; on an axis: 12 and 2 a
    assert least_curvature(form_of(x4=1, y4=1, z4=1, x2y2=7)) == pytest.approx(-1 / 27, rel=1e-3)
    assert least_curvature(form_of(x4=1, y4=1, z4=1, x2y2=-1)) == pytest.approx(-2 / 12, rel=1e-3)
    assert least_curvature(-ball) < -0.3


def test_least_curvature_finds_narrow_dips():
    """Against a fine sweep of the sphere followed by descent from its best points."""
    rng = np.random.default_rng(14)
    k = np.arange(10_000) + 0.5
    height, angle = 1 - 2 * k / len(k), np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - height**2)
    sphere = np.stack([ring * np.cos(angle), ring * np.sin(angle), height], axis=1)

    @jax.jit
    def lowest(c):
        hessian = jax.vmap(jax.hessian(lambda f: jnp.dot(c, jnp.prod(f[None] ** jnp.asarray(MONOMIALS), axis=1))))
        values = jnp.linalg.eigvalsh(hessian(sphere))
        return jnp.min(values) / jnp.max(jnp.abs(values))

    for _ in range(3):
        c = np.asarray(surfaces(4).coefficients)[rng.integers(BATCH)] + 0.02 * rng.normal(size=15)
        found, swept = least_curvature(c), float(lowest(c))
        assert found <= swept + 1e-3  # the sweep for the largest eigenvalue is coarser
        assert found >= swept - 2e-2  # the sweep misses no more than this between its points


def test_border_of_convexity():
    edge = form_of(x4=1, y4=1, z4=1, x2y2=6)
    assert Quartic(edge, 0.1).is_convex()
    assert Quartic(edge.astype(np.float32) / np.float32(3), np.float32(0.1)).is_convex()
    within, beyond = edge.copy(), edge.copy()
    within[9] += 5 * CONVEXITY_TOLERANCE
    beyond[9] += 30 * CONVEXITY_TOLERANCE  # the largest eigenvalue is 24
    assert Quartic(within, 0.1).is_convex()
    with pytest.raises(ValueError, match="coefficients are not those of a convex"):
        Quartic(beyond, 0.1)
    assert not _unchecked(beyond).is_convex()


def _unchecked(coefficients: np.ndarray) -> Quartic:
    return jax.jit(lambda c: Quartic(c, 0.1))(coefficients)


def test_is_convex_of_what_was_made_traced():
    assert not _unchecked(-np.ones(15)).is_convex()
    assert not jax.jit(lambda a: Ellipsoid(a, 0.1))(np.diag([1.0, 1, -1])).is_convex()


def test_fitted_surfaces_are_convex(data):
    """The published fits to real pushes load unchanged; some are on the boundary, up to roundoff of their solver."""
    files = sorted((data / "mit_push").glob("*.npz"))
    if not files:
        pytest.skip(f"{data / 'mit_push'} holds no fitted surfaces")
    for path in files:
        with np.load(path) as record:
            length = float(record["rho"])
            quartic = Quartic(record["ls_coeffs_poly4"], length)
            ellipsoid = Ellipsoid(record["ls_coeffs_quadratic"], length)
        assert quartic.is_convex()
        assert ellipsoid.is_convex()
        assert least_curvature(np.asarray(quartic.coefficients)) > -CONVEXITY_TOLERANCE


# --- input ---


def test_dtype_is_the_surface_s():
    for surface in (Ellipsoid(np.eye(3, dtype=np.float32), 0.1), Quartic(_BALL.astype(np.float32), 0.1)):
        assert surface.length.dtype == np.float32

        def every(surface, w):
            return surface.value(w), surface.twist(w), surface.hessian(w), surface.wrench(w), surface.on_level_set(w)

        found = jax.eval_shape(every, surface, np.ones(3))
        assert {leaf.dtype for leaf in found} == {np.dtype(np.float32)}
    assert Quartic(_BALL, np.float32(0.1)).length.dtype == np.float64


_BALL = form_of(x4=1, y4=1, z4=1, x2y2=2, x2z2=2, y2z2=2)
_SKEW = np.eye(3) + np.diag([0.1], 2)
BAD = {
    "A shape": (lambda: Ellipsoid(np.eye(2), 1), "A has shape"),
    "A NaN": (lambda: Ellipsoid(np.eye(3) * np.nan, 1), "A must be finite"),
    "A asymmetric": (lambda: Ellipsoid(_SKEW, 1), "A must be symmetric"),
    "A indefinite": (lambda: Ellipsoid(np.diag([1, 1, -1e-3]), 1), "A must be positive definite"),
    "A singular": (lambda: Ellipsoid(np.diag([1.0, 1, 0]), 1), "A must be positive definite"),
    "length zero": (lambda: Ellipsoid(np.eye(3), 0), "length must be positive"),
    "length negative": (lambda: Quartic(_BALL, -1), "length must be positive"),
    "length NaN": (lambda: Quartic(_BALL, np.nan), "length must be finite"),
    "length shape": (lambda: Quartic(_BALL, [1.0]), "length has shape"),
    "coefficients shape": (lambda: Quartic(_BALL[:14], 1), "coefficients has shape"),
    "coefficients NaN": (lambda: Quartic(_BALL * np.nan, 1), "coefficients must be finite"),
    "coefficients zero": (lambda: Quartic(np.zeros(15), 1), "coefficients are all zero"),
    "coefficients concave": (lambda: Quartic(-_BALL, 1), "coefficients are not those of a convex"),
    "value shape": (lambda: Quartic(_BALL, 1).value([1, 2]), "wrench has shape"),
    "value NaN": (lambda: Quartic(_BALL, 1).twist([1, 2, np.nan]), "wrench must be finite"),
    "level set shape": (lambda: Quartic(_BALL, 1).on_level_set([1, 2]), "wrench has shape"),
    "level set NaN": (lambda: Quartic(_BALL, 1).on_level_set([1, 2, np.nan]), "wrench must be finite"),
}


@pytest.mark.parametrize(("make", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_rounding_in_a_is_symmetrized():
    a = np.eye(3)
    a[0, 1] = 1e-6
    np.testing.assert_array_equal(Ellipsoid(a, 1).A, (a + a.T) / 2)
