"""Identify friction, limit surface, calibration and noise from recorded pushes, with uncertainty intervals."""
