"""Motions as files to show around: one HTML page, a picture, a film."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
import subprocess
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import viser
from matplotlib.font_manager import findfont
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from ssm_decouple.errors import DecoupleWarning, FileError, InputError, as_positive
from ssm_decouple.files import written_whole
from ssm_decouple.viewing.viewer.browser import PATIENCE, find_browser, headless_client
from ssm_decouple.viewing.viewer.player import numbers, status
from ssm_decouple.viewing.viewer.plots import law_colors
from ssm_decouple.viewing.viewer.scene import Scene, usual_exaggeration
from ssm_decouple.viewing.viewer.server import HOST, open_server, quiet, url_of
from ssm_decouple.viewing.viewer.stage import Stage

Floats = NDArray[np.float64]
Progress = Callable[[float], object]

SPEED = 10.0
HTML_FRAMES = 20  # a second
AHEAD = 0.03  # s: poses and the wish for a picture take two ways to the browser, and poses have to be there first
MOST_PICTURES = 100_000  # of a film: more than an hour of it
GIF_FRAMES = 12  # a second: more makes a file that nobody sends
_DARK, _LIGHT = (14, 17, 24), (255, 255, 255)


@contextlib.contextmanager
def _staged(scenes: Sequence[Scene], dark: bool, named: bool) -> Iterator[tuple[viser.ViserServer, Stage]]:
    server = open_server(HOST, 0, dark=dark, panel=False)
    try:
        yield server, Stage(server, scenes, named)
    finally:
        with quiet():
            server.stop()


def write_html(
    scenes: Sequence[Scene],
    path: str | Path,
    speed: float = SPEED,
    dark: bool = True,
    exaggeration: float | None = None,
) -> Path:
    """Write motions as one HTML file that plays in any browser, with no server and no network.

    Args:
        scenes: The motions.
        path: The file.
        speed: How many seconds of the motion pass in one.
        dark: Dark page.
        exaggeration: Of the bending; None shows the largest well.

    Raises:
        InputError: a speed that is not positive.
        FileError: the place cannot be written.
    """
    speed = as_positive("speed", speed)
    end = max(float(scene.time[-1]) for scene in scenes)
    factor = exaggeration or usual_exaggeration(scenes)
    with _staged(scenes, dark, named=True) as (server, stage):
        clock = server.scene.add_label(
            "/clock", "", position=_above(stage), anchor="bottom-center", font_screen_scale=1.3
        )
        stage.draw(0.0, exaggeration=factor)
        recording = server.get_scene_serializer()
        for now in _times(end, speed, HTML_FRAMES):
            clock.text = f"t = {now:.1f} s"
            stage.draw(now, exaggeration=factor)
            recording.insert_sleep(1.0 / HTML_FRAMES)
        recording.insert_sleep(1.0)
        page = recording.as_html(dark_mode=dark)
    final = Path(path)
    with written_whole(final) as temporary:
        temporary.write_text(_with_summary(page, scenes, dark), encoding="utf-8")
    return final


def write_png(
    scenes: Sequence[Scene],
    path: str | Path,
    at: float | None = None,
    size: tuple[int, int] = (1280, 720),
    dark: bool = True,
    exaggeration: float | None = None,
    browser: str | Path | None = None,
) -> Path:
    """Write a picture of motions.

    Args:
        scenes: The motions.
        path: The file.
        at: Time, s; None is the end.
        size: Width and height, pixels.
        dark: Dark background.
        exaggeration: Of the bending; None shows the largest well.
        browser: A Chromium, Chrome or Edge; None looks for one.

    Raises:
        InputError: no browser.
        FileError: the place cannot be written.
    """
    end = max(float(scene.time[-1]) for scene in scenes)
    now = end if at is None else float(np.clip(at, 0.0, end))
    with _camera(scenes, size, dark, exaggeration, browser) as picture:
        image = picture(now)
    final = Path(path)
    with written_whole(final) as temporary:
        image.save(temporary, format="PNG", optimize=True)
    return final


def write_film(
    scenes: Sequence[Scene],
    path: str | Path,
    speed: float = SPEED,
    frames: int = 25,
    size: tuple[int, int] = (1280, 720),
    dark: bool = True,
    exaggeration: float | None = None,
    browser: str | Path | None = None,
    progress: Progress | None = None,
) -> Path:
    """Write a film of motions: MP4, or GIF where the name says so or ffmpeg is not installed, which a warning says.

    Args:
        scenes: The motions.
        path: The file.
        speed: How many seconds of the motion pass in one.
        frames: A second; a GIF has 12 at most.
        size: Width and height, pixels.
        dark: Dark background.
        exaggeration: Of the bending; None shows the largest well.
        browser: A Chromium, Chrome or Edge; None looks for one.
        progress: Called now and then with the share done, 0 to 1.

    Returns:
        The file that was written, which ends in .gif where there is no ffmpeg.

    Raises:
        InputError: no browser, or a speed that is not positive.
        FileError: the place cannot be written, or ffmpeg fails.
    """
    speed, rate = as_positive("speed", speed), int(as_positive("frames", frames))
    final = Path(path)
    program = shutil.which("ffmpeg")
    if program is None and final.suffix.lower() != ".gif":
        final = final.with_suffix(".gif")
        warnings.warn(
            f"ffmpeg is not installed; writing '{final}' instead of '{path}': apt install ffmpeg",
            DecoupleWarning,
            stacklevel=2,
        )
    gif = final.suffix.lower() == ".gif"
    rate = min(rate, GIF_FRAMES) if gif else rate
    size = (size[0] // 2 * 2, size[1] // 2 * 2)  # H.264 halves its colours
    times = _times(max(float(scene.time[-1]) for scene in scenes), speed, rate)

    def pictures() -> Iterator[Image.Image]:
        with _camera(scenes, size, dark, exaggeration, browser) as picture:
            for i, now in enumerate(times):
                yield picture(float(now))
                if progress is not None:
                    progress((i + 1) / len(times))

    with written_whole(final) as temporary:
        if gif:
            _write_gif(pictures(), temporary, rate)
        else:
            assert program is not None
            _write_mp4(pictures(), temporary, rate, size, program)
    return final


def _times(end: float, speed: float, rate: int) -> Floats:
    length = end / speed * rate
    if length > MOST_PICTURES:
        raise InputError(
            f"a film of {length:.3g} pictures, {MOST_PICTURES:,} at most: use a speed of "
            f"{end * rate / MOST_PICTURES:.3g} or more, or fewer pictures a second"
        )
    count = max(2, round(length) + 1)
    return np.linspace(0.0, end, count)


def _above(stage: Stage) -> Floats:
    low, high = stage.corners
    return np.array([0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), high[2] + 0.05 * stage.size])


@contextlib.contextmanager
def _camera(
    scenes: Sequence[Scene],
    size: tuple[int, int],
    dark: bool,
    exaggeration: float | None,
    browser: str | Path | None,
) -> Iterator[Callable[[float], Image.Image]]:
    """Give a function from time, s, to a picture."""
    program = find_browser(browser)
    factor = exaggeration or usual_exaggeration(scenes)
    with _staged(scenes, dark, named=False) as (server, stage):  # their names are in the caption
        stage.draw(0.0, exaggeration=factor)
        drawn = (size[0] - 13 * _unit(size), size[1])  # the numbers stand beside it
        place, middle, fov = stage.camera(drawn[0] / drawn[1])
        view = {"wxyz": _looking(place, middle), "position": place, "fov": fov}
        with headless_client(server, url_of(server, HOST), program, drawn) as client:
            _photograph(client, drawn, view)  # the first builds the scene, and its letters come later than its shapes
            time.sleep(0.5)

            def picture(now: float) -> Image.Image:
                stage.draw(now, exaggeration=factor)
                server.flush()
                time.sleep(AHEAD)
                return _captioned(_photograph(client, drawn, view), scenes, now, size, dark, factor)

            yield picture


def _photograph(client: viser.ClientHandle, size: tuple[int, int], view: dict[str, Any]) -> NDArray[np.uint8]:
    try:
        return client.get_render(size[1], size[0], transport_format="png", timeout=PATIENCE, **view)
    except (RuntimeError, TimeoutError) as error:
        raise InputError(f"the browser gave no picture: {error}; try another with --browser") from None


def _looking(position: Floats, middle: Floats) -> Floats:
    """Return the quaternion w x y z of a camera that looks along its z axis, its y axis down."""
    forward = (middle - position) / np.linalg.norm(middle - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    R = np.column_stack([right, np.cross(forward, right), forward])
    return Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]


def _captioned(
    pixels: NDArray[np.uint8], scenes: Sequence[Scene], now: float, size: tuple[int, int], dark: bool, bending: float
) -> Image.Image:
    """Put a picture on its background and write the numbers of its time beside it."""
    width, height = size
    image = Image.new("RGB", size, _DARK if dark else _LIGHT)
    drawn = Image.fromarray(pixels, "RGBA")
    image.paste(drawn, (width - drawn.width, 0), drawn)
    ink, faint = ((235, 238, 245), (150, 158, 173)) if dark else ((20, 22, 28), (100, 105, 115))
    draw, unit = ImageDraw.Draw(image), _unit(size)
    font, bold = (ImageFont.truetype(findfont(name), unit) for name in ("DejaVu Sans", "DejaVu Sans:bold"))
    title = str(scenes[0].motion.attrs.get("title", scenes[0].motion.attrs["robot"]))
    draw.text((unit, unit), title, ink, bold)
    if any(scene.wings for scene in scenes):
        draw.text((unit, round(2.5 * unit)), f"bending x {bending:g}", faint, font)
    draw.text((width - unit, unit), f"t = {now:.1f} s", ink, bold, anchor="ra")
    room = (height - 3 * unit) / len(scenes)
    for i, (scene, color) in enumerate(zip(scenes, law_colors([s.name for s in scenes]), strict=True)):
        left, turned, protected, momentum = numbers(scene, now)
        y = round(3 * unit + (i + 0.5) * room - 3.6 * unit)
        draw.rectangle((unit, y + 0.15 * unit, 1.7 * unit, y + 0.85 * unit), color)
        draw.text((2.2 * unit, y), scene.name, ink, bold)
        of_left = " mm" if scene.distance_unit == "mm" else ""  # others stand with the number
        lines = [
            status(scene, now),
            f"left {left}{of_left}",
            f"turned {turned} deg",
            f"|w_sub| {protected} rad/s",
        ]
        if scene.protected_rate is None:
            lines[-1] = "nothing protected"
        lines.append(f"momentum {momentum}" + (" N m s" if scene.has_momentum else ""))
        for j, line in enumerate(lines, 1):
            draw.text((2.2 * unit, y + round(1.3 * j * unit)), line, faint if j == 1 else ink, font)
    return image


def _unit(size: tuple[int, int]) -> int:
    """Return the height of a letter, pixels."""
    return max(9, size[1] // 46)


def _write_gif(pictures: Iterator[Image.Image], path: Path, rate: int) -> None:
    frames = [picture.quantize(96) for picture in pictures]
    frames[0].save(
        path, format="GIF", save_all=True, append_images=frames[1:], duration=round(1000 / rate), loop=0, optimize=True
    )


def _write_mp4(pictures: Iterator[Image.Image], path: Path, rate: int, size: tuple[int, int], program: str) -> None:
    words = [program, "-loglevel", "error", "-y", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{size[0]}x{size[1]}"]
    words += ["-r", str(rate), "-i", "-", "-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=complaints)
        assert process.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError):  # it has ended by itself, and says why
                for picture in pictures:
                    process.stdin.write(picture.tobytes())
        except BaseException:
            process.kill()
            raise
        finally:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.close()
            process.wait()
        complaints.seek(0)
        said = complaints.read().decode(errors="replace").strip()
    if process.returncode:
        raise FileError(f"ffmpeg cannot write '{path.name}': {said.splitlines()[-1] if said else process.returncode}")


def _with_summary(page: str, scenes: Sequence[Scene], dark: bool) -> str:
    """Return the page with a table of the motions' outcomes over the picture.

    The page unpacks itself and replaces what stands in it, so the table is added once that is done.
    """
    html = io.StringIO()
    title = escape(str(scenes[0].motion.attrs.get("title", scenes[0].motion.attrs["robot"])))
    html.write(f"<b>{title}</b><table>")
    html.write("<tr><th></th><th>left (mm)</th><th>turned (deg)</th><th>|w_sub| (rad/s)</th><th></th></tr>")
    for scene, color in zip(scenes, law_colors([scene.name for scene in scenes]), strict=True):
        end = float(scene.time[-1])
        left, turned, _, _ = numbers(scene, end)
        largest = "-" if scene.protected_rate is None else f"{scene.protected_rate.max():.1e}"
        cells = "".join(f"<td>{word}</td>" for word in (left, turned, largest, status(scene, end)))
        html.write(f'<tr><td><span style="color:{color}">&#9632;</span> {escape(scene.name)}</td>{cells}</tr>')
    html.write("</table>")
    ink = "#e6e9f0" if dark else "#14161c"
    style = (
        f"position:fixed;left:16px;top:14px;z-index:5;pointer-events:none;color:{ink};"
        "font:13px/1.5 system-ui,sans-serif;font-variant-numeric:tabular-nums"
    )
    script = (
        "<script>(function(){var h=" + _quoted(html.getvalue()) + ";function add(){"
        "if(document.querySelector('canvas')){var d=document.createElement('div');d.id='summary';"
        f"d.setAttribute('style',{_quoted(style)});d.innerHTML=h;document.body.appendChild(d);"
        "d.querySelectorAll('td+td,th+th').forEach(function(c){c.style.textAlign='right';c.style.paddingLeft='14px'});"
        "}else setTimeout(add,100)}add()})()</script>"
    )
    at = page.index("</head>")
    return page[:at] + script + page[at:]


def _quoted(text: str) -> str:
    return json.dumps(text).replace("</", "<\\/")
