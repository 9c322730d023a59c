"""Loaders of published push logs and of your own. They use NumPy only and return SI units."""

from pushjax.datasets.download import fetch_triangle as fetch_triangle
from pushjax.datasets.load import find_data as find_data
from pushjax.datasets.load import load_recordings as load_recordings
from pushjax.datasets.mit_folder import load_mit_folder as load_mit_folder
from pushjax.datasets.recordings import LogError as LogError
from pushjax.datasets.recordings import Recording as Recording
from pushjax.datasets.recordings import Recordings as Recordings
from pushjax.datasets.triangle import load_triangle_log as load_triangle_log
from pushjax.datasets.two_finger_logs import load_two_finger_logs as load_two_finger_logs
