"""Compiled programs on disk: the next process finds them, where they are kept, and the warning if they are not."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import pytest

from pushjax._internal import compilation_cache
from pushjax.cli import main as cli

PROGRAM = """
import jax, jax.numpy as jnp, sys
import pushjax as pj
import logging
loggers = [logging.getLogger(name) for name in ("jax", "jaxlib")]
before = [(logger.level, [*logger.handlers]) for logger in loggers]
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name.endswith("/cache_hits")))
float(jax.jit(lambda x: x + 1)(1.0))  # a program of before
print(pj.enable_compilation_cache(*sys.argv[1:]))
assert before == [(logger.level, logger.handlers) for logger in loggers]
float(jax.jit(lambda x: jnp.sort(x) @ x)(jnp.arange(100.0)))
print(sum(hits))
"""


def process(*arguments: str, **environment: str) -> list[str]:
    unset = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")
    unset += ("TF_CPP_MIN_LOG_LEVEL", "JAX_LOGGING_LEVEL")  # XLA logs as it does by default
    inherited = {name: value for name, value in os.environ.items() if name not in unset}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        env=inherited | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    assert "SIGILL" not in done.stderr, "what is known to be harmless is not said"
    return done.stdout.split()


def test_the_next_process_loads_what_this_one_compiled(tmp_path):
    folder = tmp_path / "kept"
    assert process(str(folder)) == [str(folder), "0"]
    kept = {path.name for path in folder.iterdir() if path.name.endswith("-cache")}
    assert kept
    assert int(process(str(folder))[1]) >= 1
    assert {path.name for path in folder.iterdir() if path.name.endswith("-cache")} == kept


@pytest.mark.skipif(sys.platform != "linux", reason="XDG_CACHE_HOME is of Linux")
def test_by_default_it_is_in_the_users_cache_folder(tmp_path):
    folder, _ = process(XDG_CACHE_HOME=str(tmp_path))
    assert Path(folder).parent == tmp_path / "pushjax" / "compiled"
    assert any(Path(folder).iterdir())


def test_what_jax_was_told_before_stays(tmp_path):
    folder, _ = process(JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own"), XDG_CACHE_HOME=str(tmp_path / "users"))
    assert folder == str(tmp_path / "own")
    assert not (tmp_path / "users").exists()


@pytest.fixture
def settings(monkeypatch):
    """Restore the settings of JAX and of warnings afterwards."""
    names = ("jax_enable_compilation_cache", "jax_compilation_cache_dir", "jax_logging_level")
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    yield
    for name, value in before.items():
        jax.config.update(name, value)


@pytest.mark.usefixtures("settings")
def test_the_command_line_says_once_that_it_cannot_keep_them(capsys, monkeypatch, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    others = []
    monkeypatch.setattr(warnings, "showwarning", lambda message, *_: others.append(str(message)))
    cli._keep_compiled(True)
    for name in ("one", "two"):
        rejected = f"Error reading persistent compilation cache entry for '{name}': XlaRuntimeError: features"
        warnings.showwarning(UserWarning(rejected), UserWarning, "compiler.py", 1)
    warnings.showwarning(UserWarning("something else"), UserWarning, "other.py", 2)
    told = capsys.readouterr().err
    assert told.count("cannot be kept") == 1
    assert str(tmp_path) in told
    assert "features" in told
    assert "--no-cache" in told
    assert others == ["something else"]


@pytest.mark.usefixtures("settings")
def test_without_the_cache_nothing_is_kept(monkeypatch):
    monkeypatch.setattr(compilation_cache, "enable_compilation_cache", lambda: pytest.fail("asked for"))
    cli._keep_compiled(False)
    assert jax.config.jax_enable_compilation_cache is False


@pytest.mark.parametrize("told", ["flags : sse avx", "flags : sse avx avx512f"])
def test_a_kind_of_processor_has_a_folder_of_its_own(monkeypatch, told):
    """Each kind of processor has its own folder.

    Machines may share a home folder, and one may be unable to run what another compiled.
    """
    monkeypatch.setattr(Path, "is_file", lambda self: True)
    own = compilation_cache.processor()
    monkeypatch.setattr(Path, "read_text", lambda self: f"model name : x\n{told}\n")
    assert compilation_cache.processor() != own
    assert compilation_cache.processor() == compilation_cache.processor()
