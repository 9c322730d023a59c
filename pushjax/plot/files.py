"""Write figures and animations to files."""

from pathlib import Path

import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from pushjax.plot.animation import Animation
from pushjax.plot.style import STYLE


def save(picture: Figure | Animation, path: Path | str) -> Path:
    """Write a figure or an animation in the format of the path's suffix, and close the figure.

    The folder of the file is made if needed. A figure can be written as .png, .pdf, .svg and everything else that
    matplotlib knows. An animation can be written as .gif; as .html, a page with a player that needs nothing else, also
    offline; or as .mp4, which needs the program `ffmpeg`.

    Args:
        picture: The figure or animation.
        path: Path of the file.

    Returns:
        The path of the file.

    Raises:
        ValueError: If the suffix is none of these.
        RuntimeError: If there is no `ffmpeg` for an .mp4.
    """
    path = Path(path).expanduser()
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(picture, Animation):
        picture.write(path)
        plt.close(picture.figure)
        return path
    with plt.rc_context(STYLE):  # ticks and resolution are set only now
        picture.savefig(path, bbox_inches="tight")
    plt.close(picture)
    return path
