"""The curves beside the picture, with a cursor at the time that is shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

import numpy as np
import viser
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from ssm_decouple.viewing.angles import JOINT_UNITS, joint_kinds, unwrapped
from ssm_decouple.viewing.style import AXIS_COLORS, LAW_LINES, joint_colors
from ssm_decouple.viewing.viewer.scene import Scene

Floats = NDArray[np.float64]

POINTS = 250  # of a curve: more than the plot has pixels to show
HEIGHT = 118  # pixels
FLOOR = 1e-21  # rad/s: zero on a logarithmic axis
FLOORED = "; -21 is 1e-21 or less: zero or rounding"
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
        everything = np.concatenate([np.zeros(0), *(line[np.isfinite(line)] for _, _, line in self.lines)])
        if not everything.size:
            return -1.0, 1.0
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
            if line is not None and np.any(np.isfinite(line))
        )

    scene, motion = scenes[chosen], scenes[chosen].motion
    whose = f" of {scene.name}" if len(scenes) > 1 else ""
    attitude = np.rad2deg(unwrapped(motion.base_rpy.values))
    # Powers of ten, since the axes of a page have no room for longer labels.
    protected = [None if s.protected_rate is None else np.log10(np.maximum(s.protected_rate, FLOOR)) for s in scenes]
    low = any(s.protected_rate is not None and np.any(s.protected_rate <= FLOOR) for s in scenes)
    units = {scene.distance_unit for scene in scenes}
    plots = [
        Curves(f"left ({'; '.join(sorted(units))})", time, of_all([s.distance_shown for s in scenes])),
        Curves(f"|w_sub| (10^x rad/s{FLOORED if low else ''})", time, of_all(protected)),
        Curves(
            f"base attitude{whose} (deg)",
            time,
            tuple(
                (name, color, np.interp(time, scene.time, attitude[:, i]))
                for i, (name, color) in enumerate(AXIS_COLORS.items())
            ),
        ),
    ]
    shades = [_lighter(to_hex(color)) for color in joint_colors(motion.sizes["joint"])]
    own, everywhere = joint_kinds(motion), {kind for s in scenes for kind in joint_kinds(s.motion)}
    for kind in [kind for kind in JOINT_UNITS if kind in everywhere]:
        name, unit, factor = JOINT_UNITS[kind]
        rates = factor * motion.joint_rates.values
        lines = tuple(
            (
                label.replace("joint_", ""),
                shades[i],
                np.interp(time, scene.time, rates[:, i]),
            )
            for i, label in enumerate(map(str, motion.joint.values))
            if own[i] == kind
        )
        plots.append(Curves(f"{name.split()[0]} rates{whose} ({unit}/s)", time, lines))
    always = 2 + 1  # of the motions together, and the attitude: those without lines have none for any motion
    return [plot for i, plot in enumerate(plots) if plot.lines or i >= always]


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
    names = " ".join(f'<span style="color:{color}">&#9632;</span>&nbsp;{escape(name)}' for name, color, _ in lines)
    return (
        f'<div style="font-size:0.78em;padding:0.25em 0.9em 0 0.9em;line-height:1.35">'
        f"<b>{escape(title)}</b> &ensp;{names}</div>"
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
