"""Vectors, small matrices, random matrices and root finding, shared by geometry, friction and contact."""
