"""The server of the page: opened on the loopback, quiet, and with an error that names the extra."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING

from ssm_decouple.errors import DecoupleWarning, InputError
from ssm_decouple.viewing.viewer.guard import ANYWHERE, guarded, try_guard

if TYPE_CHECKING:
    import viser

HOST = "127.0.0.1"
PORT = 8080
SKY, GROUND, FILL = (230, 236, 255), (150, 148, 142), 2.1  # the light that no lamp gives, from above and from below
WIDTH = 380  # pixels: of the controls, in which the table has to fit


def open_server(host: str = HOST, port: int = PORT, dark: bool = True, panel: bool = True) -> viser.ViserServer:
    """Start a viser server; where the port is taken, on the next that is free, which a warning names.

    It answers those alone who ask for it at an address of this machine and at its own port, and no page from elsewhere.

    Args:
        host: Address to listen on; the loopback can be reached from this machine alone.
        port: 0 takes any free one.
        dark: Dark page.
        panel: Dock the controls at the right; else there are none.

    Raises:
        InputError: viser is not installed, or one that lets any web page in, or the address or the port is none.
    """
    require_viser()
    import viser

    if not (isinstance(port, int) and 0 <= port < 65536):
        raise InputError(f"port is {port!r}; it is a whole number up to 65535, 0 for any free one")
    _refuse_foreign(host)
    # Browsers open connections ahead of need and close them unused, of which websockets would tell at length.
    logging.getLogger("websockets.server").addFilter(lambda record: record.getMessage() != "opening handshake failed")
    # Its banner would stand between what the command prints; the URL is told in one line instead.
    with quiet(), guarded(host):
        server = viser.ViserServer(host=host, port=port, verbose=False)
    try:
        try_guard(host, server.get_port())
    except InputError:
        with quiet():
            server.stop()
        raise
    if port and server.get_port() != port:
        warnings.warn(f"port {port} is taken; using {server.get_port()}", DecoupleWarning, stacklevel=3)
    server.gui.configure_theme(dark_mode=dark, show_logo=False, show_share_button=False, control_width="large")
    # Shadows, and light from a picture of surroundings, cost more than all the rest of a frame where there is no
    # graphics card. There are none around a satellite.
    server.scene.configure_default_lights(enabled=True, cast_shadow=False)
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere("/fill", sky_color=SKY, ground_color=GROUND, intensity=FILL)
    if panel:
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(WIDTH)
    return server


def require_viser() -> None:
    """Raise InputError where viser is not installed; the message names the extra."""
    try:
        import viser  # noqa: F401
    except ImportError as error:
        raise InputError(f"the viewer needs viser ({error}): pip install 'ssm-decouple[viewer]'") from None


def url_of(server: viser.ViserServer, host: str) -> str:
    """Return the address of the page."""
    name = "localhost" if host in ANYWHERE else host
    return f"http://{f'[{name}]' if ':' in name else name}:{server.get_port()}"


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep what viser prints off the standard output."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield


def _refuse_foreign(host: str) -> None:
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise InputError(f"cannot listen on '{host}': {error.strerror or error}; use {HOST}") from None
