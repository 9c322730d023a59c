"""The example learns for a moment and tests what it learned, in few environments."""

import importlib.util
import re
from pathlib import Path

import jax
import pytest


@pytest.mark.slow
def test_learn_push_box(capsys, monkeypatch):
    path = Path(__file__).parents[1] / "examples" / "learn_push_box.py"
    spec = importlib.util.spec_from_file_location("learn_push_box", path)
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    for name, few in {"ENVIRONMENTS": 8, "STEPS": 2, "MINIBATCHES": 2, "EPISODE": 2}.items():
        monkeypatch.setattr(example, name, few)
    with jax.numpy_rank_promotion("allow"):  # as for a user
        example.main(seconds=1e-3)
    said = capsys.readouterr().out
    assert re.search(r"\d+ s, 16 control steps, mean reward -?\d", said)
    assert re.findall(r"success, friction (.+): \d\.\d\d", said) == list(example.TESTS)
