"""Shapes of sliders, queries on their outlines, and rigid motions in the plane."""
