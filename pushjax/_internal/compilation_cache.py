"""Compiled programs, kept on disk from one process to the next."""

import hashlib
import platform
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

LARGEST = 2 << 30  # bytes; what was used least is deleted first


def enable_compilation_cache(folder: str | Path | None = None) -> Path:
    """Keeps compiled programs on disk, so that a later process loads what this one compiled.

    JAX does the keeping, for all programs of the process and not only for those of this library. A program is found
    again if it is the same, of the same shapes and types, compiled by the same version of JAX with the same flags.
    The folder is limited to 2 GiB.

    Args:
        folder: Where to keep them. Default: where JAX keeps them already (`JAX_COMPILATION_CACHE_DIR`, or
            `jax.config`), else a folder for this kind of processor in the user's cache folder.

    Returns:
        The folder. It is created when the first program is written.
    """
    known = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None and known:
        return Path(known)
    path = Path(folder).expanduser() if folder is not None else _users_folder()
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # also small ones: there are hundreds
    jax.config.update("jax_compilation_cache_max_size", LARGEST)
    compilation_cache.reset_cache()  # JAX looks once, at the first program, whether it is to keep any
    return path


def _users_folder() -> Path:
    """A home folder may be shared by machines of which one cannot run what another compiled."""
    return platformdirs.user_cache_path("pushjax", appauthor=False) / "compiled" / _processor()


def _processor() -> str:
    """Names the kind of processor, and what instructions it has."""
    told = Path("/proc/cpuinfo")
    features = platform.processor()
    if told.is_file():
        features = next((line for line in told.read_text().splitlines() if line.startswith("flags")), features)
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:8]}"
