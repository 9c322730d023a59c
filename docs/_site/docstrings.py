"""Docstrings as the reference shows them; the sources stay as they are.

Classes whose arguments are their fields (equinox modules, named tuples, dataclasses) get a signature. Names in
backticks become links. Columns set out by spaces stay columns, examples become code.
"""

import re

import griffe

COLUMNS = re.compile(r"^\S+( \S+)* {3,}\S")
NAME = re.compile(r"(?<![\[`])`([A-Z]\w+|[a-z]+(?:_[a-z]+)+|rollout|step|identify|line|through|resample)`(?![\]`])")
ROOMS = ("identify", "monte_carlo", "random_rollout", "rollout")  # as in hooks.py
BASES = ("Module", "NamedTuple", "Shape", "LimitSurface", "RandomSurface", "ContactSolver", "StickingSolver", "Outline")


class Readable(griffe.Extension):
    def on_package(self, *, pkg, loader, **kwargs) -> None:
        public = {name for name, member in pkg.members.items() if member.is_alias and not name.startswith("_")}
        self._visit(pkg, public, set())

    def _visit(self, found: griffe.Object, public: set[str], seen: set[str]) -> None:
        if found.path in seen:
            return
        seen.add(found.path)
        if found.is_class:
            _signed(found)  # pyright: ignore[reportArgumentType]
        if found.docstring is not None:
            text = _linked(_named(found.docstring.value, _arguments(found)), public)
            found.docstring.value = _columns_kept(text)
        for member in found.members.values():
            if not member.is_alias:
                self._visit(member, public, seen)  # pyright: ignore[reportArgumentType]


def _linked(text: str, public: set[str]) -> str:
    def link(name: re.Match) -> str:
        room = f"{name[1]}." if name[1] in ROOMS else ""
        return f"[`{name[1]}`][pushjax.{room}{name[1]}]" if name[1] in public or room else name[0]

    return NAME.sub(link, text)


def _arguments(found: griffe.Object) -> set[str]:
    if found.is_class:
        return {name for name, member in found.members.items() if member.is_attribute} | _arguments_of(
            found.members.get("__init__")
        )
    return _arguments_of(found)


def _arguments_of(found: griffe.Object | griffe.Alias | None) -> set[str]:
    return {parameter.name for parameter in getattr(found, "parameters", [])}


def _named(text: str, arguments: set[str]) -> str:
    """What is said of arguments and fields begins with their names, which are set off."""

    def bold(found: re.Match) -> str:
        names = found[2].split(", ")
        return f"{found[1]}**{found[2]}:**" if set(names) <= arguments else found[0]

    return re.sub(r"(^|\n|[.;:] |\.\n)(\w+(?:, \w+)*):(?=\s)", bold, text)


def _columns_kept(text: str) -> str:
    """Paragraphs that are set out in columns, and examples, as blocks of code."""
    paragraphs = re.split(r"\n\s*\n", text)
    for k, paragraph in enumerate(paragraphs):
        lines = paragraph.split("\n")
        if lines[0].startswith(">>>"):
            paragraphs[k] = "\n".join(["```pycon", *lines, "```"])
        elif sum(bool(COLUMNS.match(line)) for line in lines) >= 2:
            paragraphs[k] = "\n".join("    " + line.replace("[`", "`").split("`][")[0] for line in lines)
    return "\n\n".join(paragraphs)


def _signed(found: griffe.Class) -> None:
    bases = [str(base).rpartition(".")[2] for base in found.bases]
    found.bases = [base for base, name in zip(found.bases, bases, strict=True) if name not in ("Module", "NamedTuple")]
    if "__init__" in found.members:
        return
    if not any(base in BASES for base in bases) and "dataclass" not in found.labels:
        return
    parameters = [griffe.Parameter("self", kind=griffe.ParameterKind.positional_or_keyword)]
    for name, member in found.members.items():
        annotation = str(getattr(member, "annotation", None) or "")
        if not isinstance(member, griffe.Attribute) or not annotation or re.search("Abstract|ClassVar", annotation):
            continue
        if "property" in member.labels:
            continue
        value = None if member.value is None else str(member.value)
        default = re.search(r"default=([^,)]+)", value) if value and "field(" in value else None
        shown = default[1] if default else None if value and "field(" in value else value
        parameters.append(
            griffe.Parameter(
                name, annotation=member.annotation, kind=griffe.ParameterKind.positional_or_keyword, default=shown
            )
        )
    if len(parameters) > 1:
        init = griffe.Function("__init__", parameters=griffe.Parameters(*parameters), lineno=found.lineno)
        found.set_member("__init__", init)
