"""The command line: `pushjax demo`, `pushjax reproduce NAME`, `pushjax identify LOG…`."""

import logging
import sys
import warnings
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from pushjax._internal.compilation_cache import enable_compilation_cache
from pushjax._internal.options import cli_option
from pushjax._internal.progress import ProgressCallback
from pushjax._internal.progress_bar import Reporter, progress_bar
from pushjax.datasets import find_data
from pushjax.experiments import identify_logs


@dataclass
class Common:
    """Options of every command."""

    out: Path = Path("pushjax-out")
    """Folder for pictures."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure the command prints. Default: NAME.json in --out."""
    seed: int = 0
    """Seed of everything random."""
    cache: bool = True
    """Keep compiled programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR, for the next time."""


@dataclass
class Demo(Common):
    """Fit an ellipsoid and a quartic to a square, push it with both, and draw the result."""


Experiment = Literal[
    "table1",
    "table2",
    "squeeze",
    "jam",
    "two-finger",
    "stochastic-push",
    "capture",
    "grasp-rectangle",
    "grasp-butterfly",
]


Method = Literal["ideal", "wrench_twist", "identified"]


@dataclass
class Reproduce(Common):
    """Reproduce an experiment of the paper and compare with the paper's own figures.

    - table1: eleven objects on two surfaces, pushed by a robot; predicted against measured final poses.
    - table2: a triangle on three support points, pushed by a robot.
    - two-finger: the triangle pushed by two fingers; predicted against measured poses.
    - squeeze: a parallel jaw closes on a rectangle from four start poses.
    - jam: two fingers that jam, and the friction from which they jam.
    - stochastic-push: a square pushed 2000 times under random friction.
    - capture: two fingers push a disk from anywhere.
    - grasp-rectangle, grasp-butterfly: a parallel jaw closes on the object from random poses.
    """

    experiment: Annotated[Experiment, tyro.conf.Positional] = tyro.MISSING
    """Which."""
    data: Annotated[Path | None, cli_option("FOLDER")] = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    geometry: Annotated[Literal["nominal", "measured"] | None, cli_option("{nominal,measured}")] = None
    """table2: nominal (the default), as in the paper; or measured, contact and the push's end as force sensor and robot
    command tell."""
    method: Annotated[tuple[Method, ...] | None, cli_option("{ideal,wrench_twist,identified} …")] = None
    """table1, table2: where the limit surface is from: the known support (table2 only), measured forces, or final
    poses. Default: all."""
    surface: Annotated[tuple[Literal["abs", "plywood", "delrin"], ...] | None, cli_option("{abs,plywood,delrin} …")] = (
        None
    )
    """table1: on what; delrin is in the published folders only. Default: abs, plywood."""
    object: Annotated[tuple[str, ...] | None, cli_option("OBJECT …")] = None
    """table1: which of rect1, rect2, rect3, tri1, tri2, tri3, ellip1, ellip2, ellip3, hex, butter.
    Default: all."""
    steps: Annotated[int | None, cli_option("N")] = None
    """Steps of each push or grasp. Default: the experiment's own."""
    n: Annotated[int | None, cli_option("N")] = None
    """Random experiments: how many pushes or grasps. Default: the paper's."""
    dof: Annotated[tuple[float, ...] | None, cli_option("DOF …")] = None
    """Random experiments: degrees of freedom of the limit surface's noise; capture: two, to compare."""
    friction: Annotated[tuple[float, ...] | None, cli_option("MU …")] = None
    """Random experiments: lowest and highest; capture: one or more to push with."""


@dataclass
class Identify(identify_logs.Options, Common):
    """Identify friction, limit surface and calibration from logs of pushes, with intervals, and write a report.

    Logs are CSV files with the columns push, hand_x, hand_y, object_x, object_y, object_theta (SI units, world frame;
    blank where the object was not seen), NPZ files with start, path, end, MIT pushing data (JSON, HDF5), or triangle
    logs (text).
    """

    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Files of recorded pushes."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Identify, tyro.conf.subcommand("identify")]
)
Result = tuple[dict[str, Any], str]


def _demo(command: Demo, progress: ProgressCallback) -> Result:
    from pushjax.experiments import demo

    record = demo.run(command.seed, command.out)
    return record, demo.summary(record)


RANDOM = ("n", "steps", "dof", "friction")
TAKES: dict[str, tuple[str, ...]] = {
    "table1": ("data", "method", "steps", "surface", "object"),
    "table2": ("data", "geometry", "method", "steps"),
    "squeeze": ("steps",),
    "jam": (),
    "two-finger": ("data", "steps"),
    "stochastic-push": RANDOM,
    "capture": RANDOM,
    "grasp-rectangle": RANDOM,
    "grasp-butterfly": RANDOM,
}


