"""Draw the pictures that the documents' own code makes.

python docs/figures.py                # run the pages whose code saves a picture, and keep the pictures in docs/images/
python docs/figures.py method start   # only these pages

A page shows `images/NAME.png` and has a block of code that saves `NAME.png`. The other pictures are drawn by
docs/tables.py from the tables' numbers. That every picture has one of the two is tested.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

FOLDER = Path(__file__).parent
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
SAVED = re.compile(r'savefig\("(\w+\.png)"')


def main(named: Sequence[str]) -> None:
    """Run the code of pages in a scratch folder and keep what it saves."""
    for page in sorted(FOLDER.glob("*.md")):
        text = page.read_text(encoding="utf-8")
        pictures = SAVED.findall(text)
        if not pictures or (named and page.stem not in named):
            continue
        with tempfile.TemporaryDirectory() as scratch, contextlib.chdir(scratch), open(os.devnull, "w") as nowhere:
            with contextlib.redirect_stdout(nowhere):
                exec("\n".join(BLOCK.findall(text)), {"__name__": "__main__"})
            for picture in pictures:
                shutil.copy(picture, FOLDER / "images" / picture)
        print(f"{page.name}: {', '.join(pictures)}")


if __name__ == "__main__":
    main(sys.argv[1:])
