"""Checkpoints of a Monte Carlo run in a folder: a manifest that identifies the run, and the pushes in blocks.

Each file is written under a temporary name and renamed when it is complete, so a run that is killed leaves no
incomplete file. Before a run continues from a folder, each part of the manifest is compared with what the run asks for.
"""

import hashlib
import json
import os
import re
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np

MANIFEST, BLOCK_FILE = "manifest.json", re.compile(r"pushes-(\d{12})-(\d{12})\.npz")


class CheckpointError(ValueError):
    """A checkpoint that a run cannot continue from, or that cannot be written."""


def digest(*trees: Any) -> str:
    """Return a hash of the structure of pytrees and of every bit of their arrays, 16 hexadecimal digits."""
    leaves, structure = jax.tree.flatten(trees)  # static fields are part of the structure
    # Without memory addresses of functions, which differ between processes. Two functions of one name have the same
    # text. So `monte_carlo` also hashes the poses of the fingers, in which the kinematics of two hands differ.
    hasher = hashlib.sha256(re.sub(r" at 0x[0-9a-f]+", "", str(structure)).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        hasher.update(f"{array.dtype} {array.shape}".encode())
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.hexdigest()[:16]


class Checkpoint:
    """Folder of a run: a manifest, and one file for each block of pushes."""

    def __init__(self, folder: Path, identity: dict[str, Any], writes: bool = True):
        """Open the folder and write its manifest if it has none; raise CheckpointError if another run wrote it."""
        self.folder, self.writes = folder, writes
        path = folder / MANIFEST
        if path.exists():
            self._check_manifest(path, identity)
        elif any(folder.glob("pushes-*.npz")):
            raise CheckpointError(
                f"checkpoint: {folder} has pushes but no {MANIFEST} to say whose; give another folder"
            )
        else:
            self._write_file(path, lambda file: file.write(json.dumps(identity, indent=2).encode()))

    def _check_manifest(self, path: Path, wanted: dict[str, Any]) -> None:
        """Raise CheckpointError unless the manifest at `path` equals `wanted`."""
        try:
            existing = json.loads(path.read_text())
            different = [name for name in {**wanted, **existing} if existing.get(name) != wanted.get(name)]
        except (ValueError, TypeError, OSError) as error:  # TypeError: JSON that is no object
            reason = error.strerror if isinstance(error, OSError) else "it is damaged"
            raise CheckpointError(f"checkpoint: {path} cannot be read ({reason}); give another folder") from None
        if different:
            name = different[0]
            raise CheckpointError(
                f"checkpoint: {self.folder} holds another run: {', '.join(different)} differ ({name} was "
                f"{existing.get(name)!r}, is {wanted.get(name)!r}); give another folder"
            )

    def read(self) -> tuple[list[dict[str, np.ndarray]], int]:
        """Return the arrays of each block, from the first push up to a gap, and the number of their pushes."""
        blocks, end = [], 0
        for path in sorted(self.folder.glob("pushes-*.npz")):
            name = BLOCK_FILE.fullmatch(path.name)
            if name is None or int(name[1]) != end:
                continue
            try:
                with path.open("rb") as opened, np.load(opened) as file:  # NumPy leaves a damaged file open
                    blocks.append(dict(file))
            except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
                raise CheckpointError(
                    f"checkpoint: {path} is damaged ({type(error).__name__}); remove it, and what follows it is "
                    "computed again"
                ) from None
            end = int(name[2])
        return blocks, end

    def write(self, first: int, last: int, arrays: dict[str, np.ndarray]) -> None:
        """Write a block of the pushes from index `first` up to but without index `last`."""
        path = self.folder / f"pushes-{first:012d}-{last:012d}.npz"
        self._write_file(path, lambda file: np.savez(file, allow_pickle=False, **arrays))

    def _write_file(self, path: Path, write_content: Any) -> None:
        """Write a file with `write_content` under a temporary name, and rename it to `path` when it is complete."""
        if not self.writes:
            return
        partial = self.folder / ".partial"  # if a run is killed while it writes, the next one replaces it
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with partial.open("wb") as file:
                write_content(file)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            with suppress(OSError):
                partial.unlink()
            raise CheckpointError(
                f"checkpoint: {path} cannot be written ({error.strerror or error}); what was written before is kept"
            ) from None
