"""Shapes of sliders, queries on their outlines, and rigid motions in the plane."""

from pushjax.geometry import se2 as se2
