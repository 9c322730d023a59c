"""Loaders of published push logs. They use NumPy only and return SI units."""

from pushjax.datasets.data_folder import find_data as find_data
from pushjax.datasets.download import fetch_triangle as fetch_triangle
from pushjax.datasets.load import load_recordings as load_recordings
from pushjax.datasets.mit_folder import find_mit_pushes as find_mit_pushes
from pushjax.datasets.mit_folder import load_mit_folder as load_mit_folder
from pushjax.datasets.mit_names import PushParameters as PushParameters
from pushjax.datasets.mit_names import parse_push_name as parse_push_name
from pushjax.datasets.mit_pushes import MitPushes as MitPushes
from pushjax.datasets.mit_pushes import StraightPushes as StraightPushes
from pushjax.datasets.mit_pushes import load_mit_pushes_npz as load_mit_pushes_npz
from pushjax.datasets.mit_shapes import MIT_SHAPES as MIT_SHAPES
from pushjax.datasets.mit_shapes import MitShape as MitShape
from pushjax.datasets.mit_shapes import mit_shape as mit_shape
from pushjax.datasets.push_log import LogError as LogError
from pushjax.datasets.push_log import Onset as Onset
from pushjax.datasets.push_log import Push as Push
from pushjax.datasets.push_log import PushLog as PushLog
from pushjax.datasets.push_log import contact_onset as contact_onset
from pushjax.datasets.push_log import force_filter as force_filter
from pushjax.datasets.recordings import Recordings as Recordings
from pushjax.datasets.triangle import load_triangle_log as load_triangle_log
from pushjax.datasets.triangle_archive import load_push_npz as load_push_npz
from pushjax.datasets.two_finger import TwoFingerLog as TwoFingerLog
from pushjax.datasets.two_finger import load_two_finger_npz as load_two_finger_npz
from pushjax.datasets.two_finger_logs import load_two_finger_logs as load_two_finger_logs
