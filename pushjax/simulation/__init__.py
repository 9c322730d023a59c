"""Simulation of pushes and grasps: hands, paths, contact detection, steps, rollouts, Monte Carlo runs."""
