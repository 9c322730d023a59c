"""Pushes that carry a slider without slip."""
