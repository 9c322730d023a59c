"""Squeezes in a row that make an unknown pose known."""
