"""The examples in docstrings say what comes out."""

import doctest
import importlib
import pkgutil

import pytest

import pushjax as pj

FINDER = doctest.DocTestFinder(recurse=True)


def examples():
    """Of every module that can be imported without extras."""
    for module in pkgutil.walk_packages(pj.__path__, "pushjax."):
        if module.name.startswith(("pushjax.bench", "pushjax.experiments")):
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
    for room, name in (("rollout", "rollout"), ("solve.contacts", "solve_contacts"), ("hands", "line")):
        assert f"pushjax.{room}.{name}" in names
