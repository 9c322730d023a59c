"""The picture of the rooms and what each is built on, from the imports themselves.

    python docs/_site/architecture.py

writes docs/architecture.svg. An arrow goes from a room to one that imports it, unless another way of arrows does so
too (the transitive reduction). Where boxes stand is said below; a room that is missing there is an error.
"""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
PICTURE = ROOT / "docs" / "architecture.svg"
# Column (from the left) and row (from the top) of each room, and what it is for.
GEOMETRY, FRICTION, CONTACT, PUSHES, LEARNING, SHELL = "#56B4E9", "#E69F00", "#009E73", "#0072B2", "#CC79A7", "#999999"
ROOMS = {
    "se2": (0, 3, GEOMETRY),
    "shapes": (1, 0, GEOMETRY),
    "status": (3, 0, CONTACT),
    "support": (0, 1, FRICTION),
    "limit_surface": (3, 1, FRICTION),
    "hands": (1, 1, GEOMETRY),
    "contacts": (1, 2, CONTACT),
    "solve": (2, 2, CONTACT),
    "table": (3, 2, FRICTION),
    "friction_model": (4, 2, FRICTION),
    "fit": (5, 2, FRICTION),
    "advance": (1, 3, PUSHES),
    "working_set": (2, 3, CONTACT),
    "substeps": (1, 4, PUSHES),
    "rollout": (2, 4, PUSHES),
    "random_rollout": (2.45, 5, PUSHES),
    "monte_carlo": (2.45, 6, PUSHES),
    "scores": (0, 4, LEARNING),
    "datasets": (0, 5, LEARNING),
    "identify": (1, 6, LEARNING),
    "plot": (1.55, 7.3, SHELL),
    "report": (4, 6, SHELL),
    "verify": (4, 4, CONTACT),
    "problems": (5, 4, CONTACT),
    "experiments": (3, 7.3, SHELL),
    "bench": (5, 7.3, SHELL),
    "page": (4, 8.3, SHELL),
    "cli": (5, 8.3, SHELL),
}
WIDTH, HEIGHT, ACROSS, DOWN, MARGIN = 124, 30, 158, 66, 16


def imports() -> dict[str, set[str]]:
    """Of each room, the rooms that it imports: those whose names begin with an underscore serve all, and are left out.

    A name taken from `pushjax` itself comes from the room that the package's own front door has it from.
    """
    package = ROOT / "pushjax"
    front = {
        name.asname: node.module.split(".")[1]
        for node in ast.parse((package / "__init__.py").read_text()).body
        if isinstance(node, ast.ImportFrom) and node.module and "." in node.module
        for name in node.names
    }
    found: dict[str, set[str]] = {}
    for path in sorted(package.rglob("*.py")):
        room = path.relative_to(package).with_suffix("").parts[0]
        if room.startswith("_"):
            continue
        source = path.read_text()
        names = {front[part] for part in _used(source) if part in front}
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "pushjax":
                parts = node.module.split(".")
                names |= {parts[1]} if len(parts) > 1 else {front.get(a.name, a.name) for a in node.names}
        found.setdefault(room, set()).update(n for n in names if n != room and not n.startswith("_"))
    return found


def _used(source: str) -> set[str]:
    """What a file takes from `pj`."""
    return {
        node.attr
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "pj"
    }


def above(found: dict[str, set[str]], room: str, seen: tuple[str, ...] = ()) -> set[str]:
    """All that a room is built on. Raises ValueError where it is built on itself."""
    if room in seen:
        raise ValueError(f"imports go round: {' → '.join((*seen, room))}")
    return found[room].union(*(above(found, other, (*seen, room)) for other in found[room]))


def arrows(found: dict[str, set[str]]) -> list[tuple[str, str]]:
    """(from, to) of the transitive reduction."""
    return [
        (other, room)
        for room, others in sorted(found.items())
        for other in sorted(others)
        if not any(other in above(found, between) for between in others if between != other)
    ]


def _center(room: str) -> tuple[float, float]:
    column, row, _ = ROOMS[room]
    return MARGIN + WIDTH / 2 + column * ACROSS, MARGIN + HEIGHT / 2 + row * DOWN


def _arrow(a: str, b: str) -> str:
    """From below a box; from its side, where the way is far across."""
    (x0, y0), (x1, y1) = _center(a), _center(b)
    side = (x1 > x0) - (x1 < x0)
    if abs(y1 - y0) < 1:
        return f'<path d="M{x0 + side * WIDTH / 2:g},{y0:g} L{x1 - side * (WIDTH / 2 + 3):g},{y1:g}"/>'
    y1 -= HEIGHT / 2 + 3
    if abs(x1 - x0) > 0.7 * ACROSS and y1 - y0 > 1.2 * DOWN:
        x0 += side * WIDTH / 2
        return f'<path d="M{x0:g},{y0:g} C{x0 + side * 34:g},{y0:g} {x1:g},{y1 - 70:g} {x1:g},{y1:g}"/>'
    y0 += HEIGHT / 2
    bend = min((y1 - y0) * 0.6, 50)
    return f'<path d="M{x0:g},{y0:g} C{x0:g},{y0 + bend:g} {x1:g},{y1 - bend:g} {x1:g},{y1:g}"/>'


def picture() -> str:
    found = imports()
    missing = sorted(found.keys() ^ ROOMS.keys())
    if missing:
        raise ValueError(f"no place, or no room: {', '.join(missing)}")
    wide = max(column for column, _, _ in ROOMS.values()) * ACROSS + WIDTH + 2 * MARGIN
    high = max(row for _, row, _ in ROOMS.values()) * DOWN + HEIGHT + 2 * MARGIN
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {wide:g} {high:g}" font-family="sans-serif" '
        'font-size="13">',
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0,0 L8,4 L0,8 z" fill="#777"/></marker></defs>',
        f'<rect width="{wide:g}" height="{high:g}" fill="white"/>',
        '<g fill="none" stroke="#777" stroke-width="1.2" marker-end="url(#tip)">',
        *(_arrow(a, b) for a, b in arrows(found)),
        "</g>",
    ]
    for room, (_, _, colour) in ROOMS.items():
        x, y = _center(room)
        lines.append(
            f'<rect x="{x - WIDTH / 2:g}" y="{y - HEIGHT / 2:g}" width="{WIDTH}" height="{HEIGHT}" rx="5" fill="white" '
            f'stroke="{colour}" stroke-width="2.5"/>'
            f'<text x="{x:g}" y="{y + 4.5:g}" text-anchor="middle" fill="#222">{room}</text>'
        )
    return "\n".join([*lines, "</svg>", ""])


if __name__ == "__main__":
    PICTURE.write_text(picture())
    print(f"wrote {PICTURE}")
