"""The command line: `pushjax demo`, `pushjax reproduce NAME`, `pushjax identify LOG…`, `pushjax bench CASE`."""

import logging
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from pushjax._internal.compilation_cache import enable_compilation_cache
from pushjax._options import option
from pushjax._progress import Reporter, progress_bar
from pushjax.datasets import find_data
from pushjax.experiments import identify_logs


@dataclass
class Common:
    """Options of every command."""

    out: Path = Path("pushjax-out")
    """Folder for pictures."""
    json: Annotated[Path | None, option("FILE")] = None
    """File for every figure the command prints. Default: NAME.json in --out; of bench, none."""
    seed: int = 0
    """Seed of everything random."""


@dataclass
class Cached(Common):
    """Options of commands that compile what they compiled before."""

    cache: bool = True
    """Keep compiled programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR, for the next time."""


@dataclass
class Demo(Cached):
    """Fit an ellipsoid and a quartic to a square, push it with both, and draw the result."""


Experiment = Literal[
    "table1",
    "table1-causes",
    "table1-spread",
    "table2",
    "squeeze",
    "jam",
    "two-finger",
    "three-finger",
    "stochastic-push",
    "capture",
    "grasp-rectangle",
    "grasp-butterfly",
]


Method = Literal["ideal", "wrench_twist", "identified"]


@dataclass
class Reproduce(Cached):
    """Reproduce an experiment of the paper beside the paper's own figures.

    - table1: eleven objects on two surfaces, pushed by a robot; predicted against measured final poses.
    - table1-causes: where its error comes from.
    - table1-spread: predicted distributions beside a Gaussian process.
    - table2: a triangle on three support points, pushed by a robot.
    - two-finger: the triangle pushed by two fingers, predicted against measured.
    - three-finger: the original authors' simulated grasps, run again.
    - squeeze: a parallel jaw closes on a rectangle from four start poses.
    - jam: two fingers that jam, and from what friction.
    - stochastic-push: a square pushed 2000 times under random friction.
    - capture: two fingers push a disc from anywhere.
    - grasp-rectangle, grasp-butterfly: a jaw closes on them from random poses.
    """

    experiment: Annotated[Experiment, tyro.conf.Positional] = tyro.MISSING
    """Which."""
    data: Annotated[Path | None, option("FOLDER")] = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    geometry: Annotated[Literal["nominal", "measured"] | None, option("{nominal,measured}")] = None
    """table2: nominal (the default), as in the paper; or measured, contact and the push's end as force sensor and robot
    command tell."""
    method: Annotated[tuple[Method, ...] | None, option("{ideal,wrench_twist,identified} …")] = None
    """table1, table2: where the limit surface is from: the known support (table2 only), measured forces, or final
    poses. Default: all."""
    surface: Annotated[tuple[Literal["abs", "plywood", "delrin"], ...] | None, option("{abs,plywood,delrin} …")] = None
    """table1 and its like: on what; delrin is in the published folders only. Default: abs, plywood."""
    object: Annotated[tuple[str, ...] | None, option("OBJECT …")] = None
    """table1 and its like: which of rect1, rect2, rect3, tri1, tri2, tri3, ellip1, ellip2, ellip3, hex, butter.
    Default: all."""
    steps: Annotated[int | None, option("N")] = None
    """Steps of each push or grasp. Default: the experiment's own."""
    n: Annotated[int | None, option("N")] = None
    """Random experiments: how many pushes or grasps. Default: the paper's."""
    dof: Annotated[tuple[float, ...] | None, option("DOF …")] = None
    """Random experiments: degrees of freedom of the limit surface's noise; capture: two, to compare."""
    friction: Annotated[tuple[float, ...] | None, option("MU …")] = None
    """Random experiments: lowest and highest; capture: one or more to push with."""


@dataclass
class Identify(identify_logs.Options, Cached):
    """Find friction, limit surface and calibration from logs of pushes, with intervals, and write a report.

    Logs are CSV with the columns push, hand_x, hand_y, object_x, object_y, object_theta (SI units, world; blank where
    the object was not seen), NPZ with start, path, end, MIT pushing data (JSON, HDF5), or triangle logs (text).
    """

    logs: Annotated[tuple[Path, ...], tyro.conf.Positional] = ()
    """Files of recorded pushes."""


