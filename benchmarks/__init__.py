"""Benchmarks of speed and accuracy. `python -m benchmarks` lists the cases."""
