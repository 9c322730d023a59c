"""Settings and fixtures of all tests: float64 is enabled (tests of float32 pass float32), and the folders of data.

Pytest's workers share a cache of compiled programs: JAX_COMPILATION_CACHE_DIR, or else a folder that lasts as long as
the run.
"""

import gc
import os
import sys
import tempfile
from pathlib import Path

from compiling import set_quick

set_quick()
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # workers and commands inherit it
    CACHE = tempfile.TemporaryDirectory(prefix="pushjax-tests-", ignore_cleanup_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = CACHE.name

import jax  # noqa: E402
import numpy as np  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)

from converted import converted  # noqa: E402, F401

from pushjax.datasets import find_data  # noqa: E402

# Tracing creates millions of objects that are soon deleted. A fifth of the time was spent in scans of the old ones.
gc.freeze()
gc.set_threshold(100_000, 50, 100)

# Each free worker takes the next file. The long files come first, so that none of them ends long after the others.
LONG = (
    "docs",
    "overlaps",
    "invariance",
    "table1",
    "random_contacts",
    "commands",
    "grasps",
    "bench",
    "push_t",
    "fixtures",
    "gym",
    "pusht_mpc",
    "identify_logs",
    "identify",
    "friction_model",
    "derivative_modes",
    "smooth_shapes",
    "table",
    "contact_derivatives",
    "single_contact",
    "several_contacts",
    "monte_carlo",
    "rollout",
    "continuing",
)

BESIDE = Path(__file__).parents[2] / "shared" / "data"
if "PUSHJAX_DATA" not in os.environ and BESIDE.is_dir():
    os.environ["PUSHJAX_DATA"] = str(BESIDE)


# Notebooks that compile programs of their own, which takes a minute each.
LONG_NOTEBOOKS = (
    "02_one_push",
    "03_several_contacts",
    "04_stochastic_pushing",
    "05_identifying_friction",
    "06_planning",
    "07_tasks",
    "08_plans",
)

SLOW_NOTEBOOK = "01_limit_surfaces"
# Cases of parametrized tests that are slow, by the test and what their names contain. Faster cases remain.
SLOW_CASES = {
    "test_conditions_hold_and_jams_have_no_motion": ("[4]",),
    "test_derivative_of_the_inverse_map": ("quartic",),
    "test_derivatives_match_central_differences": ("quartic",),
    "test_examples_run": ("contact.md", "identification.md"),
    "test_first_and_second_derivatives_of_the_distance": ("waisted",),
    "test_forces_at_the_contact_points_are_the_wrench": ("pad, L", "finger, T", "jaw"),
    "test_frictionless_fingers_jam_where_their_forces_balance_to_rounding": ("float32",),
    "test_laws_of_a_grasp": ("three fingers",),
    "test_meets_where_brute_force_does": ("butterfly",),
    "test_nothing_is_nan_in_degenerate_problems": ("[4]",),
    "test_one_contact_has_the_same_answer": ("[4]",),
    "test_random_experiments_draw_and_write_a_page": ("stochastic-push",),
    "test_random_problems": ("[8-", "[3-2"),
    "test_recorded_problems": ("[3-", "[4-", "2-ellipsoid"),
    "test_recorded_pushes": ("ellipsoid",),
    "test_samples_are_convex_around_their_mean": ("gram-float32",),
    "test_solvers_agree": ("quartic",),
}


def pytest_collection_modifyitems(items):
    order = {f"test_{name}": place for place, name in enumerate(LONG)}

    def place(item) -> int:
        notebook = item.path.suffix == ".ipynb"
        return order.get(item.path.stem, len(LONG) if notebook else len(LONG) + 1)

    items.sort(key=place)


class Marks:
    """Marks tests as long and slow. As a plugin, it sees the notebooks too."""

    def pytest_itemcollected(self, item):
        test, _, case = item.name.partition("[")
        if item.path.stem in LONG_NOTEBOOKS:
            item.add_marker("long")
        if item.path.stem == SLOW_NOTEBOOK or any(part in f"[{case}" for part in SLOW_CASES.get(test, ())):
            item.add_marker("slow")


def pytest_configure(config):
    config.pluginmanager.register(Marks())


@pytest.fixture(scope="module", autouse=True)
def _programs_end_with_their_module():
    """Drop compiled programs at the end of the module that runs them.

    Each program keeps several memory maps. A worker that keeps those of the whole suite reaches the kernel's limit,
    65 530 maps by default, and dies in the compiler.
    """
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def _figures_are_closed():
    yield
    pyplot = sys.modules.get("matplotlib.pyplot")
    if pyplot is not None:
        pyplot.close("all")


@pytest.fixture(scope="session")
def data():
    """Return the folder of real data."""
    folder = find_data()
    if folder is None:
        pytest.skip("no real data: set PUSHJAX_DATA to its folder")
    return folder


@pytest.fixture(scope="session")
def oracle(data):
    """Return the folder of contact problems with known answers, beside the data."""
    folder = data.parent / "oracle"
    if not folder.is_dir():
        pytest.skip(f"no recorded contact problems: {folder} does not exist")
    return folder


@pytest.fixture
def rng():
    return np.random.default_rng(0)
