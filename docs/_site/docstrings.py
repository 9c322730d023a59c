"""A griffe extension that prepares docstrings for the reference. It does not change the sources.

Classes whose arguments are their fields (equinox modules, named tuples, dataclasses) get a signature. Names in
backticks become links. Columns aligned by spaces stay columns.
"""

import re

import griffe

COLUMNS = re.compile(r"^\S+( \S+)* {3,}\S")
NAME = re.compile(r"(?<![\[`])`([A-Z]\w+|[a-z]+(?:_[a-z]+)+|rollout|step|identify|line|through|resample)`(?![\]`])")
BASES = (
    "Module",
    "NamedTuple",
    "Shape",
    "LimitSurface",
    "SurfaceDistribution",
    "ContactSolver",
    "Exhaustive",
    "StickingSolver",
    "Outline",
)


class Readable(griffe.Extension):
    """Extension that visits every object of the package."""

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
            found.docstring.value = _columns_kept(_linked(found.docstring.value, public))
        for member in found.members.values():
            if not member.is_alias:
                self._visit(member, public, seen)  # pyright: ignore[reportArgumentType]


def _linked(text: str, public: set[str]) -> str:
    """Turn public names in backticks into links."""

    def link(name: re.Match) -> str:
        return f"[`{name[1]}`][pushjax.{name[1]}]" if name[1] in public else name[0]

    return NAME.sub(link, text)


def _columns_kept(text: str) -> str:
    """Turn paragraphs with aligned columns into blocks of code."""
    paragraphs = re.split(r"\n\s*\n", text)
    for k, paragraph in enumerate(paragraphs):
        lines = paragraph.split("\n")
        if sum(bool(COLUMNS.match(line)) for line in lines) >= 2:
            paragraphs[k] = "\n".join("    " + line.replace("[`", "`").split("`][")[0] for line in lines)
    return "\n\n".join(paragraphs)


def _signed(found: griffe.Class) -> None:
    """Give a class without its own `__init__` a signature made of its fields."""
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
