"""What mkdocs does beside its plugins: formulas, links to the reference, the notebooks.

Formulas become MathML when the site is built, which browsers draw by themselves: no script, and nothing to fetch.
`pj.X` and `pushjax.a.X` in a page's text become links to the reference wherever it has them. Notebooks lie beside
docs/, not in it; those that are there are taken into the site as they are, outputs included.
"""

import html
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
NOTEBOOKS = ROOT / "notebooks"
FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
# In notebooks formulas are left as they were written. What is in <pre> or <code> is no formula.
WRITTEN = re.compile(
    r"(?P<keep><(pre|code|script|style)\b.*?</\2>)|\$\$(?P<block>.+?)\$\$|(?<![\\\w$])\$(?P<line>[^$<>\n]+?)\$(?![\d$])",
    re.DOTALL,
)
FENCE = re.compile(r"^\s*(```|~~~)")
# Functions that share their name with the room they are in: `pushjax.rollout` is the function.
ROOMS = ("identify", "monte_carlo", "random_rollout", "rollout")
NAME = re.compile(r"(?<![\[`])`(?:pj|pushjax)\.([A-Za-z_][\w.]*)(\([^`]*\))?`(?![\]`])")


def on_config(config):
    found = sorted(NOTEBOOKS.glob("*.ipynb"))
    if found:
        where = next(k for k, entry in enumerate(config.nav) if "Experiments" in entry)
        config.nav.insert(where, {"Notebooks": [f"notebooks/{path.name}" for path in found]})
    return config


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files, config):
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        files.append(File(f"notebooks/{path.name}", str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def documented() -> set[str]:
    """What the reference has, as its pages ask for it."""
    pages = (ROOT / "docs" / "api").glob("*.md")
    return {name for page in pages for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)}


def on_page_markdown(markdown, page, config, files):
    known, fenced, lines = documented(), False, []
    for line in markdown.split("\n"):
        if FENCE.match(line):
            fenced = not fenced
        if not (fenced or line.startswith(("#", ":::", "    "))):
            line = NAME.sub(lambda found: _linked(found, known), line)
        lines.append(line)
    return "\n".join(lines)


def _linked(found: re.Match, known: set[str]) -> str:
    name = f"pushjax.{found[1]}" + (f".{found[1]}" if found[1] in ROOMS else "")
    there = name in known or (name.rpartition(".")[0] in known and name.rpartition(".")[2][0].islower())
    return f"[{found[0]}][{name}]" if there else found[0]


def on_page_content(content, page, config, files):
    if page.file.src_path.endswith(".ipynb"):
        content = re.sub(r'href="\.\./(?:docs/)?([\w/-]+)\.md', r'href="../\1.html', content)
        return WRITTEN.sub(_written, content)
    return FORMULA.sub(lambda found: _mathml(found[2]), content)


def _mathml(text: str) -> str:
    r"""Of \(inline\) or \[displayed\] mathematics."""
    text = html.unescape(text.strip())
    return _drawn(text[2:-2], "block" if text.startswith(r"\[") else "inline")


def _drawn(formula: str, display: str) -> str:
    # A prime is an operator: as an identifier it is set twice as high.
    return convert(formula, display=display).replace("<mi>&#x02032;</mi>", "<mo>&#x02032;</mo>")


def _written(found: re.Match) -> str:
    if found["keep"]:
        return found["keep"]
    if found["block"]:
        return _drawn(html.unescape(found["block"]), "block")
    return _drawn(html.unescape(found["line"]), "inline")
