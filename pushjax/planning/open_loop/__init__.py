"""Pushes in a row, planned before the first one starts."""
