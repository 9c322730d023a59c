"""Command line of the benchmarks.

`python -m benchmarks` lists the cases, and `python -m benchmarks CASE --help` lists the options of one.

Run it in a clone of the repository. For the comparison with other programs, install the extra `bench`.
"""

import ast
import runpy
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from benchmarks import speed
from pushjax._internal.cell_cache import CellCache
from pushjax._internal.options import cli_option
from pushjax._internal.progress_bar import progress_bar
from pushjax._internal.record import write_json
from pushjax.cli.main import data_folder

TimedCase = Literal[
    "push", "ellipsoid", "gradient", "grasp", "t", "hands", "solve", "sampling", "fit", "monte_carlo", "outline"
]
TIMED = {
    "push": "pushes of a square, 50 mm, in as few steps as 0.1 mm takes",
    "ellipsoid": "the same, with an ellipsoid for a limit surface",
    "gradient": "their derivatives by surface, path and friction",
    "grasp": "two fingers close on the square",
    "t": "pushes of a T, of its convex hull, and into an inner corner of the T",
    "hands": "pushes with two fingers side by side, and grasps of the square by a parallel jaw",
    "solve": "random contact problems, of one to eight contacts",
    "sampling": "random limit surfaces",
    "fit": "limit surfaces from 400 pairs",
    "monte_carlo": "pushes under random friction: a key in, a summary out",
    "outline": "pushes of polygons and of smooth shapes",
}
JUDGED = {
    "numerics": "float32 beside float64",
    "contacts": "every answer of random contact problems checked by an independent solver; an hour",
}
STUDIES = {
    "table1_causes": "where the error of the robot's pushes of table 1 comes from; eleven minutes",
    "table1_spread": "predicted distributions of them, beside a Gaussian process; two hours",
}
# Modules with their own options, each described by the first line of its docstring.
SCRIPTS = (
    "accuracy",
    "contact",
    "derivatives",
    "first_calls",
    "friction",
    "identification",
    "many_identifications",
    "million_pushes",
    "overlaps",
    "several_contacts",
)


@dataclass
class Timed:
    """Time the cases in turns with the machine's own ceilings."""

    case: Annotated[tuple[TimedCase, ...], tyro.conf.Positional] = get_args(TimedCase)
    """Which, of those that `python -m benchmarks` lists."""
    dtype: Annotated[tuple[Literal["float32", "float64"], ...], cli_option("{float32,float64} …")] = (
        "float32",
        "float64",
    )
    """Floating types. Default: both."""
    batch: Annotated[tuple[int, ...] | None, cli_option("N …")] = None
    """How many at once. Default: 2000; fit 200; monte_carlo 2000 and 100 000."""
    cores: Annotated[int | None, cli_option("N")] = None
    """How many of the machine's cores may be used (Linux). Times of one core need --cores 1. Default: all."""
    peers: bool = False
    """push, grasp, fit, solve: also by MuJoCo and MJX, cvxpy, scipy: pip install '.[bench]'."""
    baseline: Annotated[Path | None, cli_option("FILE")] = None
    """A JSON of this command: ends with an error if a row costs 1.5 times as many multiply-adds as it did there."""
    out: Path = Path("pushjax-out")
    """Folder for pictures."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure that is printed."""
    seed: int = 0
    """Seed of everything random."""


@dataclass
class Numerics:
    """Compare float32 with float64."""

    scale: Annotated[float, cli_option("SHARE")] = 1.0
    """How many problems, of 100 000."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure that is printed."""
    seed: int = 0
    """Seed of everything random."""


@dataclass
class Contacts(Numerics):
    """Check every answer to random contact problems by an independent solver."""

    scale: Annotated[float, cli_option("SHARE")] = 1.0
    """How many problems, of 100 000, or 10 000 for more than four contacts."""
    dtype: Literal["float32", "float64"] = "float64"
    """Floating type."""
    starts: Annotated[int, cli_option("N")] = 50
    """Starts of the independent solver on every problem that was called jammed."""
    contacts: Annotated[tuple[int, ...], cli_option("N …")] = tuple(range(1, 9))
    """Of how many contacts."""


