"""Friction between slider and table: support pressure, limit surfaces, their fits, and random friction."""
