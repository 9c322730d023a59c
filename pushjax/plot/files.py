"""From a picture to a file."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pushjax.plot.style import STYLE


def save(figure: Figure, path: Path | str) -> Path:
    """Write a figure in the format of the path's suffix (.png, .pdf, .svg, ...), making the folder, and close it."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with plt.rc_context(STYLE):  # ticks, and the resolution, are made only now
        figure.savefig(path, bbox_inches="tight")
    plt.close(figure)
    return path