@dataclass
class Study:
    """A study of the robot's pushes of table 1."""

    data: Annotated[Path | None, cli_option("FOLDER")] = None
    """Folder of the recorded pushes. Default: the environment variable PUSHJAX_DATA."""
    surface: Annotated[tuple[Literal["abs", "plywood", "delrin"], ...] | None, cli_option("{abs,plywood,delrin} …")] = (
        None
    )
    """Surfaces of the table. Default: abs, plywood."""
    object: Annotated[tuple[str, ...] | None, cli_option("OBJECT …")] = None
    """Objects of table 1. Default: all."""
    steps: Annotated[int | None, cli_option("N")] = None
    """Steps of each push. Default: the study's own."""
    out: Path = Path("pushjax-out")
    """Folder for pictures, and for what is known so far."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure that is printed. Default: NAME.json in --out."""
    seed: int = 0
    """Seed of everything random."""


Result = tuple[dict[str, Any], str]


def _timed(given: Timed, progress: Callable, keep: Callable) -> Result:
    """Return the record of the timed cases, and its text."""
    import jax

    jax.config.update("jax_enable_compilation_cache", False)  # so that programs are compiled, not loaded
    options = {name: getattr(given, name) for name in ("dtype", "batch", "cores", "peers", "baseline", "seed", "out")}
    record = speed.run(given.case, progress=progress, keep=keep, **options)
    return record, speed.summary(record)


def _numerics(given: Numerics, progress: Callable, keep: Callable) -> Result:
    """Return the record of `numerics`, and its text."""
    from benchmarks import numerics

    record = numerics.run(seed=given.seed, scale=given.scale, progress=progress)
    return record, numerics.summary(record)


def _contacts(given: Contacts, progress: Callable, keep: Callable) -> Result:
    """Return the record of `contacts`, and its text."""
    import jax

    from benchmarks import contacts

    jax.config.update("jax_enable_x64", given.dtype == "float64")
    record = contacts.run(given.seed, given.scale, given.starts, given.contacts, progress, keep)
    return record, contacts.summary(record)


def _study(name: str) -> Callable:
    """Return the function that gives the record of a study, and its text."""

    def run(given: Study, progress: Callable, keep: Callable) -> Result:
        study = import_module(f"benchmarks.robot.{name.removeprefix('table1_')}")
        chosen = {part: getattr(given, part) for part in ("surface", "object", "steps")}
        chosen = {part: value for part, value in chosen.items() if value is not None}
        record = study.run(data_folder(given.data), given.seed, given.out, progress=progress, **chosen)
        return record, study.summary(record)

    return run


def listing() -> str:
    """Return the list of cases, with one line on each."""
    rows = TIMED | JUDGED | STUDIES | {name: _first_line(name) for name in SCRIPTS}
    return "\n".join(f"{name:22}{line}" for name, line in rows.items())


def _first_line(script: str) -> str:
    """Return the first line of the docstring of a script, without its period."""
    source = Path(__file__).with_name(f"{script}.py").read_text()
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0].rstrip(".")


def main(arguments: list[str]) -> None:
    """Run the command line.

    Bad input ends with one line on standard error and exit status 1.

    Args:
        arguments: Arguments of the command, without the name of the program.
    """
    if not arguments:
        print(listing())
        return
    if arguments[0] in SCRIPTS:
        sys.argv = [arguments[0], *arguments[1:]]
        runpy.run_module(f"benchmarks.{arguments[0]}", run_name="__main__", alter_sys=True)
        return
    kinds: dict[str, tuple[type, Callable]] = {"numerics": (Numerics, _numerics), "contacts": (Contacts, _contacts)}
    kinds |= {name: (Study, _study(name)) for name in STUDIES}
    alone = arguments[0] in kinds
    kind, run = kinds.get(arguments[0], (Timed, _timed))
    given = tyro.cli(kind, args=arguments[alone:], prog="python -m benchmarks" + f" {arguments[0]}" * alone)

    def keep(so_far: dict[str, Any]) -> None:
        if given.json is not None:
            write_json(so_far, given.json)

    try:
        with progress_bar() as progress:
            record, text = run(given, progress, keep)
        print(text)
        if isinstance(given, Study) and given.json is None:
            given.json = given.out / f"{record['experiment']}.json"
        keep(record)
        if isinstance(given, Study):
            print(f"wrote {given.json}")
            CellCache.delete(record["experiment"], given.out)
        if isinstance(given, Timed) and record["slower"]:
            raise ValueError(f"slower than {given.baseline}: see above")
    except (ValueError, OSError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main(sys.argv[1:])
