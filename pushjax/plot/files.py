"""From a picture, still or moving, to a file."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pushjax.plot.motion import Animation
from pushjax.plot.style import STYLE


def save(picture: Figure | Animation, path: Path | str) -> Path:
    """Write a picture in the format of the path's suffix, make its folder, and close the figure.

    A figure: .png, .pdf, .svg and whatever else matplotlib knows. Motion: .gif; .html, a page with a player that needs
    nothing else, also offline; .mp4, which needs the program `ffmpeg`.

    Raises ValueError for a suffix that is none of these, RuntimeError for .mp4 where there is no `ffmpeg`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(picture, Animation):
        picture.write(path)
        plt.close(picture.figure)
        return path
    with plt.rc_context(STYLE):  # ticks, and the resolution, are made only now
        picture.savefig(path, bbox_inches="tight")
    plt.close(picture)
    return path
