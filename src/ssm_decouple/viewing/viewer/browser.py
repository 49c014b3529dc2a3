"""Pictures without a window: a browser that needs no screen opens the page, and the page sends back what it draws.

Any of the Chromium family will do, with a graphics card or without: most machines have one of them, and nothing has to
be installed for Python.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import viser

from ssm_decouple.errors import InputError

NAMES = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "brave-browser",
    "microsoft-edge",
)
PATIENCE = 120.0  # s: a browser that draws by software on a busy machine takes its time
_MAC = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "/Applications/Microsoft Edge.app/Contents/MacOS/Microsoft Edge",
)
_FLAGS = (
    "--headless=new",
    "--no-first-run",
    "--no-default-browser-check",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--mute-audio",
    # Draws by software where there is no graphics card; without it such a machine draws nothing.
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


def find_browser(given: str | Path | None = None) -> Path:
    """Return a browser of the Chromium family.

    Args:
        given: Its program; None looks in the usual places.

    Raises:
        InputError: there is none; the message says what to install.
    """
    if given is not None:
        found = shutil.which(str(given))
        if found is None:
            raise InputError(f"no browser at '{given}': name the program of a Chromium, Chrome or Edge")
        return Path(found)
    words = [word for name in NAMES if (word := shutil.which(name))] + [path for path in _MAC if Path(path).is_file()]
    if words:
        return Path(words[0])
    caches = (Path.home() / ".cache/ms-playwright", Path.home() / "Library/Caches/ms-playwright")
    bundled = [path for cache in caches for path in sorted(cache.glob("chromium-*/chrome-*/chrome"))]
    if bundled:
        return bundled[-1]
    raise InputError(
        "pictures and films need a browser, and none of Chromium, Chrome, Edge or Brave is here: install one, for "
        "example `apt install chromium`, or name it with --browser; --html needs none, and neither do the figures of "
        "`ssm-decouple plot`"
    )


@contextmanager
def headless_client(
    server: viser.ViserServer, url: str, program: Path, size: tuple[int, int]
) -> Iterator[viser.ClientHandle]:
    """Open the page in a browser without a window, and give the client that it is.

    Args:
        server: Whose page it is.
        url: Of the page.
        program: The browser.
        size: Of its window, pixels.

    Raises:
        InputError: the browser ends, or does not open the page.
    """
    with tempfile.TemporaryDirectory(prefix="ssm-decouple-", ignore_cleanup_errors=True) as profile:
        flags = [*_FLAGS, f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        if hasattr(os, "geteuid") and os.geteuid() == 0:
            flags.append("--no-sandbox")  # Chromium refuses to run as root with it
        process = subprocess.Popen(
            [str(program), *flags, url], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            yield _connected(server, process, program)
        finally:
            process.terminate()
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _connected(server: viser.ViserServer, process: subprocess.Popen[bytes], program: Path) -> viser.ClientHandle:
    until = time.monotonic() + PATIENCE
    while time.monotonic() < until:
        clients = list(server.get_clients().values())
        if clients:
            return clients[0]
        if process.poll() is not None:
            raise InputError(f"'{program}' ended with status {process.returncode} before it opened the page")
        time.sleep(0.05)
    raise InputError(f"'{program}' did not open the page within {PATIENCE:g} s; try another with --browser")
