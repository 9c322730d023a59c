"""Three-finger grasps of the authors' own simulator, again: `experiment` from `runs`, `law` and `causes`."""

from pushjax.experiments.three_finger.experiment import run as run
from pushjax.experiments.three_finger.experiment import summary as summary
