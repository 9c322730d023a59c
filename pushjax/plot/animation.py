"""Animations, and how figures and animations are written to files."""

import base64
import html
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from string import Template

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.animation import FFMpegWriter
from matplotlib.figure import Figure
from PIL import Image

from pushjax.plot.style import STYLE

DPI = 100
LAST_FRAME_SECONDS = 1.2  # s, time that the last frame stays
# One palette of few colors for all frames makes a GIF a third as large as matplotlib's `PillowWriter` makes it.
PALETTE_COLORS, PALETTE_FRAMES = 64, 6  # number of its colors, and of the frames that it is taken from
PALETTE_ROUNDS = 3  # rounds of refining it: without them thin gray lines come out tinted


@dataclass(frozen=True)
class Animation:
    """A figure that is drawn anew for each frame and plays in a loop.

    `save` writes it to a file. A notebook shows it with its player.

    Attributes:
        figure: The figure.
        draw: `draw(k)` makes the figure show frame k.
        frames: Number of frames.
        seconds: Time that the frames play, s.
    """

    figure: Figure
    draw: Callable[[int], None]
    frames: int
    seconds: float

    def _repr_html_(self) -> str:
        """Show the player in a notebook."""
        return _player(self)


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
    with plt.rc_context(STYLE):  # ticks and resolution are set only now
        if isinstance(picture, Figure):
            picture.savefig(path, bbox_inches="tight")
        elif path.suffix.lower() in WRITERS:
            WRITERS[path.suffix.lower()](picture, path)
        else:
            raise ValueError(f"{path.name}: motion is written as {', '.join(WRITERS)}; got {path.suffix or 'none'}")
    plt.close(picture if isinstance(picture, Figure) else picture.figure)
    return path


def _write_gif(animation: Animation, path: Path) -> None:
    """Write a GIF that repeats forever."""
    first, *others = _images(animation)
    durations = [1e3 * animation.seconds / animation.frames] * len(others) + [1e3 * LAST_FRAME_SECONDS]
    first.save(path, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)


def _write_page(animation: Animation, path: Path) -> None:
    """Write a page with a player. That of matplotlib fetches the pictures on its buttons from the network."""
    head = f'<meta charset="utf-8"><title>{html.escape(path.stem)}</title>'
    path.write_text(f'<!doctype html>\n<html lang="en">{head}\n{_player(animation)}</html>\n', encoding="utf-8")


def _write_film(animation: Animation, path: Path) -> None:
    """Write an .mp4 with `ffmpeg`."""
    if not FFMpegWriter.isAvailable():
        raise RuntimeError(f"{path.name}: .mp4 needs the program ffmpeg; .gif and .html need nothing")
    rate = max(1, round(animation.frames / animation.seconds))
    writer = FFMpegWriter(fps=rate, extra_args=["-pix_fmt", "yuv420p"])  # a pixel format that every player shows
    with writer.saving(animation.figure, str(path), dpi=DPI):
        _freeze_layout(animation.figure)
        for k in [*range(animation.frames), *[animation.frames - 1] * round(LAST_FRAME_SECONDS * rate)]:
            animation.draw(k)
            writer.grab_frame()


WRITERS: dict[str, Callable[[Animation, Path], None]] = {".gif": _write_gif, ".html": _write_page, ".mp4": _write_film}


def _images(animation: Animation) -> list[Image.Image]:
    """Return every frame as an image, all with one palette."""
    drawn = []
    with plt.rc_context(STYLE):
        _freeze_layout(animation.figure)
        for k in range(animation.frames):
            animation.draw(k)
            buffer = io.BytesIO()
            animation.figure.savefig(buffer, format="png", dpi=DPI, pil_kwargs={"compress_level": 1})
            drawn.append(Image.open(buffer).convert("RGB"))
    sampled = np.linspace(0, animation.frames - 1, PALETTE_FRAMES).round().astype(int)
    sheet = Image.fromarray(np.concatenate([np.asarray(drawn[k]) for k in sampled]))
    # Maximum coverage, because most pixels are white: the most frequent colors would be shades of white.
    refined = {"method": Image.Quantize.MAXCOVERAGE, "kmeans": PALETTE_ROUNDS}
    palette = sheet.quantize(PALETTE_COLORS, dither=Image.Dither.NONE, **refined)
    return [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in drawn]


def _freeze_layout(figure: Figure) -> None:
    """Fix the layout, so that only the contents move."""
    for _ in range(4):  # each drawing improves the layout of panels of fixed aspect; it settles after a few
        figure.canvas.draw()
    figure.set_layout_engine("none")


def _player(animation: Animation) -> str:
    """Return a fragment of an HTML page that plays the animation, with everything in it."""
    encoded = []
    for image in _images(animation):
        buffer = io.BytesIO()
        image.save(buffer, "PNG", optimize=True)
        encoded.append(f'"{base64.b64encode(buffer.getvalue()).decode()}"')
    interval, pause = 1e3 * animation.seconds / animation.frames, 1e3 * LAST_FRAME_SECONDS
    return PLAYER.substitute(frames=",\n".join(encoded), last=len(encoded) - 1, interval=interval, pause=pause)


PLAYER = Template("""<figure style="display:inline-block;margin:0">
<img alt="animation" style="display:block;max-width:100%">
<button type="button">play / pause</button>
<input type="range" min="0" max="$last" value="0" style="width:60%" aria-label="frame">
<script>{
const frames = [
$frames
];
const figure = document.currentScript.parentElement;
const [image, button, range] = ["img", "button", "input"].map(tag => figure.querySelector(tag));
let timer = null;
const show = k => { range.value = k; image.src = "data:image/png;base64," + frames[k]; };
const wait = () => { timer = setTimeout(next, +range.value === $last ? $pause : $interval); };
const next = () => { show((+range.value + 1) % frames.length); wait(); };
const stop = () => { clearTimeout(timer); timer = null; };
button.onclick = () => timer === null ? wait() : stop();
range.oninput = () => { stop(); show(+range.value); };
show(0);
wait();
}</script>
</figure>
""")
