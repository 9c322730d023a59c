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
    "million_steps",
    *("docs", "overlaps", "invariance", "grasps", "random_contacts", "commands", "table1", "more_tasks", "rollout"),
    *("identify_logs", "identify", "derivatives", "bench", "push_t_episodes", "push_t", "fixtures", "gym", "search"),
    *("friction_model", "single_contact", "contact_derivatives", "several_contacts", "impact", "pusht_mpc"),
    *("smooth_shapes", "table", "monte_carlo", "continuing", "smooth_pads", "table2", "two_finger", "among_fixtures"),
)

BESIDE = Path(__file__).parents[2] / "shared" / "data"
if "PUSHJAX_DATA" not in os.environ and BESIDE.is_dir():
    os.environ["PUSHJAX_DATA"] = str(BESIDE)


def pytest_collection_modifyitems(items):
    order = {f"test_{name}": place for place, name in enumerate(LONG)}

    def place(item) -> int:
        notebook = item.path.suffix == ".ipynb"
        return order.get(item.path.stem, len(LONG) if notebook else len(LONG) + 1)

    items.sort(key=place)


class Marks:
    """Marks notebooks as slow. It is a plugin, because a conftest.py sees only its own folder."""

    def pytest_itemcollected(self, item):
        if item.path.suffix == ".ipynb":
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
