"""The examples in docstrings give the stated results."""

import doctest
import importlib
import pkgutil

import pytest

import pushjax as pj

FINDER = doctest.DocTestFinder(recurse=True)


def examples():
    """Yield the examples of every module that can be imported without extras."""
    for module in pkgutil.walk_packages(pj.__path__, "pushjax."):
        if module.name.startswith(("pushjax.experiments", "pushjax.__main__")):
            continue
        yield from (test for test in FINDER.find(importlib.import_module(module.name)) if test.examples)


EXAMPLES = list(examples())


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name)
def test_example(example):
    result = doctest.DocTestRunner().run(example)
    assert result.attempted > 0
    assert result.failed == 0


def test_the_main_ways_in_have_examples():
    names = {example.name for example in EXAMPLES}
    for name in ("simulation.rollout.rollout", "contact.problem.solve_contacts", "simulation.path.line"):
        assert f"pushjax.{name}" in names
