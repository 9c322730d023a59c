"""The rooms (subpackages) of the package: what each may import, how long its files are, and the picture of them."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.fixture(scope="module")
def architecture():
    spec = importlib.util.spec_from_file_location("architecture", DOCS / "_site" / "architecture.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_imports_point_down(architecture):
    """Each room imports only rooms before it in the list, also inside functions."""
    order = architecture.ROOMS
    wrong = [
        f"{module} imports {other}"
        for module, others in architecture.modules().items()
        for other in others
        if order.index(architecture.room(other)) > order.index(architecture.room(module))
    ]
    assert not wrong


def test_no_module_is_built_on_itself(architecture):
    found = architecture.modules()
    for module in found:
        architecture.above(found, module)


def test_a_circle_is_found(architecture):
    with pytest.raises(ValueError, match="a → b → c → a"):
        architecture.above({"a": {"b"}, "b": {"c"}, "c": {"a"}}, "a")


def test_only_four_files_stand_outside_of_the_rooms(architecture):
    at_root = {path.name for path in architecture.PACKAGE.iterdir() if path.is_file()}
    assert at_root == {"__init__.py", "__init__.pyi", "__main__.py", "metrics.py", "py.typed"}


def test_the_picture_is_that_of_the_imports(architecture):
    assert architecture.PICTURE.read_text() == architecture.picture()
    page = (DOCS / "architecture.md").read_text()
    listed = re.findall(r"`(\w+)`", "".join(re.findall(r"^\| (`.*?) \|", page, re.MULTILINE)))
    assert sorted(listed) == sorted(architecture.ROOMS)


def test_files_and_functions_stay_short(architecture):
    """No file has more than 400 lines. No function has more than 60 without its docstring."""
    for path in sorted(architecture.PACKAGE.rglob("*.py")):
        text = path.read_text()
        assert len(text.splitlines()) <= 400, path
        for function in ast.walk(ast.parse(text)):
            if isinstance(function, ast.FunctionDef):
                lines = _line_count(function)
                if ast.get_docstring(function) is not None:
                    lines -= _line_count(function.body[0])
                assert lines <= 60, f"{path}: {function.name} has {lines} lines"


def _line_count(node: ast.stmt) -> int:
    assert node.end_lineno is not None
    return node.end_lineno - node.lineno + 1