def _reproduce(command: Reproduce, progress: ProgressCallback) -> Result:
    name = command.experiment
    takes, given = TAKES[name], {}
    for each in ("data", "geometry", "method", "surface", "object", *RANDOM):
        value = getattr(command, each)
        if value is None:
            continue
        if each not in takes:
            others = ", ".join(other for other in TAKES if each in TAKES[other])
            raise ValueError(f"--{each} is for {others}; got it with {name}")
        given[each] = value
    if "dof" in given and name != "capture":
        if len(given["dof"]) != 1:
            raise ValueError(f"--dof: {name} takes one; got {len(given['dof'])}")
        given["dof"] = given["dof"][0]
    if "friction" in given and name != "capture" and len(given["friction"]) != 2:
        raise ValueError(f"--friction: {name} takes two, lowest and highest; got {len(given['friction'])}")
    if "data" in takes:
        given["folder"] = data_folder(given.pop("data", None))
    if name not in ("squeeze", "jam"):
        given["progress"] = progress
    experiment: Any
    if name.startswith("grasp-"):
        from pushjax.experiments import grasps as experiment

        given["slider"] = name.removeprefix("grasp-")
    else:
        experiment = import_module(f"pushjax.experiments.{name.replace('-', '_')}")
    record = experiment.run(seed=command.seed, out=command.out, **given)
    return record, experiment.summary(record)


def data_folder(given: Path | None) -> Path:
    """Return the folder of the recorded pushes: the given one, else the one that `find_data` finds.

    Raises:
        ValueError: If there is none.
    """
    folder = given or find_data()
    if folder is None:
        raise ValueError("no recorded pushes found: give their folder with --data, or set PUSHJAX_DATA")
    return folder


def _identify(command: Identify, progress: Reporter) -> Result:
    record = identify_logs.run(list(command.logs), command, command.seed, command.out, progress, progress.say)
    return record, identify_logs.summary(record)


def _write(record: dict[str, Any], text: str, command: Demo | Reproduce | Identify) -> None:
    """Write the record and, except for the demo, its page; then delete the cells that an interrupted run needs."""
    from pushjax._internal.cell_cache import CellCache
    from pushjax._internal.record import write_json
    from pushjax.cli.page import write_page

    json = command.json or command.out / f"{record['experiment']}.json"
    write_json(record, json)  # first, because it refuses what JSON cannot hold
    if not isinstance(command, Demo):
        print(f"wrote {write_page(record, text, command.out / (record['experiment'] + '.html'))}")
    print(f"wrote {json}")
    CellCache.delete(record["experiment"], command.out)


def _keep_compiled(cache: bool) -> None:
    """Turn the cache of compiled programs on or off.

    The warning that programs cannot be cached is printed once, not for every program.
    """
    import jax

    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    folder = enable_compilation_cache()
    # XLA's loader logs that two tuning flags of AVX-512 processors are unsupported, a line for every program, although
    # it then loads and runs the program (jax-ml/jax#38445). The levels of Python's loggers are restored.
    loggers = [(logger, logger.level) for logger in map(logging.getLogger, ("jax", "jaxlib"))]
    jax.config.update("jax_logging_level", "CRITICAL")
    for logger, level in loggers:
        logger.setLevel(level)
    show, told = warnings.showwarning, []

    def show_once(message, *where, **more):
        if "persistent compilation cache" not in str(message):
            show(message, *where, **more)
        elif not told:
            told.append(message)
            print(
                f"pushjax: compiled programs cannot be kept in {folder} on this machine, and are compiled anew: "
                f"{message} (--no-cache does without)",
                file=sys.stderr,
            )

    warnings.showwarning = show_once


def main(arguments: list[str] | None = None) -> None:
    """Run the command line.

    Invalid input ends with one line on standard error and exit status 1.

    Args:
        arguments: The command's arguments. Default: those of the process.
    """
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        from pushjax import __version__

        print(f"pushjax {__version__}")
        return
    if (sys.argv[1:] if arguments is None else arguments)[:1] == ["bench"]:
        print("pushjax: benchmarks are in a clone of the repository: python -m benchmarks", file=sys.stderr)
        raise SystemExit(1)
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        args=arguments,
        prog="pushjax",
        description="Quasi-static planar pushing: limit surfaces, frictional contact, pushes, grasps.\n\n"
        "`pushjax --version` tells which this is.",
    )
    import matplotlib

    matplotlib.use("Agg")  # draws to files, because there may be no screen

    _keep_compiled(command.cache)
    try:
        with progress_bar() as progress:
            if isinstance(command, Reproduce):
                record, text = _reproduce(command, progress)
            elif isinstance(command, Identify):
                record, text = _identify(command, progress)
            else:
                record, text = _demo(command, progress)
        print(text)
        _write(record, text, command)
    except (ValueError, OSError) as error:
        print(f"pushjax: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