TimedCase = Literal["push", "ellipsoid", "gradient", "grasp", "solve", "sampling", "fit", "monte_carlo", "outline"]
BenchCase = Literal[TimedCase, "numerics", "contacts"]


@dataclass
class Bench(Common):
    """Measure how exact and how fast: pushes, gradients, grasps, contact problems, random surfaces, fits.

    push, ellipsoid, gradient: of a square, 50 mm, in as few steps as 0.1 mm takes. grasp: two fingers close on it.
    solve: random contact problems, of one to eight contacts. sampling: random surfaces. fit: surfaces from 400 pairs.
    monte_carlo: a key in, a summary out. outline: pushes of polygons and of smooth shapes. numerics: float32 beside
    float64. contacts: every answer of random contact problems checked by an independent solver (alone; an hour).
    """

    case: Annotated[tuple[BenchCase, ...], tyro.conf.Positional] = ()
    """Which. Default: all but numerics and contacts."""
    dtype: Annotated[tuple[Literal["float32", "float64"], ...] | None, option("{float32,float64} …")] = None
    """Floating types. Default: both; contacts: float64."""
    batch: Annotated[tuple[int, ...] | None, option("N …")] = None
    """How many at once. Default: 2000; fit 200; monte_carlo 2000 and 100 000."""
    cores: Annotated[int | None, option("N")] = None
    """Of the machine's, how many may be used (Linux): of one, times are those of a core. Default: all."""
    devices: Annotated[int | None, option("N")] = None
    """push, ellipsoid: also with the batch over so many devices (of a CPU, host devices), against one."""
    peers: bool = False
    """push, grasp, fit, solve: the same by MuJoCo and MJX, cvxpy, scipy: pip install '.[bench]'."""
    baseline: Annotated[Path | None, option("FILE")] = None
    """A JSON of this command: ends with an error if a row costs 1.5 times as many multiply-adds as it did there."""
    scale: Annotated[float | None, option("SHARE")] = None
    """contacts, numerics: how many problems, of 100 000 (contacts: 10 000 for more than four)."""
    starts: Annotated[int | None, option("N")] = None
    """contacts: starts of the independent solver on every problem that was called jammed. Default: 50."""
    contacts: Annotated[tuple[int, ...] | None, option("N …")] = None
    """contacts: of how many. Default: one to eight."""


Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Reproduce, tyro.conf.subcommand("reproduce")]
    | Annotated[Identify, tyro.conf.subcommand("identify")]
    | Annotated[Bench, tyro.conf.subcommand("bench")]
)
Progress = Callable[[int, int], None]
Result = tuple[dict[str, Any], str]


def _demo(command: Demo, progress: Progress) -> Result:
    from pushjax.experiments import demo

    record = demo.run(command.seed, command.out)
    return record, demo.summary(record)


RANDOM = ("n", "steps", "dof", "friction")
TAKES: dict[str, tuple[str, ...]] = {
    "table1": ("data", "method", "steps", "surface", "object"),
    "table1-causes": ("data", "steps", "surface", "object"),
    "table1-spread": ("data", "steps", "surface", "object"),
    "table2": ("data", "geometry", "method", "steps"),
    "squeeze": ("steps",),
    "jam": (),
    "two-finger": ("data", "steps"),
    "three-finger": ("data", "steps"),
    "stochastic-push": RANDOM,
    "capture": RANDOM,
    "grasp-rectangle": RANDOM,
    "grasp-butterfly": RANDOM,
}

# Experiments that share a room with another.
INSIDE = {"table1-causes": "table1.causes", "table1-spread": "table1.spread"}


def _reproduce(command: Reproduce, progress: Progress) -> Result:
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
        folder = given.pop("data", None) or find_data()
        if folder is None:
            raise ValueError("no recorded pushes found: give their folder with --data, or set PUSHJAX_DATA")
        given["folder"] = folder
    if name not in ("squeeze", "jam"):
        given["progress"] = progress
    experiment: Any
    if name.startswith("grasp-"):
        from pushjax.experiments import grasps as experiment

        given["slider"] = name.removeprefix("grasp-")
    else:
        experiment = import_module(f"pushjax.experiments.{INSIDE.get(name, name.replace('-', '_'))}")
    record = experiment.run(seed=command.seed, out=command.out, **given)
    text = experiment.summary(record)
    from pushjax.page import write_page

    return record, f"{text}\nwrote {write_page(record, text, command.out / f'{name}.html')}"


