"""The command line: `pushjax demo`, `pushjax reproduce NAME`, `pushjax bench CASE`."""

import sys
from collections.abc import Callable
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
    squeeze: a parallel jaw closes on a rectangle from four start poses. jam: two fingers that jam, and from what
    friction. two-finger: the triangle pushed by two fingers, predicted against measured. three-finger: the original
    authors' simulated grasps, run again.
    """

    experiment: Annotated[Literal["table2", "squeeze", "jam", "two-finger", "three-finger"], tyro.conf.Positional] = (
        tyro.MISSING
    )
    """Which."""
    data: Path | None = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    geometry: Literal["nominal", "measured"] = "nominal"
    """table2: nominal, as in the paper; or measured, contact and the push's end as force sensor and robot command
    tell."""
    steps: int | None = None
    """Steps of each push or grasp. Default: the experiment's own."""


@dataclass
class Bench(Common):
    """Measure: how exact, how fast.

    contacts: random problems of one to eight contacts, every answer checked by an independent solver.
    """

    case: Annotated[Literal["contacts"], tyro.conf.Positional] = "contacts"
    """Which."""
    dtype: Literal["float32", "float64"] = "float64"
    """Floating type."""
    scale: float = 1.0
    """How many problems, of 100 000 for up to four contacts and 10 000 for more."""
    starts: int = 50
    """Starts of the independent solver on every problem that was called jammed."""
    contacts: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    """Of how many contacts."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)
Progress = Callable[[int, int], None]
Result = tuple[dict[str, Any], str]


def _demo(command: Demo, progress: Progress) -> Result:
    from pushjax.experiments import demo

    record = demo.run(command.seed, command.out)
    return record, demo.summary(record)


def _reproduce(command: Reproduce, progress: Progress) -> Result:
    from pushjax.experiments import jam, squeeze, table2, three_finger, two_finger

    for option, given, takes in (
        ("--geometry", command.geometry != "nominal", ("table2",)),
        ("--steps", command.steps is not None, ("table2", "squeeze", "two-finger", "three-finger")),
        ("--data", command.data is not None, ("table2", "two-finger", "three-finger")),
    ):
        if given and command.experiment not in takes:
            raise ValueError(f"{option} is for {', '.join(takes)}; got it with {command.experiment}")
    own: Any = {} if command.steps is None else {"steps": command.steps}
    if command.experiment == "jam":
        record = jam.run(command.seed, command.out)
        return record, jam.summary(record)
    if command.experiment == "squeeze":
        record = squeeze.run(command.seed, command.out, **own)
        return record, squeeze.summary(record)
    folder = command.data or find_data()
    if folder is None:
        raise ValueError("no recorded pushes found: give their folder with --data, or set PUSHJAX_DATA")
    if command.experiment == "table2":
        record = table2.run(folder, command.seed, command.out, command.geometry, progress=progress, **own)
        return record, table2.summary(record)
    if command.experiment == "two-finger":
        record = two_finger.run(folder, command.seed, command.out, progress=progress, **own)
        return record, two_finger.summary(record)
    record = three_finger.run(folder, command.seed, command.out, progress=progress, **own)
    return record, three_finger.summary(record)


def _bench(command: Bench, progress: Progress) -> Result:
    import jax

    from pushjax.experiments import bench_contacts
    from pushjax.report import write_json

    jax.config.update("jax_enable_x64", command.dtype == "float64")  # of this process, which is the command's own

    def keep(so_far: dict[str, Any]) -> None:
        if command.json is not None:
            write_json(so_far, command.json)

    scale, starts, contacts = command.scale, command.starts, command.contacts
    record = bench_contacts.run(command.seed, scale, starts, contacts, progress, keep)
    return record, bench_contacts.summary(record)


def main(arguments: list[str] | None = None) -> None:
    """Entry point. Bad input ends with one line on standard error and exit status 1."""
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        args=arguments,
        prog="pushjax",
        description="Quasi-static planar pushing: limit surfaces, frictional contact, pushes, grasps.",
    )
    import matplotlib

    matplotlib.use("Agg")  # draws to files; there may be no screen
    from rich.progress import Progress as Bar

    try:
        with Bar(transient=True) as bar:
            task = bar.add_task("working", total=None, visible=not isinstance(command, Demo))

            def progress(done: int, total: int) -> None:
                bar.update(task, completed=done, total=total)

            if isinstance(command, Reproduce):
                record, text = _reproduce(command, progress)
            elif isinstance(command, Bench):
                record, text = _bench(command, progress)
            else:
                record, text = _demo(command, progress)
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
