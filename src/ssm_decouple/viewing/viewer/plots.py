"""The curves beside the picture, with a cursor at the time that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from ssm_decouple.viewing.style import AXIS_COLORS, LAW_LINES, joint_colors
from ssm_decouple.viewing.viewer.scene import Scene

Floats = NDArray[np.float64]

POINTS = 250  # of a curve: more than the plot has pixels to show
HEIGHT = 118  # pixels
FLOOR = 1e-21  # rad/s: zero on a logarithmic axis
AXES: Any = ({"size": 24}, {"size": 52})
_OTHERS = ("#56B4E9", "#CC79A7", "#E69F00", "#009E73", "#D55E00", "#F0E442")


@dataclass(frozen=True)
class Curves:
    """One plot.

    Attributes:
        title: Quantity and unit.
        time: (p,), s, rising.
        lines: Name, colour and values (p,) of each curve.
    """

    title: str
    time: Floats
    lines: tuple[tuple[str, str, Floats], ...]

    @property
    def range(self) -> tuple[float, float]:
        """What the vertical axis spans: a little more than the curves."""
        everything = np.concatenate([line for _, _, line in self.lines])
        low, high = float(everything.min()), float(everything.max())
        room = 0.06 * (high - low) or max(1e-9, 0.06 * abs(high))
        return low - room, high + room

    def with_cursor(self, now: float) -> tuple[Floats, ...]:
        """Return the columns of the plot: time, curves, and a cursor that is a vertical line at `now`.

        The line needs two points at one time, which the other curves are given too.
        """
        at = int(np.searchsorted(self.time, now))
        here = np.insert(self.time, at, [now, now])
        values = [np.insert(line, at, [np.interp(now, self.time, line)] * 2) for _, _, line in self.lines]
        cursor = np.full(here.shape, np.nan)
        cursor[at : at + 2] = self.range
        return (here, *values, cursor)


def curves_of(scenes: Sequence[Scene], chosen: int) -> list[Curves]:
    """Return the plots of several motions: distances and protected rates of all, the rest of one of them."""
    end = max(float(scene.time[-1]) for scene in scenes)
    time = np.linspace(0.0, end, POINTS)
    colors = law_colors([scene.name for scene in scenes])

    def of_all(values: Sequence[Floats | None]) -> tuple[tuple[str, str, Floats], ...]:
        return tuple(
            (scene.name, color, np.interp(time, scene.time, line))
            for scene, color, line in zip(scenes, colors, values, strict=True)
            if line is not None and np.all(np.isfinite(line))
        )

    scene, motion = scenes[chosen], scenes[chosen].motion
    whose = f" of {scene.name}" if len(scenes) > 1 else ""
    attitude = np.rad2deg(np.unwrap(motion.base_rpy.values, axis=0))
    rates = np.rad2deg(motion.joint_rates.values)
    shades = [to_hex(color) for color in joint_colors(rates.shape[1])]
    shades = [_lighter(shade) for shade in shades]
    # Powers of ten, since the axes of a page have no room for longer labels.
    protected = [None if s.protected_rate is None else np.log10(np.maximum(s.protected_rate, FLOOR)) for s in scenes]
    plots = [
        Curves("left (mm)", time, of_all([1e3 * s.distance for s in scenes])),
        Curves("|w_sub| (10^x rad/s)", time, of_all(protected)),
        Curves(
            f"base attitude{whose} (deg)",
            time,
            tuple(
                (name, color, np.interp(time, scene.time, attitude[:, i]))
                for i, (name, color) in enumerate(AXIS_COLORS.items())
            ),
        ),
        Curves(
            f"joint rates{whose} (deg/s)",
            time,
            tuple(
                (str(name).replace("joint_", ""), shade, np.interp(time, scene.time, rates[:, i]))
                for i, (name, shade) in enumerate(zip(motion.joint.values, shades, strict=True))
            ),
        ),
    ]
    return [plot for plot in plots if plot.lines]


class Plots:
    """The plots on the page."""

    def __init__(self, server: viser.ViserServer, curves: Sequence[Curves]) -> None:
        self.curves = list(curves)
        self.captions: list[viser.GuiHtmlHandle] = []
        self.handles: list[viser.GuiUplotHandle] = []
        for plot in self.curves:
            self.captions.append(server.gui.add_html(caption(plot.title, plot.lines)))
            self.handles.append(
                server.gui.add_uplot(
                    plot.with_cursor(0.0),
                    _series(plot),
                    scales=_scales(plot),
                    axes=AXES,
                    legend={"show": False},
                    height=HEIGHT,
                    padding=(6, 10, 0, 0),
                )
            )

    def show(self, curves: Sequence[Curves], now: float) -> None:
        """Draw other curves of the same kind."""
        self.curves = list(curves)
        for plot, text, handle in zip(self.curves, self.captions, self.handles, strict=True):
            text.content = caption(plot.title, plot.lines)
            if len(handle.series) != len(plot.lines) + 2:
                handle.series = _series(plot)
            handle.scales = _scales(plot)
        self.move(now)

    def move(self, now: float) -> None:
        """Put the cursors at a time, s."""
        for plot, handle in zip(self.curves, self.handles, strict=True):
            handle.data = plot.with_cursor(float(np.clip(now, plot.time[0], plot.time[-1])))


def caption(title: str, lines: Sequence[tuple[str, str, Floats]]) -> str:
    """Return what stands above a plot: what it shows, and which colour is which."""
    names = " ".join(f'<span style="color:{color}">&#9632;</span>&nbsp;{name}' for name, color, _ in lines)
    return (
        f'<div style="font-size:0.78em;padding:0.25em 0.9em 0 0.9em;line-height:1.35">'
        f"<b>{title}</b> &ensp;{names}</div>"
    )


def law_colors(names: Sequence[str]) -> list[str]:
    """Return a colour for each motion, the figures' own where it is named as a law is."""
    spare = iter(_OTHERS * (1 + len(names) // len(_OTHERS)))
    return [str(LAW_LINES[name]["color"]) if name in LAW_LINES else next(spare) for name in names]


def _series(plot: Curves) -> tuple[Any, ...]:
    lines = [{"label": name, "stroke": color, "width": 1.6, "points": {"show": False}} for name, color, _ in plot.lines]
    cursor = {"label": "now", "stroke": "#8A93A3", "width": 1.2, "points": {"show": False}}
    return ({"label": "t (s)"}, *lines, cursor)


def _scales(plot: Curves) -> Any:
    return {"x": {"time": False}, "y": {"range": plot.range}}


def _lighter(color: str) -> str:
    """Return a colour that can be read on a dark page."""
    red, green, blue = (int(color[i : i + 2], 16) for i in (1, 3, 5))
    return "#" + "".join(f"{round(0.7 * x + 0.3 * 255):02x}" for x in (red, green, blue))
