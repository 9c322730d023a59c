"""The folder of real data in the form that `Recordings.save` writes."""

import runpy
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def converted(data, tmp_path_factory):
    """Convert the curated arrays once, into a temporary folder."""
    folder = tmp_path_factory.mktemp("converted")
    runpy.run_path(str(Path(__file__).parent / "data" / "convert.py"))["convert"](data, folder)
    return folder
