"""The commands that show motions in the browser and write pictures, films and pages of them."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ssm_decouple.cli.shared import NoProgress, progress_bar
from ssm_decouple.errors import InputError

if TYPE_CHECKING:
    from ssm_decouple.viewing.viewer.live import Live
    from ssm_decouple.viewing.viewer.player import Player
    from ssm_decouple.viewing.viewer.scene import Scene

_MOTIONS = "Motions, netCDF, as 'run' and 'compare' write them."
Meshes = Annotated[
    list[Path] | None, typer.Option("--meshes", help="Folder that holds the meshes of the URDF; may stand again.")
]


def add_viewer(app: typer.Typer) -> None:
    """Add the commands 'view' and 'render'."""
    app.command()(view)
    app.command()(render)


def view(
    motions: Annotated[list[Path] | None, typer.Argument(help=_MOTIONS, show_default=False)] = None,
    live: Annotated[
        str | None, typer.Option("--live", help="Instead of motions a case, or a robot, whose target one drags.")
    ] = None,
    port: Annotated[int, typer.Option(help="Where the page is; the next free one if it is taken, 0 for any.")] = 8080,
    host: Annotated[str, typer.Option(help="Address to listen on; the default is for this machine alone.")] = (
        "127.0.0.1"
    ),
    no_open: Annotated[bool, typer.Option("--no-open", help="Open no browser, print the address alone.")] = False,
    meshes: Meshes = None,
) -> None:
    """Show motions in the browser, side by side on one clock, until Ctrl-C.

    Needs the extra [viewer]. Closing the page stops nothing: open it again.

    Examples: ssm-decouple view results/case1/*.nc; ssm-decouple view --live case1
    """
    if (live is None) == (not motions):
        raise InputError("give motions to show, or --live with a case or a robot, and not both")
    with _opened(motions or [], live, host, port, meshes or []) as page:
        typer.echo(f"{page.url}  (Ctrl-C ends it)")
        if not no_open and _has_screen():
            import webbrowser

            webbrowser.open(page.url)
        page.wait()


@contextmanager
def _opened(motions: list[Path], live: str | None, host: str, port: int, meshes: list[Path]) -> Iterator[Player | Live]:
    from ssm_decouple.viewing.viewer.server import require_viser

    require_viser()
    if live is not None:
        from ssm_decouple.viewing.viewer.live import live as open_live

        with open_live(live, host, port, tuple(meshes)) as page:
            yield page
        return
    from ssm_decouple.viewing.viewer.player import Player

    with Player(_scenes(motions, meshes), host, port) as player:
        yield player


def _has_screen() -> bool:
    """Say whether a window can be opened: without one a browser for terminals would take this one."""
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def render(
    motions: Annotated[list[Path], typer.Argument(help=_MOTIONS, show_default=False)],
    html: Annotated[Path | None, typer.Option(help="One page that plays in any browser, without a server.")] = None,
    png: Annotated[Path | None, typer.Option(help="A picture.")] = None,
    mp4: Annotated[Path | None, typer.Option(help="A film; a GIF if its name ends so, or without ffmpeg.")] = None,
    at: Annotated[float | None, typer.Option(help="Time of the picture, s; the end if not given.")] = None,
    speed: Annotated[float, typer.Option(help="Seconds of the motion in one of the film or the page.")] = 10.0,
    fps: Annotated[int, typer.Option(help="Pictures a second of the film.")] = 25,
    size: Annotated[str, typer.Option(help="Width x height of pictures and films, pixels.")] = "1280x720",
    bending: Annotated[float | None, typer.Option(help="Exaggeration of the wings' bending.")] = None,
    light: Annotated[bool, typer.Option("--light", help="On white.")] = False,
    browser: Annotated[str | None, typer.Option(help="A Chromium, Chrome or Edge, if it is not found.")] = None,
    meshes: Meshes = None,
    no_progress: NoProgress = False,
) -> None:
    """Write motions, side by side, as a page, a picture or a film.

    Needs the extra [viewer]. Pictures and films need a Chromium, Chrome or Edge too, which opens no window; the page
    needs none.

    Example: ssm-decouple render results/case1/none.nc results/case1/selective.nc --html case1.html --mp4 case1.mp4
    """
    if html is None and png is None and mp4 is None:
        raise InputError("say what to write: --html, --png or --mp4, each with a file")
    for option, place, endings in (("html", html, ".html .htm"), ("png", png, ".png"), ("mp4", mp4, ".mp4 .gif")):
        if place is not None and place.suffix.lower() not in endings.split():
            raise InputError(f"--{option} is '{place}'; its name must end in {endings.replace(' ', ' or ')}")
    pixels = _pixels(size)
    from ssm_decouple.viewing.viewer.server import require_viser

    require_viser()
    from ssm_decouple.viewing.viewer import export
    from ssm_decouple.viewing.viewer.browser import find_browser

    program = None if png is None and mp4 is None else find_browser(browser)
    scenes = _scenes(motions, meshes or [])
    with progress_bar(no_progress) as show:
        if html is not None:
            show("page", html.name, 0.0)
            _tell(export.write_html(scenes, html, speed, not light, bending))
        if png is not None:
            show("picture", png.name, 0.0)
            _tell(export.write_png(scenes, png, at, pixels, not light, bending, program))
        if mp4 is not None:
            film = mp4

            def done(share: float) -> None:
                show("film", film.name, share)

            _tell(export.write_film(scenes, film, speed, fps, pixels, not light, bending, program, done))


def _tell(path: Path) -> None:
    typer.echo(f"{path}  {path.stat().st_size / 1e6:.2f} MB")


def _pixels(size: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)x(\d+)", size)
    width, height = map(int, found.groups()) if found else (0, 0)
    if not (160 <= width <= 7680 and 120 <= height <= 4320):
        raise InputError(f"size is '{size}'; give width x height in pixels, such as 1280x720, 160x120 to 7680x4320")
    return width, height


def _scenes(paths: list[Path], meshes: list[Path]) -> list[Scene]:
    """Return the motions of files, called as the files are, with their folder where two are called alike."""
    from ssm_decouple.simulation.motion import load_motion
    from ssm_decouple.viewing.viewer import scenes_of

    stems = [path.stem for path in paths]
    alike = len(set(stems)) < len(stems)
    names = [f"{path.parent.name}/{path.stem}" if alike else path.stem for path in paths]
    if len(set(names)) < len(names):
        raise InputError(f"the same motion stands twice: {', '.join(map(str, paths))}")
    labels = [name.replace("_undamped", ", undamped") for name in names]
    return scenes_of(dict(zip(labels, map(load_motion, paths), strict=True)), meshes)
