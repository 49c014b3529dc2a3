"""How figures look: one column wide, colour-blind safe, the same colour for the same thing everywhere."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ssm_decouple.files import writable_folder, written_whole

T = TypeVar("T")

ROOM = 300.0  # below the floor of a logarithmic axis, for the words about it
COLUMN = 3.45  # inches, one column of a two-column page
PAGE = 7.1

# Okabe and Ito's palette, which readers with any colour vision tell apart.
AXIS_COLORS = {"roll": "#D55E00", "pitch": "#009E73", "yaw": "#0072B2"}
# The first is the widest, so that each is seen where all three lie on top of each other.
AXIS_LINES: dict[str, dict[str, Any]] = {
    "roll": {"color": AXIS_COLORS["roll"], "linewidth": 2.2},
    "pitch": {"color": AXIS_COLORS["pitch"], "linewidth": 1.3},
    "yaw": {"color": AXIS_COLORS["yaw"], "linewidth": 0.9, "linestyle": (0, (4, 1.5))},
}
PROTECTED = "#CC79A7"
TARGET = "#000000"
LAW_LINES: dict[str, dict[str, Any]] = {
    "none": {"color": "#8C8C8C", "linestyle": (0, (5, 1.5))},
    "selective": {"color": "#CC79A7", "linestyle": "-"},
    "reactionless": {"color": "#E69F00", "linestyle": (0, (5, 1.5, 1, 1.5))},
    "reactionless, undamped": {"color": "#E69F00", "linestyle": (0, (1, 1.5))},
    "selective, undamped": {"color": "#CC79A7", "linestyle": (0, (1, 1.5))},
}
LAW_LINES |= {
    "selective, planned": {"color": "#CC79A7", "linestyle": (0, (4, 1))},
    "selective, in the servo": {"color": "#0072B2", "linestyle": "-"},
    "reactionless, planned": {"color": "#E69F00", "linestyle": (0, (4, 1))},
    "the case's own": LAW_LINES["selective"],
    "bending modes": {"color": "#0072B2", "linestyle": "-"},
    "all rotation": LAW_LINES["reactionless"],
}

_STYLE: Any = {
    "font.size": 8,
    "font.family": "sans-serif",
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.5,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "lines.linewidth": 1.1,
    "legend.frameon": False,
    "savefig.dpi": 200,
    "pdf.fonttype": 42,
    "figure.constrained_layout.use": True,
}


def joint_colors(count: int) -> list[tuple[float, float, float, float]]:
    """Return one colour a joint, dark at the shoulder, light at the wrist."""
    return [mpl.colormaps["viridis"](x) for x in np.linspace(0.0, 0.9, max(count, 1))]


def styled(draw: Callable[[T], Figure]) -> Callable[[T], Figure]:
    """Let a function draw in the package's style, without changing the style of anybody else's figures."""

    @wraps(draw)
    def wrapper(subject: T) -> Figure:
        with mpl.rc_context(_STYLE):
            return draw(subject)

    return wrapper


def panels(rows: int, columns: int = 1, width: float = COLUMN, height: float = 1.55) -> tuple[Figure, Sequence[Axes]]:
    """Return a figure with panels that share their time axis."""
    figure = Figure(figsize=(width, height * rows + 0.25))
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False)
    return figure, list(axes.flat)


def floored(axes: Axes, x: Any, values: Any, floor: float, unit: str, **line: Any) -> None:
    """Draw values on a logarithmic axis, those at or below a floor on it: with marks, and a line that says what it is.

    Args:
        axes: The panel.
        x: (m,).
        values: (m,), not negative; zeros have no place on such an axis.
        floor: The least that is told apart from zero.
        unit: Of the values.
        line: As for `plot`.
    """
    given = np.asarray(values, dtype=float)
    low = np.flatnonzero(given <= floor)
    # A mark on each of a thousand samples would be a bar.
    marked: dict[str, Any] = {"marker": "v", "markersize": 2.5, "markevery": low[:: 1 + len(low) // 40].tolist()}
    axes.semilogy(x, np.maximum(given, floor), **line, **(marked if low.size else {}))
    if low.size:
        tell_floor(axes, floor, unit)


def tell_floor(axes: Axes, floor: float, unit: str) -> None:
    """Draw the line of a logarithmic axis on which zeros stand, and say what it is."""
    told = f"{floor:g} {unit} or less: zero or rounding"
    if told in [text.get_text() for text in axes.texts]:
        return
    across = axes.get_yaxis_transform()
    axes.hlines(floor, 0.0, 1.0, color="#8C8C8C", linewidth=0.5, linestyle=(0, (1, 1.5)), transform=across)
    place: dict[str, Any] = {"textcoords": "offset points", "ha": "right", "va": "top", "xycoords": across}
    axes.annotate(told, (0.99, floor), (0.0, -2.5), fontsize=5.5, color="#444444", **place)
    axes.update_datalim([(axes.dataLim.x1, floor / ROOM)], updatex=False)
    axes.autoscale_view(scalex=False)


def tell_gaps(figure: Figure) -> None:
    """Say in each panel where a line has a gap because its values are no numbers, and mark lines of one sample."""
    for axes in figure.axes:
        gaps = 0
        for drawn in axes.lines:
            values = np.asarray(drawn.get_ydata(), dtype=float)
            gaps = max(gaps, int(np.sum(~np.isfinite(values))))
            if len(values) == 1:
                drawn.set_marker("o")
                drawn.set_markersize(2.5)
        if gaps:
            words = f"not a number at {gaps} of the samples"
            axes.text(0.01, 0.02, words, transform=axes.transAxes, fontsize=5.5, color="#D55E00")


def save(figure: Figure, folder: str | Path, name: str) -> list[Path]:
    """Write a figure as PDF and PNG and return the two paths.

    Raises:
        FileError: the folder cannot be made or written.
    """
    place = writable_folder(folder)
    paths = [place / f"{name}.pdf", place / f"{name}.png"]
    with mpl.rc_context(_STYLE):
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once, not again for each file
        for path in paths:
            with written_whole(path) as temporary:
                # Without the date in it the same motion gives the same file.
                figure.savefig(temporary, metadata={"CreationDate": None} if path.suffix == ".pdf" else None)
    return paths
