"""Lets pytest run the Python blocks of Markdown documents: `pytest README.md docs`."""

from __future__ import annotations

import os
import tempfile
from typing import Any

from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser, SkipParser


def _in_a_scratch_folder(namespace: dict[str, Any]) -> None:
    os.chdir(tempfile.mkdtemp())  # what a document writes must not land in the source tree


pytest_collect_file = Sybil(
    parsers=[PythonCodeBlockParser(), SkipParser()], patterns=["*.md"], setup=_in_a_scratch_folder
).pytest()
