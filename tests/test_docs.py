"""The documentation agrees with the code (links, names, commands, examples), and the site builds without a warning.

The Python blocks of a page run one after another, in their own process and in float32, as for a user. A comment `# =
0.30` after an expression is compared with its value, to the digits that are written. A block is not run if a comment
`<!-- not run: why -->` is above it.
"""

import ast
import importlib
import json
import os
import re
import shlex
import subprocess
import sys
import traceback
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
SITE = sorted(path for path in DOCS.rglob("*.md"))
# pages that compile for half a minute to a minute
SLOW_PAGES = (
    "docs/concepts/contact.md",
    "docs/concepts/identification.md",
    "docs/concepts/pushing.md",
    "docs/concepts/random-friction.md",
    "docs/getting-started.md",
    "docs/tasks.md",
)
PAGES = [*SITE, ROOT / "README.md", ROOT / "benchmarks" / "README.md", ROOT / "CHANGELOG.md"]
BLOCK = re.compile(r"^(<!-- not run: [^>]+ -->\n)?```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
SHELL = re.compile(r"^```sh\n(.*?)^```", re.MULTILINE | re.DOTALL)
FENCED = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
VALUE = re.compile(r"#\s*=\s*([-+\d.e, ]+?)\s*$")
NUMBER = re.compile(r"^[-+]?\d+(?:\.(\d+))?$")
# Placeholders in a command, as in `pushjax reproduce NAME`.
PLACEHOLDER = re.compile(r"\b[A-Z]{3,}\b|…|\||\.\.\.")
PAPER = {"Equations": [f"({k})" for k in range(1, 21)], "Figures": "12345678", "Tables": ["I", "II"]}


def label(path: Path) -> str:
    return str(path.relative_to(ROOT))


def text_of(path: Path) -> str:
    """Return the text of a page without blocks of code."""
    return FENCED.sub("", path.read_text())


def spans(path: Path) -> list[str]:
    return re.findall(r"`([^`\n]+)`", text_of(path))


def with_blocks() -> list[Path]:
    return [path for path in PAGES if any(not skipped for skipped, _ in BLOCK.findall(path.read_text()))]


# Links


def anchors(path: Path) -> set[str]:
    """Return the anchors that GitHub and mkdocs make of headings."""
    found = set()
    for heading in re.findall(r"^#+ (.+)$", text_of(path), re.MULTILINE):
        plain = re.sub(r"[`*\[\]$\\]", "", heading).lower()
        found.add(re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip()))
    return found


@pytest.mark.parametrize("path", PAGES, ids=label)
def test_links_lead_somewhere(path):
    for target in re.findall(r"!?\[[^\]]*\]\(([^)\s]+)\)", text_of(path)):
        if target.startswith(("http://", "https://")):
            continue
        file, _, anchor = target.partition("#")
        there = (path.parent / file).resolve() if file else path
        if there.suffix == ".ipynb":
            there = ROOT / "notebooks" / there.name  # notebooks are below docs/ on the site, but not in the repository
        assert there.exists(), f"{target}: no such file"
        assert ROOT in there.parents, f"{target}: outside of the repository"
        if anchor and there.suffix == ".md":
            assert anchor in anchors(there), f"{target}: no such heading"


