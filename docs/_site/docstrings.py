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
    """Let griffe take a class whose arguments are its fields for a dataclass: then it has a signature."""
    bases = [str(base).rpartition(".")[2] for base in found.bases]
    found.bases = [base for base, name in zip(found.bases, bases, strict=True) if name not in ("Module", "NamedTuple")]
    fields = [member for member in found.members.values() if isinstance(member, griffe.Attribute) and member.annotation]
    for field in fields:
        if "Abstract" in str(field.annotation):
            field.labels.add("property")  # no argument
        if "field(" in str(field.value):
            default = re.search(r"default=([^,)]+)", str(field.value))
            field.value = default[1] if default else None
    if any(base in BASES for base in bases) and any("property" not in field.labels for field in fields):
        name = griffe.ExprName("dataclass", parent="dataclasses")  # pyright: ignore[reportArgumentType]
        found.decorators.append(griffe.Decorator(name, lineno=None, endlineno=None))
