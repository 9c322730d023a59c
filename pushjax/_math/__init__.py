"""Vectors, small matrices and random matrices, shared by geometry, friction and contact."""
