"""Walls and fixed bodies from the option `--fixtures`."""

import math

import pushjax as pj
from pushjax.experiments._slider_options import parse_numbers, parse_shape
from pushjax.experiments.plan.options import FIXTURES, Options

OPTION = "--fixtures"


def parse_fixtures(options: Options) -> tuple[pj.Wall | pj.Fixture, ...]:
    """Return the walls and fixed bodies that the options describe."""
    return tuple(_parse_fixture(text, options.fixture_friction) for text in options.fixtures)


def _parse_fixture(text: str, friction: float) -> pj.Wall | pj.Fixture:
    kind, _, place = text.rpartition("@")
    x, y, angle = parse_numbers(OPTION, text, place, ",", 3, FIXTURES)
    if kind == "wall":
        return pj.Wall((x, y), (math.cos(angle), math.sin(angle)), friction=friction)
    shape = parse_shape(kind, OPTION)
    if isinstance(shape, pj.Ellipse):
        raise ValueError(f"{OPTION}: a body is a disk or a convex polygon; got {text!r}")
    return pj.Fixture(shape, (x, y, angle), friction=friction)
