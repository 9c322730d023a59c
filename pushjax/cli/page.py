"""A record and its pictures as one self-contained HTML page, which needs no other files and no network."""

import base64
import html
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pushjax.experiments._record import to_builtin

FEW = 8  # the table shows the numbers of lists up to this length; longer ones (histograms …) are in the page's JSON

TEMPLATE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 1100px; margin: 2rem auto; padding: 0 1rem; }}
img {{ max-width: 100%; height: auto; display: block; margin: 1rem 0; }}
pre {{ background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 13px; line-height: 1.35; }}
table {{ border-collapse: collapse; font-size: 13px; }}
td {{ border-bottom: 1px solid #e4e4e4; padding: .15rem .9rem .15rem 0; vertical-align: top; }}
td + td {{ font-variant-numeric: tabular-nums; }}
summary {{ cursor: pointer; font-weight: 600; margin: .6rem 0; }}
</style>
</head>
<body>
<h1>{title}</h1>
<pre>{text}</pre>
{pictures}
{figures}
<details><summary>Settings, versions, machine</summary>{settings}</details>
<details><summary>Everything, as JSON</summary><pre id="record">{record}</pre></details>
</body>
</html>
"""

ABOUT = ("settings", "versions", "machine", "date")


def write_page(record: dict[str, Any], text: str, path: Path, figures: Sequence[tuple[str, str]] | None = None) -> Path:
    """Write a record, with its pictures embedded, as one HTML page, and return the page's path."""
    whole = json.loads(json.dumps(record, default=to_builtin))
    results = {name: value for name, value in whole.items() if name not in (*ABOUT, "pictures", "experiment")}
    pictures = "\n".join(_picture(Path(picture)) for picture in record.get("pictures", ()))
    if figures is None:  # the printed text has them in words, so the table of all entries by key is closed at first
        table = f"<details><summary>Figures by their keys in the JSON</summary>{_table(_leaves(results))}</details>"
    else:
        table = f"<details open><summary>Figures</summary>{_table(figures)}</details>"
    page = TEMPLATE.format(
        title=html.escape(f"pushjax: {record['experiment']}"),
        text=html.escape(text),
        pictures=pictures,
        figures=table,
        settings=_table(_leaves({name: whole[name] for name in ABOUT if name in whole})),
        record=html.escape(json.dumps(whole, indent=1)),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path


def _picture(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{html.escape(path.stem.replace("_", " "))}">'


def _table(rows: Iterable[tuple[str, str]]) -> str:
    cells = "".join(f"<tr><td>{html.escape(name)}</td><td>{html.escape(value)}</td></tr>" for name, value in rows)
    return f"<table>{cells}</table>"


def _leaves(tree: Any, name: str = ""):
    """Yield names and values as text; of a long list of numbers, only how many values it has."""
    if isinstance(tree, dict):
        for key, value in tree.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    elif isinstance(tree, list) and tree and isinstance(tree[0], dict):
        for k, value in enumerate(tree):
            yield from _leaves(value, f"{name}[{k}]")
    elif isinstance(tree, list) and (len(tree) > FEW or (tree and isinstance(tree[0], list))):
        yield name, f"{len(tree)} values"
    elif isinstance(tree, list):
        yield name, ", ".join(_brief(value) for value in tree)
    else:
        yield name, _brief(tree)


def _brief(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
