"""The picture of the package's architecture, drawn from the imports. A room is a subpackage or module of `pushjax`.

    python docs/_site/architecture.py

writes docs/architecture.svg. An arrow goes from a room to one that imports it, unless other arrows already lead there
(the transitive reduction). Each room is drawn as low as possible, above everything that
imports it, and arrows pass beside the boxes of the rows between.
"""

import ast
from itertools import pairwise
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "pushjax"
PICTURE = ROOT / "docs" / "architecture.svg"
# In order of imports: a room imports only those before it.
ROOMS = (
    "_internal",
    "_math",
    "geometry",
    "metrics",
    "friction",
    "contact",
    "simulation",
    "datasets",
    "identification",
    "testing",
    "plot",
    "tasks",
    "planning",
    "experiments",
    "cli",
)
WIDTH, HEIGHT, ACROSS, DOWN, MARGIN = 124, 30, 150, 66, 16
POINT = 40  # room for an arrow that passes a row


def modules() -> dict[str, set[str]]:
    """Return, for each module of the package, the modules of the package that it imports, anywhere in its code."""
    # A name from `pushjax` itself, also as `pj.NAME`, is assigned to the module that defines it.
    public = {
        name.name: f"pushjax.{node.module}"
        for node in ast.parse((PACKAGE / "__init__.pyi").read_text()).body
        if isinstance(node, ast.ImportFrom)
        for name in node.names
    }
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        found[name] = _imported(ast.parse(path.read_text()), public) - {name}
    del found["pushjax"], found["pushjax.__main__"]
    return found


def _imported(tree: ast.AST, public: dict[str, str]) -> set[str]:
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            node.body.clear()  # for type checkers only: nothing is imported
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pj":
            found |= {public[node.attr]} if node.attr in public else set()
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "pushjax":
            found |= {_module(node.module, name.name, public) for name in node.names}
    return found - {"pushjax"}


def _module(source: str, name: str, public: dict[str, str]) -> str:
    """Return the module that `from source import name` imports from: `source`, or a module in it."""
    inside = ROOT.joinpath(*source.split("."), name)
    if inside.is_dir() or inside.with_suffix(".py").exists():
        return f"{source}.{name}"
    return public.get(name, source) if source == "pushjax" else source


def room(module: str) -> str:
    """Return the room of a module."""
    return module.split(".")[1]


def rooms(found: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return, for each room, the other rooms that it imports, from the imports of `modules`."""
    built: dict[str, set[str]] = {room(module): set() for module in found}
    for module, others in found.items():
        built[room(module)] |= {room(other) for other in others} - {room(module)}
    return built


def above(found: dict[str, set[str]], one: str, seen: tuple[str, ...] = ()) -> set[str]:
    """Return everything that a room or module imports, directly or not, or raise ValueError if there is a cycle."""
    if one in seen:
        raise ValueError(f"imports go round: {' → '.join((*seen[seen.index(one) :], one))}")
    return found[one].union(*(above(found, other, (*seen, one)) for other in found[one]))


def arrows(found: dict[str, set[str]]) -> list[tuple[str, str]]:
    """Return the arrows of the transitive reduction as pairs: the imported room and the room that imports it."""
    return [
        (other, one)
        for one, others in sorted(found.items())
        for other in sorted(others)
        if not any(other in above(found, between) for between in others if between != other)
    ]


def rows(found: dict[str, set[str]]) -> dict[str, int]:
    """Return the row of each room: as low as possible, above everything that is built on it."""
    above_it: dict[str, int] = {}
    for one in reversed(ROOMS):
        above_it[one] = min((above_it[other] for other in ROOMS if one in found[other]), default=0) - 1
    first = min(above_it.values())
    return {one: row - first for one, row in above_it.items()}


def ways(found: dict[str, set[str]], row: dict[str, int]) -> list[list[str]]:
    """Return the arrows, each with a point, named after it, in every row that it passes."""
    return [
        [below, *(f"{below}>{one}@{k}" for k in range(row[below] + 1, row[one])), one] for below, one in arrows(found)
    ]


def places(row: dict[str, int], paths: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return the middle of each box and of each point that an arrow passes."""
    # Within a row they are ordered by the mean place of what they are connected to in the rows above and below.
    at = dict(row) | {name: int(name.partition("@")[2]) for path in paths for name in path if "@" in name}
    levels: list[list[str]] = [[] for _ in range(1 + max(at.values()))]
    for name, k in at.items():
        levels[k].append(name)
    links = [pair for path in paths for pair in pairwise(path)]
    x = {name: float(k) for level in levels for k, name in enumerate(level)}
    for sweep in range(12):
        for level in levels if sweep % 2 else reversed(levels):
            near = {name: [x[a if b == name else b] for a, b in links if name in (a, b)] or [x[name]] for name in level}
            level.sort(key=lambda name: (sum(near[name]) / len(near[name]), name))
            widths = [POINT if "@" in name else ACROSS for name in level]
            left = -sum(widths) / 2
            for name, width in zip(level, widths, strict=True):
                x[name], left = left + width / 2, left + width
    leftmost = min(x.values())
    return {name: (MARGIN + WIDTH / 2 + x[name] - leftmost, MARGIN + HEIGHT / 2 + k * DOWN) for name, k in at.items()}


def _curve(points: list[tuple[float, float]]) -> str:
    """Return a path from the bottom of the first box, through the points between, to the top of the last."""
    parts = []
    for (xa, ya), (xb, yb) in pairwise(points):
        begin, end = ya + HEIGHT / 2, yb - HEIGHT / 2 - (3 if (xb, yb) == points[-1] else 0)
        half = (end - begin) / 2
        parts.append(f"{'L' if parts else 'M'}{xa:g},{begin:g}")
        parts.append(f"C{xa:g},{begin + half:g} {xb:g},{end - half:g} {xb:g},{end:g}")
    return f'<path d="{" ".join(parts)}"/>'


def picture() -> str:
    """Return the picture as SVG. Raise ValueError for a room that the list lacks, or has too much."""
    found = rooms(modules())
    if found.keys() != set(ROOMS):
        raise ValueError(f"not in the list of rooms, or no room: {', '.join(sorted(found.keys() ^ set(ROOMS)))}")
    row = rows(found)
    paths = ways(found, row)
    center = places(row, paths)
    wide, high = (max(at[axis] for at in center.values()) + MARGIN for axis in (0, 1))
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide + WIDTH / 2:g} {high + HEIGHT / 2:g}" '
        'font-family="sans-serif" font-size="13">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" fill="#777"/></marker></defs>',
        '<rect width="100%" height="100%" fill="white"/>',
        '<g fill="none" stroke="#777" stroke-width="1.2" marker-end="url(#tip)">',
        *(_curve([center[name] for name in path]) for path in paths),
        "</g>",
    ]
    for one in ROOMS:
        x, y = center[one]
        lines.append(
            f'<rect x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" fill="white" '
            f'stroke="#0072B2" stroke-width="2"/>'
            f'<text x="{x:g}" y="{y + 4.5:g}" text-anchor="middle" fill="#222">{one}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture())
    print(f"wrote {PICTURE}")
