"""Checkpoints of a Monte Carlo run in a folder: a manifest that identifies the run, and the pushes in blocks.

Each file is written under a temporary name and renamed when it is complete, so a run that is killed leaves no
incomplete file. Before a run continues from a folder, each part of the manifest is compared with what the run asks for.
"""

import hashlib
import json
import os
import re
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np

MANIFEST, BLOCK_FILE = "manifest.json", re.compile(r"pushes-\d{12}-\d{12}\.npz")
FORMAT = 1


class CheckpointError(ValueError):
    """A checkpoint that a run cannot continue from, or that cannot be written."""


def digest(*trees: Any) -> str:
    """Return a hash of the structure of pytrees and of every bit of their arrays, 16 hexadecimal digits."""
    hasher = hashlib.sha256()
    leaves, structure = jax.tree.flatten(trees)  # static fields are part of the structure
    hasher.update(_without_addresses(structure).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        hasher.update(f"{array.dtype} {array.shape}".encode())
        hasher.update(np.ascontiguousarray(array).tobytes())
    return hasher.hexdigest()[:16]


def _without_addresses(structure: Any) -> str:
    """Return the text of a tree structure without memory addresses of functions, which differ between processes."""
    # Two functions of one name have the same text. So `monte_carlo` also hashes the poses of the fingers, in which the
    # kinematics of two hands differ.
    pieces = str(structure).split(" at 0x")
    return pieces[0] + "".join(piece[piece.find(">") :] for piece in pieces[1:])


class Checkpoint:
    """Folder of a run: a manifest, and one file for each block of pushes."""

    def __init__(self, folder: Path, identity: dict[str, Any], writes: bool = True):
        """Open the folder and write its manifest if it has none; raise CheckpointError if another run wrote it."""
        self.folder, self.writes = folder, writes
        wanted = {"format": FORMAT} | identity
        path = folder / MANIFEST
        if path.exists():
            self._check_manifest(path, wanted)
        elif self._block_files():
            raise CheckpointError(
                f"checkpoint: {folder} has pushes but no {MANIFEST} to say whose; give another folder"
            )
        elif writes:
            self._write_file(path, lambda file: file.write(json.dumps(wanted, indent=2).encode()))

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

    def _block_files(self) -> list[Path]:
        return sorted(path for path in self.folder.glob("pushes-*.npz") if BLOCK_FILE.fullmatch(path.name))

    def blocks(self) -> list[tuple[int, int, Path]]:
        """Return (first, last, path) of each block that exists, in order, up to the first gap."""
        blocks, end = [], 0
        for path in self._block_files():
            first, last = (int(word) for word in path.stem.split("-")[1:])
            if first != end:
                break
            blocks.append((first, last, path))
            end = last
        return blocks

    def read(self, path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Read the named arrays of a block; raise CheckpointError if the block is incomplete."""
        try:
            with np.load(path) as file:
                return {name: file[name] for name in names}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
            raise CheckpointError(
                f"checkpoint: {path} is damaged ({type(error).__name__}); remove it, and what follows it is computed "
                "again"
            ) from None

    def write(self, first: int, last: int, arrays: dict[str, np.ndarray]) -> None:
        """Write a block of the pushes from index `first` up to but without index `last`."""
        if self.writes:
            self._write_file(
                self.folder / f"pushes-{first:012d}-{last:012d}.npz",
                lambda file: np.savez(file, allow_pickle=False, **arrays),
            )

    def _write_file(self, path: Path, write_content: Any) -> None:
        """Write a file with `write_content` under a temporary name, and rename it to `path` when it is complete."""
        partial = None
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for leftover in self.folder.glob(".partial-*"):  # from a run that was killed while it wrote
                leftover.unlink(missing_ok=True)
            with tempfile.NamedTemporaryFile(dir=self.folder, prefix=".partial-", delete=False) as file:
                partial = Path(file.name)
                write_content(file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, path)
        except OSError as error:
            if partial is not None:
                partial.unlink(missing_ok=True)
            raise CheckpointError(
                f"checkpoint: {path} cannot be written ({error.strerror or error}); what was written before is kept"
            ) from None
