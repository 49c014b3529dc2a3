"""The page of recorded motions: play, pause, scrub, and what the numbers are meanwhile."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import fields
from html import escape

import numpy as np
import viser

from ssm_decouple.errors import InputError
from ssm_decouple.viewing.viewer.page import Page, chosen_pace, one_of
from ssm_decouple.viewing.viewer.plots import Curves, Plots, curves_of, law_colors
from ssm_decouple.viewing.viewer.scene import Scene, usual_exaggeration
from ssm_decouple.viewing.viewer.server import HOST, PORT
from ssm_decouple.viewing.viewer.shapes import LEGEND
from ssm_decouple.viewing.viewer.stage import Shown, Stage

TEXTS = 6  # a second: numbers and cursors, which no eye follows faster
SHORT = 1e-3  # s: a slider has some length, also where a motion has one sample
REST = 1.5  # s: at the end, before the motion begins again
SPEEDS = ("0.5", "1", "2", "5", "10", "20", "50")
INERTIAL, BASE = "inertial space", "the base"
_SHOWN = {
    "axes": "protected directions",
    "rates": "base rates",
    "momentum": "momentum",
    "path": "path",
    "sight": "line of sight",
}


class Player(Page):
    """Recorded motions in the browser, side by side, on one clock. It runs until it is stopped.

    Args:
        scenes: The motions.
        host: Address to listen on.
        port: Where the page is; the next free one if it is taken.
        playing: Whether it plays from the start.

    Attributes:
        url: Where the page is.
        server: The viser server.
        stage: What is drawn.
        time: What time is shown, s; `seek` changes it.
        frames: How many frames have been drawn so far.
    """

    def __init__(self, scenes: Sequence[Scene], host: str = HOST, port: int = PORT, playing: bool = True) -> None:
        super().__init__(host, port)
        self.scenes = list(scenes)
        self.stage = Stage(self.server, self.scenes)
        self.end = max(float(scene.time[-1]) for scene in self.scenes)
        self.time, self.frames, self.pace = 0.0, 0, 10.0
        self.playing, self.riding, self.shown = playing, False, Shown()
        self.exaggeration = usual_exaggeration(self.scenes)
        self._rested = 0.0
        self._told = -1.0
        self._add_controls()
        self._draw()
        self._begin()

    def _add_controls(self) -> None:
        gui = self.server.gui
        titles = {str(scene.motion.attrs.get("title", scene.motion.attrs["robot"])) for scene in self.scenes}
        gui.set_panel_label("ssm-decouple")
        gui.add_html(f'<div style="padding:0.5em 0.9em 0 0.9em"><b>{escape("; ".join(sorted(titles)))}</b></div>')
        self.play_button = gui.add_button("", icon=viser.Icon.PLAYER_PAUSE)
        self.slider = gui.add_slider("time (s)", 0.0, max(self.end, SHORT), max(self.end, SHORT) / 1500, 0.0)
        self.speed = gui.add_dropdown("speed", tuple(f"{word} x" for word in SPEEDS), initial_value="10 x")
        self.repeat = gui.add_checkbox("repeat", True)
        self.view = gui.add_dropdown("seen from", (INERTIAL, BASE), initial_value=INERTIAL)
        self.bending: viser.GuiSliderHandle[float] | None = None
        if any(scene.wings for scene in self.scenes):
            # A slider of powers of ten: bendings differ that much.
            start = float(np.log10(self.exaggeration))
            self.bending = gui.add_slider("", 0.0, float(max(3.0, np.ceil(start))), 0.01, start)
            self.bending.on_update(self._heeding(lambda _: self._on_bending()))
            self._on_bending()
        self.table = gui.add_html(self._table())
        gui.add_html(LEGEND)
        self.chosen = None
        if len(self.scenes) > 1:
            names = tuple(_distinct([scene.name for scene in self.scenes]))
            own = next((i for i, scene in enumerate(self.scenes) if scene.name == "selective"), 0)
            self.chosen = gui.add_dropdown("plots of", names, initial_value=names[own])
            self.chosen.on_update(self._heeding(lambda _: self._replot()))
        self.plots = Plots(self.server, self._curves())
        with gui.add_folder("shown", expand_by_default=False):
            self.checks = {field.name: gui.add_checkbox(_SHOWN[field.name], True) for field in fields(Shown)}
        for check in self.checks.values():
            check.on_update(self._heeding(lambda _: self._on_shown()))
        self.play_button.on_click(self._heeding(lambda _: self.pause() if self.playing else self.play()))
        self.slider.on_update(self._heeding(self._on_slider))
        self.speed.on_update(self._heeding(lambda _: setattr(self, "pace", chosen_pace(self.speed))))
        self.view.on_update(self._heeding(lambda _: self._set_riding()))
        self._label_button()

    def _on_slider(self, event: viser.GuiEvent[viser.GuiSliderHandle[float]]) -> None:
        if event.client is not None:  # a person's hand, and not this player's own cursor
            self.pause()
            self.seek(self.slider.value)

    def _on_bending(self) -> None:
        assert self.bending is not None
        power = self.bending.value
        if not self.bending.min <= power <= self.bending.max:
            raise InputError(f"bending is 10^{power:g}; its slider goes to {self.bending.max:g}")
        self.exaggeration = float(f"{10.0**power:.2g}")
        self.bending.label = f"bending x {self.exaggeration:g}"
        self._wake.set()

    def _on_shown(self) -> None:
        self.shown = Shown(**{name: check.value for name, check in self.checks.items()})
        self._wake.set()

    def _set_riding(self) -> None:
        self.riding = one_of(self.view) == BASE
        self._wake.set()

    def _curves(self) -> list[Curves]:
        chosen = 0 if self.chosen is None else self.chosen.options.index(one_of(self.chosen))
        return curves_of(self.scenes, chosen)

    def _replot(self) -> None:
        self.plots.show(self._curves(), self.time)

    def _label_button(self) -> None:
        self.play_button.label = "pause" if self.playing else "play"
        self.play_button.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY

    def play(self) -> None:
        """Play on from the time shown, from the start where that is the end."""
        if self.time >= self.end:
            self.time = 0.0
        self.playing = True
        self._label_button()
        self._wake.set()

    def pause(self) -> None:
        """Stand still."""
        self.playing = False
        self._label_button()

    def seek(self, time: float) -> None:
        """Show a time, s.

        Raises:
            InputError: it is not a number.
        """
        if np.isnan(time):
            raise InputError("the time to show is not a number; give seconds since the start")
        self.time = float(np.clip(time, 0.0, self.end))
        self._wake.set()

    def _tick(self, elapsed: float, woken: bool) -> None:
        self._wake.clear()
        if self._advance(elapsed) or woken:
            self._draw()

    def _advance(self, elapsed: float) -> bool:
        """Move the clock on, and say whether it moved; it stands while nobody looks."""
        if not self.playing or not self.server.get_clients():
            return False
        if self.time < self.end:
            self.time = min(self.end, self.time + elapsed * self.pace)
            self._rested = 0.0
            return True
        self._rested += elapsed
        if self._rested < REST:
            return False
        if self.repeat.value:
            self.time = 0.0
            return True
        self.pause()
        return False

    def _draw(self) -> None:
        self.stage.draw(self.time, self.riding, self.exaggeration, self.shown)
        self.frames += 1
        now = time.monotonic()
        if now - self._told > 1.0 / TEXTS or not self.playing:
            self._told = now
            with self.server.atomic():
                self.slider.value = self.time  # type: ignore[misc]  # viser's setter stands in a class between
                self.table.content = self._table()
                self.plots.move(self.time)

    def _table(self) -> str:
        """Return the numbers of the time shown, a row a motion."""
        rows = [
            _row(scene, color, self.time)
            for scene, color in zip(self.scenes, law_colors([scene.name for scene in self.scenes]), strict=True)
        ]
        heads = "".join(
            f'<th style="text-align:right">{head}</th>' for head in ("left", "turned", "|w_sub|", "momentum")
        )
        units = "".join(f'<td style="text-align:right">{unit}</td>' for unit in ("mm", "deg", "rad/s", "N m s"))
        return (
            '<div style="padding:0.2em 0.9em"><table style="font-size:0.8em;width:100%;border-spacing:0.2em 0">'
            f'<tr><th style="text-align:left">t = {self.time:.1f} s</th>{heads}</tr>'
            f'<tr style="opacity:0.6"><td></td>{units}</tr>{"".join(rows)}</table></div>'
        )


def numbers(scene: Scene, now: float) -> tuple[str, str, str, str]:
    """Return in words distance to the target (mm, or with its unit), rotation (deg), protected rate and momentum."""
    i = int(np.clip(np.searchsorted(scene.time, now, side="right") - 1, 0, len(scene.time) - 1))
    left = float(scene.distance_shown[i])
    protected = "-" if scene.protected_rate is None else f"{scene.protected_rate[i]:.0e}"
    momentum = f"{np.linalg.norm(scene.angular_momentum[i]):.3g}" if scene.has_momentum else "zero"
    told = f"{left:.1f}" if scene.distance_unit == "mm" else f"{left:.2g} {scene.distance_unit}"
    return told if np.isfinite(left) else "-", f"{scene.turned_deg[i]:.3f}", protected, momentum


def status(scene: Scene, now: float) -> str:
    """Return how the motion stands at a time: under way, arrived or stalled."""
    outcome, when = scene.motion.attrs.get("outcome", "running"), float(scene.motion.attrs.get("outcome_time", np.inf))
    if outcome == "running" or now < when:
        return "under way"
    return {"converged": "arrived", "stalled": "stalled"}[outcome]


def _row(scene: Scene, color: str, now: float) -> str:
    cells = "".join(f'<td style="text-align:right">{value}</td>' for value in numbers(scene, now))
    state = status(scene, now)
    shade = {"arrived": "#2CA02C", "stalled": "#E8590C"}.get(state, "inherit")
    return (
        f'<tr><td><span style="color:{color}">&#9632;</span> {escape(scene.name)}'
        f'<br><span style="color:{shade};font-size:0.9em">{state}</span></td>{cells}</tr>'
    )


def _distinct(names: Sequence[str]) -> list[str]:
    return [name if names.count(name) == 1 else f"{name} ({i + 1})" for i, name in enumerate(names)]