def _identify(command: Identify, progress: Reporter) -> Result:
    from pushjax.page import write_page

    record = identify_logs.run(list(command.logs), command, command.seed, command.out, progress, progress.say)
    text = identify_logs.summary(record)
    return record, f"{text}\nwrote {write_page(record, text, command.out / 'identify.html')}"


BENCH_TAKES = {
    "contacts": {"dtype", "scale", "starts", "contacts"},
    "numerics": {"scale"},
    ", ".join(get_args(TimedCase)): {"dtype", "batch", "cores", "devices", "peers", "baseline"},
}


def _bench(command: Bench, progress: Progress) -> Result:
    from pushjax.report import write_json

    alone = [name for name in ("contacts", "numerics") if name in command.case]
    if alone and len(command.case) > 1:
        raise ValueError(f"{alone[0]} is measured alone; got {' '.join(command.case)}")
    *_, timed = BENCH_TAKES
    kind = alone[0] if alone else timed
    given = {name: getattr(command, name) for name in BENCH_TAKES["contacts"] | BENCH_TAKES[timed]}
    given = {name: value for name, value in given.items() if value is not None and value is not False}
    for name in given:
        if name not in BENCH_TAKES[kind]:
            others = ", ".join(other for other, takes in BENCH_TAKES.items() if name in takes)
            raise ValueError(f"--{name} is for {others}; got it with {' '.join(command.case) or 'no case'}")

    def keep(so_far: dict[str, Any]) -> None:
        if command.json is not None:
            write_json(so_far, command.json)

    if kind == "contacts":
        return _bench_contacts(command.seed, given, progress, keep)
    if kind == "numerics":
        from pushjax.bench import numerics

        record = numerics.run(seed=command.seed, progress=progress, **given)
        return record, numerics.summary(record)
    import jax

    from pushjax.bench import run as bench

    jax.config.update("jax_enable_compilation_cache", False)  # what is timed is compiling, not loading
    if command.case:
        given["case"] = command.case
    record = bench.run(seed=command.seed, out=command.out, progress=progress, keep=keep, **given)
    return record, bench.summary(record)


def _bench_contacts(seed: int, given: dict[str, Any], progress: Progress, keep: Callable) -> Result:
    import jax

    from pushjax.bench import contacts

    dtypes = given.pop("dtype", ("float64",))
    if len(dtypes) != 1:
        raise ValueError(f"--dtype: contacts takes one; got {len(dtypes)}")
    jax.config.update("jax_enable_x64", dtypes[0] == "float64")  # of this process, which is the command's own
    record = contacts.run(seed, progress=progress, keep=keep, **given)
    return record, contacts.summary(record)


def _keep_compiled(cache: bool) -> None:
    """Turns the cache of compiled programs on or off. What it cannot do is said once, not for every program."""
    import jax

    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    folder = enable_compilation_cache()
    # XLA's loader calls two tuning flags of AVX-512 processors unsupported, in a line for every program that it then
    # loads and runs (jax-ml/jax#38445). Python's loggers stay as they are.
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
    """Entry point. Bad input ends with one line on standard error and exit status 1."""
    if (sys.argv[1:] if arguments is None else arguments) == ["--version"]:
        from pushjax import __version__

        print(f"pushjax {__version__}")
        return
    command = tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        args=arguments,
        prog="pushjax",
        description="Quasi-static planar pushing: limit surfaces, frictional contact, pushes, grasps.\n\n"
        "`pushjax --version` tells which this is.",
    )
    import matplotlib

    matplotlib.use("Agg")  # draws to files; there may be no screen

    if isinstance(command, Cached):
        _keep_compiled(command.cache)
    try:
        with progress_bar() as progress:
            if isinstance(command, Reproduce):
                record, text = _reproduce(command, progress)
            elif isinstance(command, Identify):
                record, text = _identify(command, progress)
            elif isinstance(command, Bench):
                record, text = _bench(command, progress)
            else:
                record, text = _demo(command, progress)
        print(text)
        json = command.json
        if json is None and not isinstance(command, Bench):
            json = command.out / f"{record['experiment']}.json"
        if json is not None:
            from pushjax.report import write_json

            write_json(record, json)
            print(f"wrote {json}")
        if record.get("slower"):
            raise ValueError(f"slower than {command.baseline}: see above")  # pyright: ignore[reportAttributeAccessIssue]
    except (ValueError, OSError) as error:
        print(f"pushjax: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
