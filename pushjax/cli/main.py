"""The command line: `pushjax demo`, `reproduce NAME`, `identify LOG…`, `plan --goal X Y THETA`, `data NAME`.

JAX is imported only once a command is known, so that `pushjax --help` and wrong words are answered at once.
"""

import os
import sys
import warnings
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NamedTuple

import tyro

from pushjax._internal.progress import progress_bar
from pushjax.cli.options import Output, parsed
from pushjax.experiments._cli_option import cli_option


class Command(NamedTuple):
    """A command that runs an experiment."""

    about: str
    module: str  # below `pushjax.experiments`; its `run` has the options of the command as arguments
    fixed: dict[str, Any] = {}  # noqa: RUF012  # arguments of `run` that the command fixes


COMMANDS = {
    "demo": Command("fits limit surfaces to a square, pushes it, and draws the result; 20 s", "demo"),
    "reproduce table1": Command("eleven objects pushed by a robot, against table I; 11 min on two cores", "table1"),
    "reproduce table2": Command("a triangle on three points pushed by a robot, against table II; 10 min", "table2"),
    "reproduce two-finger": Command("the triangle pushed by two fingers, against measurements; 90 s", "two_finger"),
    "reproduce stochastic-push": Command("a square pushed many times under random friction; 80 s", "stochastic_push"),
    "reproduce capture": Command("two fingers push a disk: from where they catch it; 70 s", "capture"),
    "reproduce squeeze": Command("a parallel jaw closes on a rectangle from four start poses; 70 s", "squeeze"),
    "reproduce jam": Command("two fingers that jam, and the friction from which they jam; 50 s", "jam"),
    "reproduce grasp-rectangle": Command("a jaw closes on a rectangle; 100 s", "grasps", {"slider": "rectangle"}),
    "reproduce grasp-butterfly": Command("a jaw closes on a butterfly; 200 s", "grasps", {"slider": "butterfly"}),
    "reproduce pusht-mpc": Command("PushT of the package gym-pusht, solved by a planner", "pusht_mpc"),
    "identify": Command("identifies friction, limit surface and calibration from LOG files; 1 min", "identify"),
    "plan": Command("plans pushes from pose to pose, as way points for a robot; 2 min", "plan"),
}
FETCH = "data triangle"
GROUPS = {"reproduce": "experiment", "data": "data set"}  # first words of commands of two, and what the second one is
HELP = {"-h", "--help"}
ABOUT = {name: command.about for name, command in COMMANDS.items()} | {FETCH: "fetches published logs of pushes, 34 MB"}
USAGE = f"""Quasi-static planar pushing: limit surfaces, frictional contact, pushes, grasps.

{chr(10).join(f"pushjax {name:27}{about}" for name, about in ABOUT.items())}

`pushjax COMMAND --help` lists the options of a command, and `pushjax --version` prints the version. Times are of one
processor core; most of it is spent to compile, which the next call need not do again."""


