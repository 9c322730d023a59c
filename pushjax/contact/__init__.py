"""Contact problems and their solvers: from contacts to the slider's motion."""
