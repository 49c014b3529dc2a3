"""A law at work: drag the target and the arm follows, under a protection that can be changed while it moves."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import viser
from numpy.typing import NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import Schedule
from ssm_decouple.control.task import PoseTask, PositionTask
from ssm_decouple.errors import InputError
from ssm_decouple.model.catalogue import models
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.simulation.motion import judge, twist_along
from ssm_decouple.studies.case import Case, cases, load_case
from ssm_decouple.viewing.viewer.page import Page, chosen_pace, one_of
from ssm_decouple.viewing.viewer.parts import Part, antenna, drawn_reach, spacecraft_parts
from ssm_decouple.viewing.viewer.plots import AXES, FLOOR, FLOORED, HEIGHT, POINTS, caption
from ssm_decouple.viewing.viewer.scene import Vectors, body_poses, rotated, split_rate
from ssm_decouple.viewing.viewer.server import HOST, PORT
from ssm_decouple.viewing.viewer.shapes import (
    FAINT,
    LEGEND,
    LONGEST,
    PATH,
    SIGHT,
    TARGET,
    Arrows,
    Trail,
    add_lines,
    add_part,
    sight_line,
)

Floats = NDArray[np.float64]

TEXTS = 4  # a second
PACES = ("1", "2", "5", "10", "20")
KEPT = 4000  # samples of the past, for the plots and to judge what has stalled
TRAIL = 300
USUAL = 0.2  # of the base rate that one joint causes at its limit: the longest arrow, until there has been more
QUIET = 1e-7  # rad/s: slower joints are at rest on a page
FOLLOWED = 60.0  # s: what the plots show
FARTHEST = 1e9  # m: no target is dragged farther
FASTEST = 1e9  # m/s, rad/s: what is faster, or no number, is no motion
_PLOTS = (("left (mm), the last minute", "#56B4E9"), (f"|w_sub| (10^x rad/s{FLOORED}), the last minute", "#CC79A7"))


@dataclass
class _Past:
    """What has been since the target or the protection was changed last, and for the plots a little longer."""

    time: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    error: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    rate: deque[float] = field(default_factory=lambda: deque(maxlen=KEPT))
    trail: deque[Floats] = field(default_factory=lambda: deque(maxlen=TRAIL))
    changed: float = 0.0


class Live(Page):
    """A case or a robot whose target is dragged in the browser. It runs until it is stopped.

    The law is asked each `dt` of its own, and at once when the target or the protection changes; in between its joint
    rates are held. A law that plans for a hold is asked at the end of each hold alone. Where the law cannot be asked,
    because it raises or says what is no number, the arm stands still and the page says why, until it can.

    Args:
        case: The case.
        host: Address to listen on.
        port: Where the page is; the next free one if it is taken.
        mesh_folders: Where the meshes of the URDF are looked for.

    Attributes:
        url: Where the page is.
        server: The viser server.
        q: Configuration (nq,).
        clock: Time of the motion, s.
        answers: How long it took from each change of the target until the poses that answer it were sent, s.

    Raises:
        InputError: the case has other tasks than one position or pose of the end-effector.
    """

    def __init__(
        self, case: Case, host: str = HOST, port: int = PORT, mesh_folders: tuple[str | Path, ...] = ()
    ) -> None:
        self.case, self.robot = case, case.robot
        self.laws = laws_to_choose(case)
        self.chosen = next((name for name in self.laws if name.startswith("the case")), "none")
        own = self.laws[self.chosen]
        task = own.tasks[0]
        if len(own.tasks) != 1 or not isinstance(task, PositionTask | PoseTask) or own.layout.tool_target is None:
            kinds = ", ".join(type(task).__name__ for task in own.tasks)
            raise InputError(
                f"case '{case.name}' has the tasks {kinds}; what is dragged is one position or pose of the end-effector"
            )
        self.posed = isinstance(task, PoseTask)
        self.target: Any = case.target if self.posed else np.array(case.target, dtype=float)
        self.q, self.clock, self.held = case.start(), 0.0, 0.0
        self.pace, self.past, self.answers = 5.0, _Past(), deque[float](maxlen=1000)
        self.values: Floats = np.zeros(own.size)
        self.frames = 0
        self._data = self.robot.model.createData()
        self._asked: float | None = None
        self._in_vain = False  # whether the law could not be asked the last time
        self._lock, self._told = threading.RLock(), 0.0
        super().__init__(host, port)
        self._add_spacecraft(spacecraft_parts(self.robot, case.turned, mesh_folders))
        self._add_controls()
        self._ask()
        self._draw()
        self._begin()

    @property
    def law(self) -> SelectiveLaw:
        """The law that is at work."""
        return self.laws[self.chosen]

    @property
    def end_effector(self) -> Floats:
        """Where the end-effector is (3,), m."""
        with self._lock:
            return self.robot.frame_pose(self.q).translation.copy()

    def drag(self, position: Floats, wxyz: Floats | None = None) -> None:
        """Move the target, as a hand on its handle does.

        Args:
            position: (3,), m, inertial axes.
            wxyz: Orientation (4,), where the case asks for one.

        Raises:
            InputError: they are not finite numbers, too far, or the orientation is none; the target stays where it is.
        """
        place = _finite("position of the target", position, 3)
        if np.abs(place).max() > FARTHEST:
            raise InputError(f"the target is {np.abs(place).max():.3g} m away; {FARTHEST:g} m is the farthest")
        turn = None
        if self.posed and wxyz is not None:
            given = _finite("orientation of the target", wxyz, 4)
            length = float(np.linalg.norm(given))
            if length < 1e-6:
                raise InputError(f"the orientation of the target is {given.tolist()}; a quaternion w x y z is no zero")
            turn = pin.Quaternion(*map(float, given / length)).toRotationMatrix()
        with self._lock:
            if self.posed:
                self.target = pin.SE3(self.target.rotation if turn is None else turn, place)
            else:
                self.target = place
            self._asked = time.perf_counter() if self._asked is None else self._asked
            self.past.changed = self.clock
        self._wake.set()

    def protect(self, name: str) -> None:
        """Change the protection.

        Args:
            name: One of `laws`, or what `Protection.parse` reads, such as "pitch" or "0.6,0,0.8": a law is made of it.

        Raises:
            InputError: it is neither, or no law can protect it; the protection stays what it is.
        """
        with self._lock:
            if name not in self.laws:
                self.laws[name] = self.case.make_law(Protection.parse(name))
                self.protection.options = tuple(self.laws)
            self.chosen = name
            self.past.changed = self.clock
        self.protection.value = name  # type: ignore[misc]  # viser's setter stands in a class between
        self._wake.set()

    def _on_own(self, event: viser.GuiEvent[Any]) -> None:
        self.protect(self.own.value.strip())

    def _on_handle(self, event: viser.TransformControlsEvent) -> None:
        try:
            self.drag(self.handle.position, self.handle.wxyz)
        except InputError:
            self.handle.position = self.target.translation if self.posed else self.target
            if self.posed:
                self.handle.wxyz = pin.Quaternion(self.target.rotation).coeffs()[[3, 0, 1, 2]]
            raise

    def _on_protection(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is None:  # the page's own doing
            return
        try:
            self.protect(one_of(self.protection))
        except Exception:
            self.protection.value = self.chosen  # type: ignore[misc]  # viser's setter stands in a class between
            raise

    def restart(self) -> None:
        """Put the spacecraft back where the case starts."""
        with self._lock:
            self.q, self.clock, self.held, self.past = self.case.start(), 0.0, 0.0, _Past()
            self.values = np.zeros(self.law.size)
        self._wake.set()

    def _add_spacecraft(self, parts: list[Part]) -> None:
        scene, q = self.server.scene, self.q
        self.joints = (1, *sorted({part.joint for part in parts} - {1}))
        self.bodies = [scene.add_frame(f"/spacecraft/body_{b}", show_axes=False) for b in range(len(self.joints))]
        for i, part in enumerate(parts):
            body = self.joints.index(part.joint)
            add_part(self.server, f"/spacecraft/body_{body}/{part.name or 'part'}_{i}", part)
        self.size = max(2.0 * drawn_reach(self.robot), _width(parts))
        found = antenna(parts)
        if found is not None:
            line, name = sight_line(found[1], self.size), "/spacecraft/body_0/line_of_sight"
            add_lines(self.server, name, line, SIGHT, 0.0018 * self.size, position=found[0])
        self.arrows = Arrows(self.server, "/spacecraft", self.size, parts)
        self._largest = USUAL * self._fastest_joint()
        self._protected: str | None = None
        reach, place = drawn_reach(self.robot), self.robot.shoulder_position(q)
        start = self.target.translation if self.posed else self.target
        self.handle = scene.add_transform_controls(
            "/target",
            scale=0.28 * reach,
            line_width=4.0,
            disable_rotations=not self.posed,
            depth_test=False,
            position=start,
            wxyz=pin.Quaternion(self.target.rotation).coeffs()[[3, 0, 1, 2]] if self.posed else (1.0, 0.0, 0.0, 0.0),
        )
        self.handle.on_update(self._heeding(self._on_handle))
        scene.add_icosphere("/target/ball", radius=0.035 * reach, color=TARGET)
        self.trail = Trail(self.server, "/trail", TRAIL, PATH, 0.004 * reach)
        self.gap = Trail(self.server, "/gap", 2, FAINT, 0.002 * reach)
        middle = 0.5 * (place + start)
        camera = self.server.initial_camera
        camera.look_at = middle
        camera.fov = np.deg2rad(30.0)
        azimuth, elevation = np.deg2rad(152.0), np.deg2rad(22.0)
        back = [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        camera.position = middle + 4.6 * reach * np.array(back)

    def _add_controls(self) -> None:
        gui = self.server.gui
        gui.set_panel_label("ssm-decouple live")
        gui.add_html(
            f'<div style="padding:0.5em 0.9em 0 0.9em"><b>{escape(self.case.title)}</b><br>'
            '<span style="font-size:0.85em;opacity:0.75">drag the target by its arrows</span></div>'
        )
        self.protection = gui.add_dropdown("protect", tuple(self.laws), initial_value=self.chosen)
        self.own = gui.add_text("own axes", "0.6,0,0.8", hint="a name, three numbers a rotation, or six a twist")
        own = gui.add_button("protect own axes", icon=viser.Icon.SHIELD)
        self.speed = gui.add_dropdown("speed", tuple(f"{word} x" for word in PACES), initial_value="5 x")
        back = gui.add_button("back to the start", icon=viser.Icon.REFRESH)
        self.state = gui.add_html(self._state())
        gui.add_html(LEGEND)
        self._add_plots()
        self.protection.on_update(self._heeding(self._on_protection, "not protected"))
        own.on_click(self._heeding(self._on_own, "not protected"))
        self.speed.on_update(self._heeding(lambda _: setattr(self, "pace", chosen_pace(self.speed))))
        back.on_click(self._heeding(lambda _: self.restart()))

    def _fastest_joint(self) -> float:
        """Return the fastest, rad/s, that one joint alone turns the base at the start."""
        rates = np.where(np.isfinite(self.law.rate_limits), self.law.rate_limits, 1.0)
        return float(np.max(rates * np.linalg.norm(self.robot.coupling(self.q).J_rc, axis=0)))

    def _tick(self, elapsed: float, woken: bool) -> None:
        self.advance(min(elapsed, 0.25))

    def advance(self, elapsed: float) -> None:
        """Let the motion go on by some time of the clock on the wall, s, and draw it.

        Raises:
            Exception: what the law raised; the arm stands still.
        """
        with self._lock:
            woken, asked = self._wake.is_set(), self._asked
            self._wake.clear()
            self._asked = None
            try:
                if self._in_vain or (woken and self.law.sample_time is None):
                    self._ask()
                self._go_on(elapsed * self.pace)
            finally:
                self._draw()
        if asked is not None:
            self.server.flush()
            self.answers.append(time.perf_counter() - asked)

    def _go_on(self, left: float) -> None:
        model, dt = self.robot.model, self.case.dt
        while left > 1e-12:
            h = min(left, dt - self.held)
            self.q = pin.integrate(model, self.q, h * self.values[: model.nv])
            self.clock, self.held, left = self.clock + h, self.held + h, left - h
            if self.held >= dt - 1e-12:
                self._ask()

    def _ask(self) -> None:
        """Ask the law and remember what it says; while it cannot be asked the arm stands still.

        Raises:
            InputError: its joint rates are no motion.
            Exception: what the law raises.
        """
        law, n = self.law, self.robot.n_joints
        target = law.layout.flat_targets(self.target) if self.posed else self.target
        previous, said = self.values[6 : 6 + n].copy(), np.zeros(law.size)
        self.values, self._in_vain, self.held = np.zeros(law.size), True, 0.0
        law.evaluate(self.q, target, law.layout.flat_velocities(None), said, previous, time=self.clock)
        if not np.all(np.abs(said[: 6 + n]) < FASTEST):
            raise InputError("the law has no joint rates for this target; move it, or go back to the start")
        self.values, self._in_vain = said, False
        results = self.values[6 + n :]
        past = self.past
        past.time.append(self.clock)
        past.error.append(float(np.linalg.norm(results[kernel.ERRORS : kernel.ERRORS + law.layout.size])))
        rate = self._own_rate()
        if self.chosen.startswith("the case"):  # of a schedule's directions those count that are fully protected
            rate = rate[self._shares() == 1.0]
        past.rate.append(float(np.abs(rate).max(initial=0.0)))
        past.trail.append(results[kernel.POSITION : kernel.POSITION + 3].copy())

    def _own_rate(self) -> Floats:
        """Return the base rate (k,) along the directions of the case, or of the present law where it has none."""
        own = next((law for name, law in self.laws.items() if name.startswith("the case")), self.law)
        U_twist, frame = own.directions
        return twist_along(U_twist, frame, self.values[None, :6], self.q[None], self.robot)[0]

    def _shares(self) -> Floats:
        """Return how far each direction of the present law is protected now (k,), 0 to 1."""
        told = self.law.shares(np.array([self.clock]), self.q[None])
        return np.ones(self.law.directions[0].shape[1]) if told is None else told[0]

    def _draw(self) -> None:
        moved = body_poses(self.robot, self.q[None], self.joints)[0]
        error = self.past.trail[-1] if self.past.trail else self.end_effector
        with self.server.atomic():
            for body, pose in zip(self.bodies, moved, strict=True):
                body.position, body.wxyz = pose[:3], pose[3:]
            if self._protected != self.chosen:
                self.arrows.protect(self.law.directions[0])
                self._protected = self.chosen
            vectors = self._vectors(moved[0])
            self._largest = max(self._largest, float(np.linalg.norm(vectors.free + vectors.protected)))
            self.arrows.draw(vectors, LONGEST * self.size / self._largest)
            now = time.monotonic()
            if now - self._told > 1.0 / TEXTS:
                self._told = now
                place = self.target.translation if self.posed else self.target
                self.gap.draw(np.array([error, place]))
                self.trail.draw(np.array(self.past.trail))
                self.state.content = self._state()
                columns = self._columns()
                for plot, values in zip(self.plots, columns[1:], strict=True):
                    plot.data = (columns[0], values)
        self.frames += 1

    def _vectors(self, base: Floats) -> Vectors:
        """Return what the arrows show, of the base's pose (7,): the rates that the law commands, and its momentum."""
        directions, frame = self.law.directions
        axes = base[3:] if frame == "base" else self._axes(frame)
        shares = self._shares()
        rate = rotated(base[3:], self.values[3:6])
        free, protected = split_rate(rate[None], directions[:, shares > 0], axes[None])[:, 0]
        return Vectors(base[:3], base[3:], axes, shares, free, protected, self.law.momentum[3:])

    def _axes(self, frame: str) -> Floats:
        if frame == "inertial":
            return np.array([1.0, 0.0, 0.0, 0.0])
        turn = self.robot.frame_pose(self.q, frame).rotation
        return pin.Quaternion(turn).coeffs()[[3, 0, 1, 2]]

    def outcome(self) -> str:
        """Return how the motion towards the target stands: "under way", "arrived", "stalled" or "standing".

        It is standing where the law cannot be asked.
        """
        with self._lock:
            if self._in_vain:
                return "standing"
            times, errors = np.array(self.past.time), np.array(self.past.error)
            since = times >= self.past.changed - 1e-9
            if not since.any():
                return "under way"
            tolerance = float(self.case.simulation.get("arrival_tolerance", 0.01))
            name = judge(times[since], errors[since], tolerance, 1.0 / self.law.layout.slowest_gain).name
        return {"converged": "arrived", "stalled": "stalled", "running": "under way"}[name]

    def numbers(self) -> Mapping[str, float]:
        """Return what the law says now: left (m), sigma (m), rho (m2), rate (rad/s) and turned (rad)."""
        with self._lock:
            place = 6 + self.robot.n_joints + kernel.ERRORS + self.law.layout.size
            turned = 2.0 * np.arctan2(np.linalg.norm(self.q[3:6]), abs(self.q[6]))
            return {
                "left": self.past.error[-1] if self.past.error and not self._in_vain else float("nan"),
                "sigma": float(self.values[place]),
                "rho": float(self.values[place + 1]),
                "rate": self.past.rate[-1] if self.past.rate else 0.0,
                "turned": float(turned),
            }

    def _state(self) -> str:
        told, state = self.numbers(), self.outcome()
        shade = {"arrived": "#2CA02C", "stalled": "#E8590C"}.get(state, "inherit")
        singular = told["rho"] > 0
        if state == "stalled":
            state = f"stalled, {1e3 * told['left']:.0f} mm left" + (": no way on under this protection" * singular)
        rows = {
            "left": f"{1e3 * told['left']:.1f} mm" if np.isfinite(told["left"]) else "-",
            "sigma": f"{told['sigma']:.1e} m" + (" (singular: damping acts)" if singular else ""),
            "|w_sub|": f"{told['rate']:.0e} rad/s",
            "base turned": f"{np.rad2deg(told['turned']):.3f} deg",
            "time": f"{self.clock:.1f} s",
        }
        cells = "".join(
            f'<tr><td>{name}</td><td style="text-align:right">{escape(value)}</td></tr>' for name, value in rows.items()
        )
        return (
            f'<div style="padding:0.2em 0.9em;min-height:9.5em"><b style="color:{shade}">{escape(state)}</b>'
            f'<table style="font-size:0.85em;width:100%">{cells}</table></div>'
        )

    def _add_plots(self) -> None:
        self.plots: list[viser.GuiUplotHandle] = []
        for column, (title, color) in enumerate(_PLOTS, 1):
            self.server.gui.add_html(caption(title, ()))
            series: Any = ({}, {"stroke": color, "width": 1.6, "points": {"show": False}})
            self.plots.append(
                self.server.gui.add_uplot(
                    (self._columns()[0], self._columns()[column]),
                    series,
                    scales={"x": {"time": False, "range": (-FOLLOWED, 0.0)}},
                    axes=AXES,
                    legend={"show": False},
                    height=HEIGHT,
                    padding=(6, 10, 0, 0),
                )
            )

    def _columns(self) -> tuple[Floats, Floats, Floats]:
        """Return of the last minute: time before now (s), distance (mm), protected rate (power of ten)."""
        with self._lock:
            times, errors, rates = (np.array(list(x)) for x in (self.past.time, self.past.error, self.past.rate))
        if len(times) < 2:
            return np.array([-1.0, 0.0]), np.full(2, np.nan), np.full(2, np.nan)
        grid = np.linspace(max(times[0], times[-1] - FOLLOWED), times[-1], POINTS)
        powers = np.log10(np.maximum(rates, FLOOR))
        return grid - times[-1], 1e3 * np.interp(grid, times, errors), np.interp(grid, times, powers)


