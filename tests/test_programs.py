"""Programs are compiled once, and traced while Python's garbage collector pauses."""

import gc

import jax.numpy as jnp
import pytest

from pushjax._programs import compiled, uncollected


@pytest.fixture
def collector():
    """On, with nothing put aside; afterwards as it was."""
    on, aside = gc.isenabled(), gc.get_freeze_count()
    gc.enable()
    gc.unfreeze()
    yield gc
    if aside:
        gc.freeze()
    if not on:
        gc.disable()


def test_the_collector_pauses_for_the_call_and_only_for_it(collector):
    seen = []
    assert uncollected(lambda x, *, y: seen.append(collector.isenabled()) or x + y)(1, y=2) == 3
    assert seen == [False]
    assert collector.isenabled()


def test_the_collector_is_on_again_after_an_error(collector):
    def fails():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        uncollected(fails)()
    assert collector.isenabled()


def test_a_collector_that_was_off_stays_off(collector):
    collector.disable()
    uncollected(lambda: None)()
    assert not collector.isenabled()
    # and what calls another program leaves it off for the rest of its own call
    collector.enable()
    after = []
    uncollected(lambda: (uncollected(lambda: None)(), after.append(collector.isenabled())))()
    assert after == [False]
    assert collector.isenabled()


def test_what_is_made_in_a_call_is_old_after_it(collector):
    kept = uncollected(lambda: [[k] for k in range(1000)])()
    assert sum(one is kept[0] for one in collector.get_objects(generation=2)) == 1
    assert collector.get_freeze_count() == 0


def test_what_was_put_aside_stays_aside(collector):
    collector.freeze()
    before = collector.get_freeze_count()
    uncollected(lambda: [[k] for k in range(1000)])()
    assert collector.get_freeze_count() == pytest.approx(before, abs=50)


def test_a_program_is_traced_once_for_all_values_of_arrays():
    traces = []

    @compiled
    def power(x, exponent):
        traces.append(exponent)
        return x**exponent

    assert float(power(jnp.asarray(3.0), 2)) == 9
    assert float(power(jnp.asarray(4.0), 2)) == 16
    assert float(power(jnp.asarray(2.0), 3)) == 8
    assert traces == [2, 3]
    assert power.__name__ == "power"
