"""A record and its pictures as one self-contained HTML page, which needs no other files and no network."""

import base64
import html
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from pushjax.experiments._record import as_plain
from pushjax.experiments._report import Table

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
th, td {{ text-align: left; border-bottom: 1px solid #e4e4e4; padding: .15rem .9rem .15rem 0; vertical-align: top; }}
td + td {{ font-variant-numeric: tabular-nums; }}
summary {{ cursor: pointer; font-weight: 600; margin: .6rem 0; }}
</style>
</head>
<body>
<h1>{title}</h1>
{report}
{pictures}
<details><summary>Settings, versions, machine</summary>{settings}</details>
<details><summary>Everything, as JSON</summary><pre id="record">{record}</pre></details>
</body>
</html>
"""

ABOUT = ("settings", "versions", "machine", "date")


def write_page(record: dict[str, Any], report: Sequence[str | Table], path: Path) -> Path:
    """Write a record, with its report and its pictures, as one HTML page, and return the page's path."""
    whole = as_plain(record)
    page = TEMPLATE.format(
        title=html.escape(f"pushjax: {record['experiment']}"),
        report="\n".join(
            _table(*part) if isinstance(part, Table) else f"<p>{html.escape(part)}</p>" for part in report
        ),
        pictures="\n".join(_picture(Path(picture)) for picture in record.get("pictures", ())),
        settings=_table((), list(_leaves({name: whole[name] for name in ABOUT if name in whole}))),
        record=html.escape(json.dumps(whole, indent=1)),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(page, encoding="utf-8")
    return path


def _picture(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img src="data:image/png;base64,{data}" alt="{html.escape(path.stem.replace("_", " "))}">'


def _table(heads: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [("th", heads), *(("td", row) for row in rows)]
    cells = ("".join(f"<{tag}>{html.escape(text)}</{tag}>" for text in texts) for tag, texts in lines)
    return f"<table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


def _leaves(tree: dict[str, Any], name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the names and the values of nested settings as text."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{name}{key}.")
        else:
            yield f"{name}{key}", ", ".join(map(str, value)) if isinstance(value, list) else str(value)
