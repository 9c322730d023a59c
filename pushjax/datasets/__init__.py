"""Loaders of published push logs. Everything here is numpy, in SI units."""

from pushjax.datasets.folder import find_data as find_data
from pushjax.datasets.load import load_recordings as load_recordings
from pushjax.datasets.mit_pushes import MitPushes as MitPushes
from pushjax.datasets.mit_pushes import StraightPushes as StraightPushes
from pushjax.datasets.mit_pushes import load_mit_pushes_npz as load_mit_pushes_npz
from pushjax.datasets.pushes import LogError as LogError
from pushjax.datasets.pushes import Onset as Onset
from pushjax.datasets.pushes import Push as Push
from pushjax.datasets.pushes import PushLog as PushLog
from pushjax.datasets.pushes import contact_onset as contact_onset
from pushjax.datasets.pushes import force_filter as force_filter
from pushjax.datasets.recordings import Recordings as Recordings
from pushjax.datasets.tidy import load_push_npz as load_push_npz
from pushjax.datasets.triangle import load_triangle_log as load_triangle_log
