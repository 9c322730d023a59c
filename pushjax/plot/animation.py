"""The class of all animations, and how it is written: as a GIF, as a page with a player, or as a film."""

import base64
import html
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from string import Template

import matplotlib.pyplot as plt
from matplotlib.animation import FFMpegWriter
from matplotlib.figure import Figure
from PIL import Image

from pushjax.plot.style import STYLE

DPI = 100
LAST_FRAME_SECONDS = 1.2  # s, time that the last frame stays
PALETTE_COLORS = 64  # number of colors of all frames together, small so that the files are small
PALETTE_ROUNDS = 3  # rounds of refining the palette: without them thin gray lines come out tinted
PALETTE_FRAMES = 6  # frames that the palette is taken from
SUFFIXES = (".gif", ".html", ".mp4")


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

    def pictures(self) -> list[Image.Image]:
        """Return every frame as an image, all with one palette."""
        with plt.rc_context(STYLE):
            self._freeze_layout()
            drawn = [self._frame_image(k) for k in range(self.frames)]
        width, height = drawn[0].size
        sampled = [drawn[round(k * (self.frames - 1) / (PALETTE_FRAMES - 1))] for k in range(PALETTE_FRAMES)]
        sheet = Image.new("RGB", (width, PALETTE_FRAMES * height))
        for k, each in enumerate(sampled):
            sheet.paste(each, (0, k * height))
        # Maximum coverage, because most pixels are white: the most frequent colors would be shades of white.
        palette = sheet.quantize(
            PALETTE_COLORS, Image.Quantize.MAXCOVERAGE, kmeans=PALETTE_ROUNDS, dither=Image.Dither.NONE
        )
        return [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in drawn]

    def _freeze_layout(self) -> None:
        """Fix the layout, so that only the contents move."""
        for _ in range(4):  # each drawing improves the layout of panels of fixed aspect; it settles after a few
            self.figure.canvas.draw()
        self.figure.set_layout_engine("none")

    def _frame_image(self, k: int) -> Image.Image:
        """Return frame k as an image."""
        self.draw(k)
        buffer = io.BytesIO()
        self.figure.savefig(buffer, format="png", dpi=DPI, pil_kwargs={"compress_level": 1})
        return Image.open(buffer).convert("RGB")

    def player(self) -> str:
        """Return a fragment of an HTML page that plays the animation, with everything in it."""
        encoded = []
        for picture in self.pictures():
            buffer = io.BytesIO()
            picture.save(buffer, "PNG", optimize=True)
            encoded.append(f'"{base64.b64encode(buffer.getvalue()).decode()}"')
        interval = 1e3 * self.seconds / self.frames
        return PLAYER.substitute(
            frames=",\n".join(encoded), last=self.frames - 1, interval=interval, last_interval=1e3 * LAST_FRAME_SECONDS
        )

    def _repr_html_(self) -> str:
        """Show the player in a notebook."""
        return self.player()

    def write(self, path: Path) -> None:
        """Write the animation as `save` does, into a folder that exists.

        Args:
            path: Path of the file, with the suffix .gif, .html or .mp4.

        Raises:
            ValueError: If the suffix is another one.
            RuntimeError: If there is no `ffmpeg` for an .mp4.
        """
        suffix = path.suffix.lower()
        if suffix == ".gif":
            first, *others = self.pictures()
            interval = 1e3 * self.seconds / self.frames
            durations = [interval] * len(others) + [1e3 * LAST_FRAME_SECONDS]
            first.save(path, save_all=True, append_images=others, duration=durations, loop=0, optimize=True)
        elif suffix == ".html":
            path.write_text(PAGE.substitute(title=html.escape(path.stem), player=self.player()), encoding="utf-8")
        elif suffix == ".mp4":
            self._write_film(path)
        else:
            raise ValueError(f"{path.name}: motion is written as {', '.join(SUFFIXES)}; got {path.suffix or 'none'}")

    def _write_film(self, path: Path) -> None:
        """Write an .mp4 with `ffmpeg`."""
        if not FFMpegWriter.isAvailable():
            raise RuntimeError(f"{path.name}: .mp4 needs the program ffmpeg; .gif and .html need nothing")
        rate = max(1, round(self.frames / self.seconds))
        writer = FFMpegWriter(fps=rate, extra_args=["-pix_fmt", "yuv420p"])  # a pixel format that every player shows
        with plt.rc_context(STYLE), writer.saving(self.figure, str(path), dpi=DPI):
            self._freeze_layout()
            for k in [*range(self.frames), *[self.frames - 1] * round(LAST_FRAME_SECONDS * rate)]:
                self.draw(k)
                writer.grab_frame()


PLAYER = Template("""<figure style="display:inline-block;margin:0;max-width:100%;font:14px sans-serif">
<img alt="animation" style="display:block;max-width:100%">
<div style="display:flex;gap:.6em;align-items:center">
<button type="button" style="min-width:5em">Pause</button>
<input type="range" min="0" max="$last" value="0" style="flex:1" aria-label="frame">
<output style="min-width:4em;text-align:right"></output>
</div>
<script>
(function () {
  const frames = [
$frames
  ].map(code => "data:image/png;base64," + code);
  const figure = document.currentScript.parentElement, last = frames.length - 1;
  const [image, button, range, count] = ["img", "button", "input", "output"].map(tag => figure.querySelector(tag));
  let timer = null;
  function show(k) { range.value = k; image.src = frames[k]; count.value = (k + 1) + " / " + frames.length; }
  function next() {
    const k = +range.value === last ? 0 : +range.value + 1;
    show(k);
    timer = setTimeout(next, k === last ? $last_interval : $interval);
  }
  function pause() { clearTimeout(timer); timer = null; button.textContent = "Play"; }
  function play() { button.textContent = "Pause"; timer = setTimeout(next, $interval); }
  button.onclick = () => timer === null ? play() : pause();
  range.oninput = () => { pause(); show(+range.value); };
  show(0);
  play();
})();
</script>
</figure>""")

PAGE = Template("""<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>$title</title>
$player
</html>
""")
