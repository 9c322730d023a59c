"""The next push from where the slider is now, by a library of pushes."""
