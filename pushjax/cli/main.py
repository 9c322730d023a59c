"""The command line: `pushjax demo`, `reproduce NAME`, `identify LOG…`, `plan --goal X Y THETA`, `data NAME`.

JAX is imported only once a command runs, so that `--help` and wrong options are answered at once.
"""

import os
import re
import sys
import warnings
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import tyro

from pushjax.cli.commands import (
    COMMAND_CLASSES,
    COMMANDS,
    DATA_SETS,
    EXPERIMENTS,
    Command,
    Common,
    Data,
    Demo,
    Reproduce,
)


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
    _check_words(given)
    _check_counts(given)
    command = parsed(given)
    if isinstance(command, Reproduce):
        command = command.experiment
    if isinstance(command, Data):
        _fetch(command)
    else:
        _compute(command)


def parsed(arguments: Sequence[str]) -> Any:
    """Return the command that the arguments say, one of the classes in `Command`."""
    return tyro.cli(
        Command,  # pyright: ignore[reportArgumentType]
        # a shell leaves the home folder in `--out=~/pushes` as it is
        args=[
            re.sub(r"^(--[\w-]+=)?~(?=/|$)", lambda begin: (begin[1] or "") + str(Path.home()), a) for a in arguments
        ],
        prog="pushjax",
        description="Quasi-static planar pushing: limit surfaces, frictional contact, pushes, grasps.\n\n"
        "`pushjax --version` prints the version.",
        config=(tyro.conf.OmitSubcommandPrefixes,),
    )


def _check_words(given: list[str]) -> None:
    """End with one line for commands, experiments and data sets that do not exist."""
    if given[:1] == ["bench"]:
        print("pushjax: benchmarks are in a clone of the repository: python -m benchmarks", file=sys.stderr)
        raise SystemExit(1)
    _check_word("command", given[:1], COMMANDS)
    if given[:1] == ["reproduce"]:
        _check_word("experiment", given[1:2], tuple(EXPERIMENTS))
    if given[:1] == ["data"]:
        _check_word("data set", given[1:2], DATA_SETS)


def _check_word(kind: str, given: list[str], known: Sequence[str]) -> None:
    """End with exit status 2 if a word is given that is no option and is not known."""
    if not given or given[0].startswith("-") or given[0] in known:
        return
    close = get_close_matches(given[0], known, 1)
    hint = f"did you mean {close[0]}?" if close else f"there are {', '.join(known)}"
    print(f"pushjax: no {kind} {given[0]!r}; {hint}", file=sys.stderr)
    raise SystemExit(2)


def _check_counts(given: list[str]) -> None:
    """End with exit status 2 if an option has fewer or more values than it takes."""
    # checked here, because tyro's own message lists every type of every value
    first, second = [*given[:2], "", ""][:2]
    kind = EXPERIMENTS.get(second) if first == "reproduce" else COMMAND_CLASSES.get(first)
    options = {} if kind is None else get_type_hints(kind, include_extras=True)
    for name, hint in options.items():
        flag, count = "--" + name.replace("_", "-"), _fixed_count(hint)
        if count is None or flag not in given:
            continue
        rest = given[given.index(flag) + 1 :]
        values = list(takewhile(lambda word: not word.startswith("--"), rest))
        if len(values) < count or (len(values) > count and first != "identify"):  # its logs may follow
            words = next((each.metavar for each in get_args(hint)[1:] if getattr(each, "metavar", None)), "")
            takes = f"{count} values{f' ({words})' if words else ''}"
            print(f"pushjax: {flag} takes {takes}; got {len(values)}: {' '.join(values)}", file=sys.stderr)
            raise SystemExit(2)


def _fixed_count(hint: Any) -> int | None:
    """Return how many values an option of this type takes, if it is a tuple of fixed length; else None."""
    kind = get_args(hint)[0] if get_origin(hint) is Annotated else hint
    tuples = [each for each in (kind, *get_args(kind)) if get_origin(each) is tuple]
    return next((len(get_args(each)) for each in tuples if Ellipsis not in get_args(each)), None)


def _compute(command: Common) -> None:
    """Run an experiment, print its summary, and write its record and page."""
    from pushjax._internal.progress import progress_bar

    command.check()
    settings = command.settings()
    if "data" in vars(command):
        settings["folder"] = data_folder(settings.pop("data", None))
    with progress_bar("importing JAX") as progress:
        import matplotlib

        matplotlib.use("Agg")  # draws to files, because there may be no screen
        _keep_compiled(command.cache)
        experiment: Any = import_module(f"pushjax.experiments.{command.module}")
        callbacks = {"progress": progress, "say": progress.say, "note": progress.note}
        settings |= {name: each for name, each in callbacks.items() if name in experiment.run.__annotations__}
        progress.say(f"computing {command.title}, and compiling what was not compiled before")
        record = experiment.run(seed=command.seed, out=command.out, **settings)
    text = experiment.summary(record)
    print(text)
    in_words = getattr(experiment, "figures", None)
    _write(record, text, command, None if in_words is None else in_words(record))


def _fetch(command: Data) -> None:
    """Fetch a set of recorded pushes."""
    from pushjax._internal.progress import progress_bar
    from pushjax.datasets.data_folder import ENVIRONMENT_VARIABLE
    from pushjax.datasets.download import fetch_triangle, triangle_files

    files = triangle_files()
    size = f"{sum(file.bytes for file in files) / 1e6:.0f} MB"
    with progress_bar(f"fetching {len(files)} files of {size}, without those that are there already") as progress:
        folder = fetch_triangle(command.to, progress=progress)
    print(f"the logs are in {folder}")
    elsewhere = os.environ.get(ENVIRONMENT_VARIABLE)
    if elsewhere and Path(elsewhere).resolve() != folder.resolve():
        print(f"{ENVIRONMENT_VARIABLE} names another folder, {elsewhere}: use these with --data {folder}")


def data_folder(given: Path | None) -> Path:
    """Return the folder of the recorded pushes: the given one, else the one that `find_data` finds."""
    if given is not None and not given.is_dir():
        raise ValueError(f"--data: there is no folder {given}")
    from pushjax.datasets.data_folder import find_data

    folder = given or find_data()
    if folder is None:
        raise ValueError(
            "no recorded pushes found: give their folder with --data, set PUSHJAX_DATA, or `pushjax data triangle`"
        )
    return folder


def _write(record: dict[str, Any], text: str, command: Common, figures: Any) -> None:
    """Write the record and, except for the demo, its page. Then delete what was saved in case of an interruption."""
    from pushjax.cli.page import write_page
    from pushjax.experiments._cell_cache import CellCache
    from pushjax.experiments._record import write_json

    json = command.json or command.out / f"{record['experiment']}.json"
    write_json(record, json)
    if not isinstance(command, Demo):
        print(f"wrote {write_page(record, text, command.out / (record['experiment'] + '.html'), figures)}")
    print(f"wrote {json}")
    CellCache.delete(record["experiment"], command.out)


def _keep_compiled(cache: bool) -> None:
    """Turn the cache of compiled programs on or off."""
    import jax

    from pushjax._internal.compilation_cache import enable_compilation_cache

    if not cache:
        jax.config.update("jax_enable_compilation_cache", False)
        return
    folder = enable_compilation_cache()
    show, told = warnings.showwarning, []

    # the warning that programs cannot be cached is printed once, not for every program
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


if __name__ == "__main__":
    main()