@dataclass
class Common(Output):
    """Options of each command that computes."""

    cache: bool = True
    """Keep compiled programs in the user's cache folder, or in JAX_COMPILATION_CACHE_DIR, for the next time."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line, by default with the arguments of the process."""
    try:
        _run(list(sys.argv[1:] if arguments is None else arguments))
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads the output any more, as after `pushjax --help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except (ValueError, OSError) as error:
        print(f"pushjax: {error}", file=sys.stderr)
        raise SystemExit(1) from None


def _run(given: list[str]) -> None:
    """Run the command that the arguments say."""
    if given == ["--version"]:
        from pushjax import __version__

        print(f"pushjax {__version__}")
        return
    name, options = split(given)
    if name == FETCH:
        tyro.cli(_fetch, args=options, prog=f"pushjax {name}")
    else:
        _compute(name.split()[-1], *parse(name, options))


def split(given: list[str]) -> tuple[str, list[str]]:
    """Return the command, of one word or two, and its options; end the process if there is no such command."""
    first = _known_word("command", given[:1], list(dict.fromkeys(name.split()[0] for name in ABOUT)))
    if first in ABOUT:
        return first, given[1:]
    seconds = [name.split()[1] for name in ABOUT if name.split()[0] == first]
    return f"{first} {_known_word(GROUPS[first], given[1:2], seconds)}", given[2:]


def _known_word(kind: str, given: list[str], known: list[str]) -> str:
    """Return the given word if it is known; else print a hint, or for an option or nothing the usage, and end."""
    word = given[0] if given else ""
    if word in known:
        return word
    helps = word in HELP
    if not word or word.startswith("-"):
        print(USAGE, file=sys.stdout if helps else sys.stderr)
    else:
        close = get_close_matches(word, known, 1)
        hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
        print(f"pushjax: no {kind} {word!r}; {hint}", file=sys.stderr)
    raise SystemExit(0 if helps else 2)


def parse(name: str, options: list[str]) -> tuple[ModuleType, partial[Any], Common]:
    """Return the module of a command, the call that the options ask for, and the options that all commands share."""
    with nullcontext() if HELP & set(options) else progress_bar("importing JAX"):
        import matplotlib

        matplotlib.use("Agg")  # draws to files, because there may be no screen
        experiment = import_module(f"pushjax.experiments.{COMMANDS[name].module}")
    fixed = COMMANDS[name].fixed
    return experiment, *parsed(experiment.run, options, f"pushjax {name}", experiment.__doc__, Common, **fixed)


def _compute(title: str, experiment: ModuleType, call: partial[Any], common: Common) -> None:
    """Run an experiment, print its summary, and write its record and page."""
    from pushjax.cli.page import write_page
    from pushjax.experiments._cell_cache import saved_cells_file
    from pushjax.experiments._record import write_json
    from pushjax.experiments._report import as_text

    if "folder" in call.keywords:
        call.keywords["folder"] = data_folder(call.keywords["folder"])
    _keep_compiled(common.cache)
    with progress_bar(f"computing {title}, and compiling what was not compiled before") as progress:
        callbacks = {"progress": progress, "say": progress.say, "note": progress.note}
        record = call(**{key: each for key, each in callbacks.items() if key in experiment.run.__annotations__})
    report = experiment.summary(record)
    print(as_text(report))
    for picture in record.get("pictures", ()):
        print(f"drew {picture}")
    json = common.json or common.out / f"{title}.json"
    write_json(record, json)
    if title != "demo":
        print(f"wrote {write_page(record, report, common.out / f'{title}.html')}")
    print(f"wrote {json}")
    saved_cells_file(title, common.out).unlink(missing_ok=True)  # of use only after an interruption


def _fetch(to: Annotated[Path | None, cli_option("FOLDER")] = None) -> None:
    """Fetch the authors' logs of the triangle, pushed by one finger and by two: 118 files of 34 MB in all.

    Args:
        to: Where to. Default: pushjax's data folder of this user, where `reproduce table2` and `two-finger` look.
    """
    from pushjax.datasets.download import fetch_triangle, triangle_files
    from pushjax.datasets.load import ENVIRONMENT_VARIABLE

    files = triangle_files()
    size = f"{sum(file.bytes for file in files) / 1e6:.0f} MB"
    with progress_bar(f"fetching {len(files)} files of {size}, without those that are there already") as progress:
        folder = fetch_triangle(to, progress=progress)
    print(f"the logs are in {folder}")
    elsewhere = os.environ.get(ENVIRONMENT_VARIABLE)
    if elsewhere and Path(elsewhere).resolve() != folder.resolve():
        print(f"{ENVIRONMENT_VARIABLE} names another folder, {elsewhere}: use these with --data {folder}")


def data_folder(given: Path | None) -> Path:
    """Return the folder of the recorded pushes: the given one, else the one that `find_data` finds."""
    if given is not None and not given.is_dir():
        raise ValueError(f"--data: there is no folder {given}")
    from pushjax.datasets.load import find_data

    folder = given or find_data()
    if folder is None:
        raise ValueError(
            "no recorded pushes found: give their folder with --data, set PUSHJAX_DATA, or `pushjax data triangle`"
        )
    return folder


def _keep_compiled(cache: bool) -> None:
    """Turn the cache of compiled programs on or off."""
    import jax

    from pushjax._internal.compilation_cache import enable_compilation_cache

    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    folder = enable_compilation_cache()
    show, printed = warnings.showwarning, []

    # the warning that programs cannot be cached is printed once, not for every program
    def show_once(message, *where, **more):
        if "persistent compilation cache" not in str(message):
            show(message, *where, **more)
        elif not printed:
            printed.append(message)
            print(
                f"pushjax: compiled programs cannot be kept in {folder} on this machine, and are compiled anew: "
                f"{message} (--no-cache does without)",
                file=sys.stderr,
            )

    warnings.showwarning = show_once


if __name__ == "__main__":
    main()
