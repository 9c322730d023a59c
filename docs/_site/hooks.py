"""Hooks of mkdocs for formulas, for links to the reference, and for the notebooks.

Formulas become MathML when the site is built. Browsers draw it without a script, and nothing has to be fetched.
`pj.X` and `pushjax.a.X` in the text of a page become links if the reference contains them. The notebooks are in a
folder beside docs/. They are added to the site unchanged, with their outputs.
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
# Formulas in notebooks, which have no arithmatex tags. Text in <pre> or <code> is not a formula.
WRITTEN = re.compile(
    r"(?P<keep><(pre|code|script|style)\b.*?</\2>)|\$\$(?P<block>.+?)\$\$|(?<![\\\w$])\$(?P<line>[^$<>\n]+?)\$(?![\d$])",
    re.DOTALL,
)
FENCE = re.compile(r"^\s*(```|~~~)")
NAME = re.compile(r"(?<![\[`])`(?:pj|pushjax)\.([A-Za-z_][\w.]*)(\([^`]*\))?`(?![\]`])")


def on_config(config):
    """Add the notebooks to the navigation."""
    found = sorted(NOTEBOOKS.glob("*.ipynb"))
    if found:
        where = next(k for k, entry in enumerate(config.nav) if "Experiments" in entry)
        config.nav.insert(where, {"Notebooks": [f"notebooks/{path.name}" for path in found]})
    return config


@event_priority(100)  # before mkdocs-jupyter looks for notebooks
def on_files(files, config):
    """Add the notebooks to the files of the site."""
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        files.append(File(f"notebooks/{path.name}", str(ROOT), config.site_dir, config.use_directory_urls))
    return files


def documented() -> set[str]:
    """Return the names in the reference, from its pages."""
    pages = (ROOT / "docs" / "api").glob("*.md")
    return {name for page in pages for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)}


def on_page_markdown(markdown, page, config, files):
    """Turn names of the package into links to the reference."""
    known, fenced, lines = documented(), False, []
    for line in markdown.split("\n"):
        if FENCE.match(line):
            fenced = not fenced
        if not (fenced or line.startswith(("#", ":::", "    "))):
            line = NAME.sub(lambda found: _linked(found, known), line)
        lines.append(line)
    return "\n".join(lines)


def _linked(found: re.Match, known: set[str]) -> str:
    """Return the match as a link if the reference contains the name or, for a method, its class."""
    name = f"pushjax.{found[1]}"
    there = name in known or (name.rpartition(".")[0] in known and name.rpartition(".")[2][0].islower())
    return f"[{found[0]}][{name}]" if there else found[0]


def on_page_content(content, page, config, files):
    """Convert formulas to MathML, and correct the links of notebooks."""
    if page.file.src_path.endswith(".ipynb"):
        content = re.sub(r'href="\.\./(?:docs/)?([\w/-]+)\.md', r'href="../\1.html', content)
        return WRITTEN.sub(_written, content)
    return FORMULA.sub(lambda found: _mathml(found[2]), content)


def _mathml(text: str) -> str:
    r"""Return the MathML of \(inline\) or \[displayed\] mathematics."""
    text = html.unescape(text.strip())
    return _drawn(text[2:-2], "block" if text.startswith(r"\[") else "inline")


def _drawn(formula: str, display: str) -> str:
    # A prime has to be an operator: as an identifier it is set twice as high.
    return convert(formula, display=display).replace("<mi>&#x02032;</mi>", "<mo>&#x02032;</mo>")


def _written(found: re.Match) -> str:
    if found["keep"]:
        return found["keep"]
    if found["block"]:
        return _drawn(html.unescape(found["block"]), "block")
    return _drawn(html.unescape(found["line"]), "inline")
