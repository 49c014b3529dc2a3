"""What the pages have in common: a server, a clock that runs beside the program, and an end."""

from __future__ import annotations

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from html import escape
from typing import Any, TypeVar

import viser

from ssm_decouple.errors import DecoupleError, InputError
from ssm_decouple.viewing.viewer.server import open_server, quiet, url_of

FRAMES = 30  # a second
LONG = 300  # letters of what went wrong that a page has room for

P = TypeVar("P", bound="Page")


class Page(ABC):
    """A page in the browser. It runs until it is stopped, whatever goes wrong in one tick of its clock.

    What goes wrong stands on the page in words until a tick goes well again; an input that cannot be heeded is answered
    by a notice to the one who made it.

    Args:
        host: Address to listen on.
        port: Where the page is; the next free one if it is taken.

    Attributes:
        url: Where the page is.
        server: The viser server.
        trouble: What stands on the page while its clock cannot go on.
    """

    def __init__(self, host: str, port: int) -> None:
        self._wake, self._over, self._closed = threading.Event(), threading.Event(), False
        self.server = open_server(host, port)
        self.url = url_of(self.server, host)
        self.trouble = self.server.gui.add_html("", visible=False)

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
            wrong = ""
            try:
                self._tick(now - last, woken)
            except Exception as error:
                wrong = in_words(error)
            with suppress(Exception):  # the clock of a page that cannot even be told goes on, too
                self._tell(wrong)
            last = now

    def _tell(self, wrong: str) -> None:
        """Let the page say what is wrong, or nothing."""
        content = f'<div style="padding:0.4em 0.9em;color:#E8590C"><b>{escape(wrong)}</b></div>' if wrong else ""
        if content != self.trouble.content:
            self.trouble.content, self.trouble.visible = content, bool(wrong)

    def _heeding(self, act: Callable[[Any], object], title: str = "not heeded") -> Callable[[Any], None]:
        """Return a callback that tells who gave an input what is wrong with it, where viser would print a traceback."""

        def heed(event: Any) -> None:
            try:
                act(event)
            except Exception as error:
                if event.client is None:  # a program's, and no page's
                    raise
                event.client.add_notification(title, in_words(error), color="red")

        return heed

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


def in_words(error: Exception) -> str:
    """Return what went wrong in a line: what the package's own errors say, and of others what they are too."""
    told = " ".join(str(error).split()) or "no more is known"
    return (told if isinstance(error, DecoupleError) else f"{type(error).__name__}: {told}")[:LONG]


def chosen_pace(dropdown: viser.GuiDropdownHandle[str]) -> float:
    """Return how often faster than the clock on the wall a page is to go, as its dropdown says.

    Raises:
        InputError: it is none of its words.
    """
    return float(one_of(dropdown).split()[0])


def one_of(dropdown: viser.GuiDropdownHandle[str]) -> str:
    """Return the word that a dropdown stands at.

    Raises:
        InputError: it is none of its words, as another program than the page may send.
    """
    if dropdown.value not in dropdown.options:
        raise InputError(f"'{dropdown.value}' is none of {', '.join(dropdown.options)}")
    return str(dropdown.value)
