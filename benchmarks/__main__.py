"""Command line of the benchmarks.

`python -m benchmarks` lists the cases, and `python -m benchmarks CASE --help` lists the options of one.

Run it in a clone of the repository. For the comparison with other programs, install the extra `bench`.
"""

import ast
import inspect
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, get_args

import tyro

from benchmarks import speed
from pushjax._internal.progress import ProgressCallback, no_progress, progress_bar
from pushjax.cli.options import Output, parsed
from pushjax.experiments._cli_option import cli_option
from pushjax.experiments._record import write_json

TimedCase = Literal[
    "push", "ellipsoid", "gradient", "grasp", "t", "hands", "solve", "sampling", "fit", "monte_carlo", "several"
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
    "several": "a finger pushes one to three sliders in a row",
}
# Modules of the other cases. Each has `run`, whose arguments are the options, and `summary`; the first line of its
# docstring is that of the list.
MODULES = (
    "accuracy",
    "contacts",
    "derivatives",
    "environments",
    "first_calls",
    "friction",
    "identification",
    "million_pushes",
    "numerics",
    "overlaps",
    "pusht",
    "sliders",
    "solvers",
)


def timed(
    case: Annotated[tuple[TimedCase, ...], tyro.conf.Positional] = get_args(TimedCase),
    dtype: Annotated[tuple[Literal["float32", "float64"], ...], cli_option("{float32,float64} …")] = (
        "float32",
        "float64",
    ),
    batch: Annotated[tuple[int, ...] | None, cli_option("N …")] = None,
    cores: Annotated[int | None, cli_option("N")] = None,
    peers: bool = False,
    baseline: Annotated[Path | None, cli_option("FILE")] = None,
    out: Path = Output.out,
    progress: ProgressCallback = no_progress,
    keep: Callable[[dict[str, Any]], None] = lambda record: None,
) -> dict[str, Any]:
    """Time the cases in turns with the machine's own ceilings.

    Args:
        case: Which, of those that `python -m benchmarks` lists.
        dtype: Floating types. Default: both.
        batch: How many at once. Default: 2000; fit 200; several 256; monte_carlo 2000 and 100 000.
        cores: How many of the machine's cores may be used (Linux). Times of one core need --cores 1. Default: all.
        peers: push, grasp, fit, solve: also by MuJoCo and MJX, cvxpy, scipy: pip install '.[bench]'.
        baseline: A JSON of this command: ends with an error if a row costs 1.5 times as many multiply-adds as it did
            there.
        out: Folder for pictures.
        progress: Called with the number of rows done and their total.
        keep: Called with the record so far.

    Returns:
        The record of `speed.run`.
    """
    import jax

    jax.config.update("jax_enable_compilation_cache", False)  # so that programs are compiled, not loaded
    return speed.run(case, dtype, batch, cores, peers, baseline, out, progress, keep)


def listing() -> str:
    """Return the list of cases, with one line on each."""
    rows = TIMED | {name: _first_line(name) for name in MODULES}
    return "\n".join(f"{name:22}{line}" for name, line in rows.items())


def _first_line(module: str) -> str:
    """Return the first line of the docstring of a module, without its period; the module is not imported."""
    source = Path(__file__).with_name(f"{module}.py").read_text()
    return (ast.get_docstring(ast.parse(source)) or "").split("\n")[0].rstrip(".")


def main(arguments: list[str]) -> None:
    """Run the command line; bad input ends with one line on standard error and exit status 1."""
    if not arguments:
        print(listing())
        return
    module: ModuleType = speed
    run, program, about = timed, "python -m benchmarks", None
    if arguments[0] in MODULES:
        module = import_module(f"benchmarks.{arguments[0]}")
        run, program, about = module.run, f"{program} {arguments[0]}", module.__doc__
        arguments = arguments[1:]
    case, written = parsed(run, arguments, program, about)

    def keep(so_far: dict[str, Any]) -> None:
        if written.json is not None:
            write_json(so_far, written.json)

    try:
        with progress_bar(f"running {program}") as progress:
            callbacks = {"progress": progress, "keep": keep}
            takes = inspect.signature(run).parameters
            record = case(**{name: each for name, each in callbacks.items() if name in takes})
        print(", ".join(f"{name} {value}" for name, value in (record["machine"] | record["versions"]).items()))
        print(module.summary(record))
        keep(record)
        if record.get("slower"):
            raise ValueError("slower than the baseline: see above")
    except (ValueError, OSError) as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main(sys.argv[1:])
