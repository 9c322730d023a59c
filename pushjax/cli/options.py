"""Options of a command, from the signature and the docstring of the function that it calls."""

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeVar

import tyro

from pushjax.experiments._cli_option import cli_option

CALLBACKS = ("progress", "say", "note", "keep")  # arguments that the command line gives, not the user
DataFolder = Annotated[
    Path | None,
    tyro.conf.arg(
        name="data",
        metavar="FOLDER",
        help="Folder of the recorded pushes. Default: PUSHJAX_DATA, else what `pushjax data triangle` has fetched.",
        help_behavior_hint="",
    ),
]


@dataclass
class Output:
    """Where a command writes."""

    out: Path = Path("pushjax-out")
    """Folder for pictures and pages."""
    json: Annotated[Path | None, cli_option("FILE")] = None
    """File for every figure that is printed."""


OutputType = TypeVar("OutputType", bound=Output)


def parsed(
    run: Callable[..., Any],
    arguments: Sequence[str],
    program: str,
    about: str | None,
    output: type[OutputType] = Output,
    **fixed: Any,
) -> tuple[partial[Any], OutputType]:
    """Return `run` with `fixed` and the given options bound, and where to write; wrong options end the process."""
    signature = inspect.signature(run)
    own = [each for each in signature.parameters.values() if each.name not in (*CALLBACKS, "out", *fixed)]
    own = [_as_option(each) for each in own]
    common = inspect.Parameter("common", inspect.Parameter.KEYWORD_ONLY, annotation=output)

    def given(common: OutputType, **chosen: Any) -> tuple[partial[Any], OutputType]:
        out = {"out": common.out} if "out" in signature.parameters else {}
        return partial(run, **fixed, **out, **chosen), common

    given.__doc__ = run.__doc__
    given.__annotations__ = {each.name: each.annotation for each in (*own, common)}
    given.__dict__["__signature__"] = signature.replace(parameters=[*own, common])
    home = str(Path.home())  # a shell leaves it in `--out=~/pushes` as it is
    expanded = [re.sub(r"^(--[\w-]+=)?~(?=/|$)", lambda begin: (begin[1] or "") + home, each) for each in arguments]
    return tyro.cli(given, args=expanded, prog=program, description=about, config=(tyro.conf.OmitArgPrefixes,))


def _as_option(argument: inspect.Parameter) -> inspect.Parameter:
    """Return an argument of `run` as tyro is to see it."""
    if argument.name == "folder":
        return argument.replace(annotation=DataFolder, default=None)
    if is_dataclass(argument.annotation):  # its fields stand among the other options, without a heading of their own
        return argument.replace(annotation=Annotated[argument.annotation, tyro.conf.arg(name="")])
    return argument