def test_notebooks_links_lead_somewhere():
    """Links work in the repository or on the site, where the notebooks are below docs/."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if not target.startswith("http"):
                file = target.partition("#")[0]
                assert any((folder / file).resolve().exists() for folder in (path.parent, DOCS / "notebooks")), target


@pytest.mark.parametrize("path", SITE, ids=label)
def test_references_are_names_of_the_library(path):
    for name in re.findall(r"\]\[(pushjax[\w.]*)\]", text_of(path)):
        resolve(name)


# Names


def resolve(name: str) -> Any:
    """Return what a dotted name refers to; modules come first, since a function may share its name with its room."""
    parts = name.replace("pj.", "pushjax.", 1).split(".") if name.startswith("pj.") else name.split(".")
    for many in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:many]))
        except ModuleNotFoundError:
            continue
        break
    else:
        raise AssertionError(f"{name}: no such module")
    rest = parts[many:]
    if not name.startswith("pj.") or rest:
        return member(found, rest, name)
    return member(importlib.import_module("pushjax"), parts[1:], name)


def member(found: Any, rest: list[str], name: str) -> Any:
    for part in rest:
        fields = getattr(found, "__dataclass_fields__", {}) | getattr(found, "__annotations__", {})
        assert hasattr(found, part) or part in fields, f"{name}: {found!r} has no {part}"
        found = getattr(found, part, None)
    return found


@pytest.mark.parametrize("path", [path for path in PAGES if path.name != "CHANGELOG.md"], ids=label)
def test_names_in_backticks_exist(path):
    import pushjax as pj

    for span in spans(path):
        for name in re.findall(r"(?<![\w./])(?:pj|pushjax)(?:\.[A-Za-z_]\w*)+", span):
            if not name.endswith((".py", ".json")):
                resolve(name)
        for owner, part in re.findall(r"^([A-Z]\w+)\.(\w+)", span):
            if hasattr(pj, owner):
                member(getattr(pj, owner), [part], span)


def reexported(room: str) -> list[str]:
    """Return the public names of a room, or of the package."""
    package = ROOT / "pushjax" / room
    lazy = package / "__init__.pyi"
    tree = ast.parse((lazy if lazy.exists() else package / "__init__.py").read_text())
    return [name.asname for node in tree.body if isinstance(node, ast.ImportFrom) for name in node.names if name.asname]


def documented() -> list[str]:
    pages = (DOCS / "api").glob("*.md")
    return [name for page in pages for name in re.findall(r"^::: (\S+)", page.read_text(), re.MULTILINE)]


def test_every_public_name_is_in_the_reference_once():
    names, found = reexported("."), documented()
    names += [f"plot.{name}" for name in reexported("plot")]
    assert len(names) > 60
    for name in names:
        # a function that shares its name with its room appears with both
        times = found.count(f"pushjax.{name}") + found.count(f"pushjax.{name}.{name}")
        assert times == 1, f"pushjax.{name} is {times} times on the pages of docs/api, in a line `::: pushjax.{name}`"
    for name in found:
        resolve(name)


def test_unknowns_are_all_in_the_table():
    import pushjax as pj

    rows = re.findall(r"^\| `(\w+)`[^|]*\| [^|]+\| [^|]*\|", (DOCS / "unknowns.md").read_text(), re.MULTILINE)
    fields = [name for name in pj.Unknowns.__dataclass_fields__ if name not in ("sides", "shared")]
    assert rows[: len(fields)] == fields


def test_statuses_are_all_in_the_table():
    import pushjax as pj

    rows = re.findall(r"^\| (\d) \| ([A-Z_]+) \|", (DOCS / "messages.md").read_text(), re.MULTILINE)
    assert rows == [(str(int(status)), status.name) for status in pj.Status]


def test_messages_are_those_of_the_code():
    sources = "\n".join(path.read_text() for path in sorted((ROOT / "pushjax").rglob("*.py")))
    sources = re.sub(r'"\n\s*f?"', "", sources)  # strings over several lines
    rows = re.findall(r"^\| (`[^|]+`) \|", (DOCS / "messages.md").read_text(), re.MULTILINE)
    parts = [part.strip() for row in rows for span in re.findall(r"`([^`]+)`", row) for part in span.split("…")]
    parts = [part for part in parts if len(part) > 5]
    assert len(parts) > 20
    for part in parts:
        assert part in sources, part


def test_every_equation_figure_and_table_of_the_paper_is_there():
    page = (DOCS / "equations.md").read_text()
    for section, wanted in PAPER.items():
        part = re.split(r"^## ", page.split(f"\n## {section}\n")[1], flags=re.MULTILINE)[0]
        first = [re.findall(r"\(\d+\)|\b[IVX]+\b|\d", row) for row in re.findall(r"^\| ([^|]+) \|", part, re.MULTILINE)]
        found = {number for row in first for number in row}
        assert found == set(wanted), section


# Commands


def commands() -> list[tuple[str, str]]:
    found = []
    for path in PAGES:
        for block in SHELL.findall(path.read_text()):
            found += [(label(path), line) for line in block.split("\n") if re.match(r"(\S*/)?pushjax ", line)]
        if path.name != "CHANGELOG.md":
            inline = [span for span in spans(path) if span.startswith("pushjax ") and not PLACEHOLDER.search(span)]
            found += [(label(path), span) for span in inline]
    return sorted(set(found))


@pytest.mark.parametrize("command", sorted({command for _, command in commands()}))
def test_commands_parse(command, capsys):
    from pushjax.cli import main as cli

    arguments = shlex.split(command)[1:]
    if arguments == ["--version"]:  # this is handled before anything is parsed
        cli.main(arguments)
        assert capsys.readouterr().out.startswith("pushjax ")
    elif "--help" in arguments:
        with pytest.raises(SystemExit) as end:
            cli.main(arguments)
        assert end.value.code in (0, None)
    else:
        name, options = cli.split(arguments)
        if options and name != cli.FETCH:
            cli.parse(name, options)


def test_scripts_in_commands_exist():
    named = {name for path in PAGES for name in re.findall(r"python (docs/[\w/]+\.py)", path.read_text())}
    assert named
    assert [name for name in sorted(named) if not (ROOT / name).exists()] == []
    pictures = {name for path in PAGES for name in re.findall(r"python docs/pictures\.py (\w+)", path.read_text())}
    script = (DOCS / "pictures.py").read_text()
    assert [name for name in sorted(pictures) if f"\ndef {name}() -> " not in script] == []


def test_benchmarks_in_commands_exist():
    from benchmarks.__main__ import listing

    cases = {line.split()[0] for line in listing().splitlines()}
    present = r"python -m benchmarks ([a-z]\w+)(?![^`]*` at commit)"  # studies are in the history
    named = {name for path in PAGES for name in re.findall(present, path.read_text())}
    assert named
    assert named <= cases


def test_options_are_all_in_the_command_line_page(capsys):
    from pushjax.cli import main as cli

    def options(name: str) -> set[str]:
        with pytest.raises(SystemExit):
            cli.main([*name.split(), "--help"])
        return set(re.findall(r"--(?!no-|help)([a-z][\w-]*)", re.sub(r"\n *│ {5,}.*", "", capsys.readouterr().out)))

    page = (DOCS / "command-line.md").read_text()
    common = options("demo")
    for name in ("identify", "plan", cli.FETCH):
        for option in common | options(name):
            assert re.search(rf"--(no-)?{option}\b", page), option
    reproduce = (DOCS / "experiments" / "index.md").read_text()
    for name in (name.split()[1] for name in cli.COMMANDS if name.startswith("reproduce")):
        row = re.search(rf"^\| `{name}` \|.*$", reproduce, re.MULTILINE)
        assert row is not None, name
        assert set(re.findall(r"--([\w-]+)", row[0])) == options(f"reproduce {name}") - common, name


# Examples


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """Return a function that gives for each page "" or the end of a traceback.

    One process runs all long pages, and one all others, to share compiled programs.
    """

    @cache
    def run(long: bool) -> dict[str, str]:
        environment = os.environ | {"JAX_ENABLE_X64": "0", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.2"}
        paths = [str(path) for path in with_blocks() if (label(path) in SLOW_PAGES) == long]
        folder = tmp_path_factory.mktemp("pages")
        command = [sys.executable, __file__, *paths]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1800)
        assert done.returncode == 0, done.stderr[-3000:]
        return json.loads((folder / "ran.json").read_text())

    return run


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=[pytest.mark.slow] * (label(path) in SLOW_PAGES)) for path in with_blocks()],
    ids=label,
)
def test_examples_run(path, ran):
    assert ran(label(path) in SLOW_PAGES)[str(path)] == ""


def run_pages(paths: list[str]) -> None:
    ran = {}
    for path in paths:
        try:
            run_page(Path(path))
            ran[path] = ""
        except Exception:
            ran[path] = traceback.format_exc()[-3000:]
    Path("ran.json").write_text(json.dumps(ran))


def run_page(path: Path) -> None:
    names: dict[str, Any] = {}
    text = path.read_text()
    for found in BLOCK.finditer(text):
        if found[1]:
            ast.parse(found[2])
            continue
        before = text[: found.start(2)].count("\n")
        tree, lines = ast.parse(found[2]), found[2].split("\n")
        ast.increment_lineno(tree, before)
        for node in tree.body:
            if not isinstance(node, ast.Expr):
                exec(compile(ast.Module([node], []), str(path), "exec"), names)
                continue
            value = eval(compile(ast.Expression(node.value), str(path), "eval"), names)
            told = VALUE.search(lines[(node.end_lineno or 0) - before - 1])
            if told:
                compare(value, told[1], f"{path}, line {node.lineno}: {ast.unparse(node)}")


def compare(value: Any, told: str, where: str) -> None:
    """Compare numbers to one unit of the last digit that is written."""
    numbers = [part.strip() for part in told.split(",")]
    values = np.ravel(np.asarray(value, float))
    assert len(values) == len(numbers), f"{where}: {told!r} against {values}"
    for got, number in zip(values, numbers, strict=True):
        digits = NUMBER.match(number)
        assert digits is not None, f"{where}: {number!r} is no number"
        assert abs(got - float(number)) <= 10.0 ** -len(digits[1] or ""), f"{where}: {told!r} against {values}"


# The site


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for module in ("mkdocs", "material", "mkdocstrings_handlers.python", "mkdocs_jupyter", "latex2mathml"):
        pytest.importorskip(module, reason="pip install '.[docs]'")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(out)]
    done = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr
    return out


def test_site_builds_and_fetches_nothing(site):
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        loaded = re.findall(r'<(?:script|img|iframe)[^>]*\ssrc="(https?:[^"]+)', page.read_text())
        loaded += re.findall(r'<link[^>]*rel="(?:stylesheet|preconnect)"[^>]*href="(https?:[^"]+)', page.read_text())
        assert loaded == [], page.name


def test_formulas_are_drawn(site):
    contact = (site / "concepts" / "contact.html").read_text()
    assert contact.count("<math") > 20
    for page in site.rglob("*.html"):
        assert 'class="arithmatex"' not in page.read_text(), page.name


if __name__ == "__main__":
    run_pages(sys.argv[1:])
