"""Transits of a round finger from one push to the next."""
