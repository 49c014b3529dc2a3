"""What the pages have in common: a server, a clock that runs beside the program, and an end."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from typing import TypeVar

from ssm_decouple.viewing.viewer.server import open_server, quiet, url_of

FRAMES = 30  # a second

P = TypeVar("P", bound="Page")


class Page(ABC):
    """A page in the browser. It runs until it is stopped.

    Args:
        host: Address to listen on.
        port: Where the page is; the next free one if it is taken.

    Attributes:
        url: Where the page is.
        server: The viser server.
    """

    def __init__(self, host: str, port: int) -> None:
        self._wake, self._over, self._closed = threading.Event(), threading.Event(), False
        self.server = open_server(host, port)
        self.url = url_of(self.server, host)

    @abstractmethod
    def _tick(self, elapsed: float, woken: bool) -> None:
        """Go on after some time on the wall, s; `woken` where somebody has set `_wake`, which stays to be cleared."""

    def _begin(self) -> None:
        """Start the clock, once all that it shows is there."""
        self._thread = threading.Thread(target=self._run, name=type(self).__name__.lower(), daemon=True)
        self._thread.start()

    def _run(self) -> None:
        last = due = time.monotonic()
        while not self._over.is_set():
            woken = self._wake.wait(max(0.0, due - time.monotonic()))
            now = time.monotonic()
            due = max(due, now - 1.0 / FRAMES) + 1.0 / FRAMES
            self._tick(now - last, woken)
            last = now

    def wait(self) -> None:
        """Wait until it is stopped, or Ctrl-C."""
        try:
            while not self._over.wait(0.5):
                pass
        except KeyboardInterrupt:
            self.stop()

    def stop(self) -> None:
        """Close the page."""
        if self._closed:
            return
        self._closed = True
        self._over.set()
        self._wake.set()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=5.0)
        with quiet():
            self.server.stop()

    def __enter__(self: P) -> P:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()
