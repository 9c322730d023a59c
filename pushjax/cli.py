"""The command line: `pushjax demo`, `pushjax reproduce NAME`."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pushjax.datasets import find_data


@dataclass
class Common:
    """Options of every command."""

    out: Path = Path("pushjax-out")
    """Folder for pictures."""
    json: Path | None = None
    """File for every figure the command prints."""
    seed: int = 0
    """Seed of everything random."""


@dataclass
class Demo(Common):
    """Fit an ellipsoid and a quartic to a square, push it with both, and draw the result."""


@dataclass
class Reproduce(Common):
    """Reproduce an experiment of the paper beside the paper's own figures.

    table2: a triangle on three support points, pushed by a robot; predicted against measured final poses.
    """

    experiment: Annotated[Literal["table2"], tyro.conf.Positional] = tyro.MISSING
    """Which."""
    data: Path | None = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    geometry: Literal["nominal", "measured"] = "nominal"
    """nominal: as in the paper. measured: contact and the push's end as force sensor and robot command tell."""
    steps: int = 100
    """Steps of each push."""


Command = Annotated[Demo, tyro.conf.subcommand("demo")] | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]


def _demo(command: Demo) -> tuple[dict[str, Any], str]:
    from pushjax.experiments import demo

    record = demo.run(command.seed, command.out)
    return record, demo.summary(record)


def _table2(command: Reproduce) -> tuple[dict[str, Any], str]:
    from rich.progress import Progress

    from pushjax.experiments import table2

    folder = command.data or find_data()
    if folder is None:
        raise ValueError("no recorded pushes found: give their folder with --data, or set PUSHJAX_DATA")
    with Progress(transient=True) as bar:
        task = bar.add_task("cells", total=None)

        def progress(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        record = table2.run(folder, command.seed, command.out, command.geometry, command.steps, progress)
    return record, table2.summary(record)


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Bad input ends with one line on standard error and exit status 1."""
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        args=arguments,
        prog="pushjax",
        description="Quasi-static planar pushing: limit surfaces, frictional contact, pushes.",
    )
    import matplotlib

    matplotlib.use("Agg")  # draws to files; there may be no screen
    try:
        record, text = _table2(command) if isinstance(command, Reproduce) else _demo(command)
        print(text)
        if command.json is not None:
            from pushjax.report import write_json

            write_json(record, command.json)
            print(f"wrote {command.json}")
    except (ValueError, OSError) as error:
        print(f"pushjax: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
