"""The on-disk cache of compiled programs, shared by successive processes."""

import hashlib
import logging
import platform
from pathlib import Path

import jax
import platformdirs
from jax.experimental.compilation_cache import compilation_cache

MAX_BYTES = 2 << 30  # bytes; the least recently used programs are deleted first


def enable_compilation_cache(folder: str | Path | None = None) -> Path:
    """Keep compiled programs on disk, so that a later process loads the programs that this one compiled.

    This enables JAX's own cache, for all programs of the process and not only for those of this library. A later
    process loads a program if it is the same program with the same shapes and dtypes, compiled by the same version of
    JAX with the same flags. The folder is limited to 2 GiB. If JAX already uses a folder and no other one is given,
    nothing changes, and JAX's own limit applies. Unless `jax_logging_level` is set, XLA then logs fatal errors only:
    its loader warns of every program that it loads, without reason.

    Args:
        folder: Folder of the cache. Default: the folder that JAX already uses (`JAX_COMPILATION_CACHE_DIR`, or
            `jax.config`), else a folder for this kind of processor in the user's cache folder.

    Returns:
        The folder. JAX creates it when it writes the first program.
    """
    current = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    if folder is None and current:
        return Path(current)
    # machines that share a home folder may not be able to run each other's compiled programs
    default = platformdirs.user_cache_path("pushjax", appauthor=False) / "compiled" / processor()
    path = default if folder is None else Path(folder).expanduser()
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # small programs too: there are hundreds
    jax.config.update("jax_compilation_cache_max_size", MAX_BYTES)
    compilation_cache.reset_cache()  # JAX chose its cache at the first program; this makes it choose again
    if jax.config.jax_logging_level in (None, "NOTSET"):  # pyright: ignore[reportAttributeAccessIssue]
        _silence_loader()
    return path


def _silence_loader() -> None:
    """Keep XLA's loader from logging a line about SIGILL for every program that it loads from the cache."""
    # XLA logs that two tuning flags of AVX-512 processors are unsupported, and then loads and runs the program
    # (jax-ml/jax#38445). The levels and handlers of Python's loggers stay as they are.
    loggers = [(logger, logger.level, [*logger.handlers]) for logger in map(logging.getLogger, ("jax", "jaxlib"))]
    jax.config.update("jax_logging_level", "CRITICAL")
    for logger, level, handlers in loggers:
        logger.setLevel(level)
        logger.handlers[:] = handlers


def processor() -> str:
    """Return a name for this kind of processor and its instruction set."""
    cpuinfo = Path("/proc/cpuinfo")
    features = platform.processor()
    if cpuinfo.is_file():
        features = next((line for line in cpuinfo.read_text().splitlines() if line.startswith("flags")), features)
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:8]}"