def laws_to_choose(case: Case) -> dict[str, SelectiveLaw]:
    """Return the laws that one can switch between, by the name of their protection."""
    own: Protection | Schedule = case.protection
    chosen: dict[str, Protection | Schedule] = {"none": Protection("none"), "yaw": Protection("yaw")}
    if own.k:
        chosen["the case's own"] = own
    chosen["all rotation"] = Protection("all")
    return {name: case.make_law(protection) for name, protection in chosen.items()}


def case_of(source: str) -> Case:
    """Return a case by its name or path, or for a robot one that starts bent and stands still.

    Raises:
        InputError: it is neither.
        ModelError: a robot that cannot be read.
    """
    if (
        source not in models()
        and Path(source).suffix.lower() not in (".urdf", ".xml", ".mjcf")
        and not _is_robot_toml(source)
    ):
        return load_case(source)
    from ssm_decouple.model.catalogue import load_robot

    robot = load_robot(source)
    joints = np.linspace(0.4, 1.2, robot.n_joints)
    for place, (low, high) in enumerate(robot.position_limits):
        joints[place] = np.clip(joints[place], low, high) if np.isfinite(low + high) else joints[place]
    start = robot.frame_pose(robot.configuration(joints)).translation
    limited = bool(np.all(np.isfinite(robot.rate_limits)))
    return Case(
        name=robot.name,
        title=f"{robot.name}: drag the target",
        robot_source=source,
        end_effector=None,
        joints=joints,
        base_position=(0.0, 0.0, 0.0),
        base_rpy=(0.0, 0.0, 0.0),
        target=tuple(map(float, start)),
        protection=Protection("none"),
        law={} if limited else {"rate_limit": float(np.deg2rad(5.0))},
        duration=150.0,
        dt=0.1,
    )


def _is_robot_toml(source: str) -> bool:
    path = Path(source)
    if source in cases() or path.suffix.lower() != ".toml" or not path.is_file():
        return False
    import tomllib

    try:
        return "urdf" in tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError):
        return False


def live(source: str | Case, host: str = HOST, port: int = PORT, mesh_folders: tuple[str | Path, ...] = ()) -> Live:
    """Open the page of a law at work.

    Args:
        source: A case, its name or path, or a robot's.
        host: Address to listen on; the loopback can be reached from this machine alone.
        port: Where the page is; the next free one if it is taken.
        mesh_folders: Where the meshes of the URDF are looked for.
    """
    return Live(source if isinstance(source, Case) else case_of(source), host, port, mesh_folders)


def _finite(what: str, given: Any, count: int) -> Floats:
    try:
        numbers = np.array(given, dtype=float)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (count,) or not np.all(np.isfinite(numbers)):
        raise InputError(f"the {what} is {given!r}; it needs {count} finite numbers")
    return numbers


def _width(parts: list[Part]) -> float:
    """Return how wide the base's shapes are, m."""
    corners = [part.corners for part in parts if part.joint == 1]
    return float(np.ptp(np.vstack(corners), axis=0).max()) if corners else 1.0
