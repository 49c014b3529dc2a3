"""What a robot is made of, and what is suspicious or impossible in its description."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssm_decouple.errors import DecoupleError
from ssm_decouple.model.appendage import inspect_remaining_bus, remaining_bus
from ssm_decouple.model.inspection import inspect_urdf
from ssm_decouple.model.massless import massless_joints, massless_root
from ssm_decouple.model.plain import said_of
from ssm_decouple.model.urdf import Finding, parse_urdf, root_link, tip_links

if TYPE_CHECKING:
    from ssm_decouple.model.robot import Robot


@dataclass(frozen=True)
class JointReport:
    """One joint: its type, the link that it moves, that link's mass (kg) and its limits (rad or m, per s)."""

    name: str
    type: str
    moves: str
    mass: float
    lower: float
    upper: float
    rate_limit: float


@dataclass(frozen=True)
class AppendageReport:
    """One flexible appendage: its mass (kg), size (m), segments and frequencies (Hz) with the base held."""

    name: str
    mass: float
    span: float
    chord: float
    segments: int
    frequencies: tuple[float, ...]


@dataclass(frozen=True)
class FlexibleReport:
    """What bends.

    Attributes:
        appendages: One entry an appendage.
        frequencies: Of all of them together on the floating base, joints held at zero, Hz, rising.
        bus_mass: What the root link weighs without them, kg.
        bus_inertia: Its principal moments (3,) about its own centre of mass, kg m2.
    """

    appendages: tuple[AppendageReport, ...]
    frequencies: tuple[float, ...]
    bus_mass: float
    bus_inertia: tuple[float, ...]

    @classmethod
    def of_robot(cls, robot: Robot) -> FlexibleReport:
        """Report on the appendages of a robot that has some."""
        from ssm_decouple.model.plant import Plant

        bus = remaining_bus(parse_urdf(robot.urdf, robot.name), robot.appendages)
        return cls(
            appendages=tuple(
                AppendageReport(a.name, a.mass, a.span, a.chord, a.segments, tuple(a.frequencies.tolist()))
                for a in robot.appendages
            ),
            frequencies=tuple(Plant.of(robot).frequencies().tolist()),
            bus_mass=bus.mass,
            bus_inertia=tuple(np.linalg.eigvalsh(bus.inertia).tolist()),
        )

    def lines(self) -> list[str]:
        """Return the lines that a printed report has of it."""
        moments = ", ".join(f"{moment:.5g}" for moment in self.bus_inertia)
        width = max(len(appendage.name) for appendage in self.appendages)
        lines = [f"  appendages    {len(self.appendages)}, bending out of plane"]
        for a in self.appendages:
            cut = "1 segment" if a.segments == 1 else f"{a.segments} segments"
            size = f"{a.mass:8.4g} kg  {a.span:.4g} x {a.chord:.4g} m  {cut}"
            lines.append(f"    {a.name:<{width}}  {size}  base held {_hertz(a.frequencies)}")
        return [
            *lines,
            f"  free-flying   {_hertz(self.frequencies)}, joints held at zero",
            f"  bus remains   {self.bus_mass:.6g} kg, principal moments {moments} kg m2",
        ]


def _hertz(frequencies: tuple[float, ...]) -> str:
    return ", ".join(f"{frequency:.4g}" for frequency in frequencies) + " Hz"


@dataclass(frozen=True)
class Report:
    """What a robot is made of, and what is suspicious or impossible in its description.

    Attributes:
        name: The robot.
        usable: Whether it can be loaded.
        mass: Total mass, kg; None where it cannot be loaded, as in the following.
        base_mass: Mass fixed to the root link, kg.
        inertia: Principal moments (3,) of the whole about its centre of mass at zero joint positions, kg m2.
        base_link: Name of the root link.
        end_effector: Frame that the tasks move; None where it has to be named.
        reach: From the arm's first joint to the end-effector, pulled straight, m.
        tips: Links at the ends of the arms.
        frames: Every link, in Pinocchio's order; each can be an end-effector.
        joints: One entry a joint, in the order of the joint rates.
        findings: All that is impossible, suspicious or worth a note.
        flexible: Its appendages and what they leave of the bus; None where it has none.
    """

    name: str
    usable: bool
    mass: float | None
    base_mass: float | None
    inertia: tuple[float, ...] | None
    base_link: str | None
    end_effector: str | None
    reach: float | None
    tips: tuple[str, ...]
    frames: tuple[str, ...]
    joints: tuple[JointReport, ...]
    findings: tuple[Finding, ...]
    flexible: FlexibleReport | None = None

    @classmethod
    def of_robot(cls, robot: Robot) -> Report:
        """Report on a robot that loads.

        Raises:
            InputError: it is no robot.
        """
        from ssm_decouple.model.robot import checked_robot

        checked_robot(robot)
        return cls._of_loaded(robot, robot.end_effector)

    @classmethod
    def of_file(cls, path: str | Path) -> Report:
        """Report on a URDF file, or a TOML file that adds appendages to one, whether or not it can be loaded.

        Raises:
            ModelError: the file cannot be read, is not XML or not a URDF; a TOML file is no robot.
        """
        from ssm_decouple.model.catalogue import describe
        from ssm_decouple.model.formats import read_robot
        from ssm_decouple.model.robot import Robot

        described = describe(path)
        text, name = read_robot(described.urdf), described.name
        root = parse_urdf(text, str(described.urdf))
        findings = inspect_urdf(root)
        if any(finding.level == "impossible" for finding in findings):
            return cls._unusable(name, findings)
        tips = tip_links(root)
        ambiguous = described.end_effector is None and len(tips) > 1 and "end_effector" not in tips
        tool = tips[0] if ambiguous else described.end_effector
        try:
            robot = Robot(text, name=name, end_effector=tool, appendages=described.appendages)
        except DecoupleError as error:
            return cls._unusable(name, [*findings, Finding("impossible", "robot", str(error))])
        report = cls._of_loaded(robot, None if ambiguous else robot.end_effector)
        heard = [Finding("suspicious", "file", f"other readers of URDF say: {line}") for line in said_of(robot.urdf)]
        return replace(report, findings=(*report.findings, *heard))

    @classmethod
    def _unusable(cls, name: str, findings: list[Finding]) -> Report:
        return cls(name, False, None, None, None, None, None, None, (), (), (), tuple(findings))

    @classmethod
    def _of_loaded(cls, robot: Robot, end_effector: str | None) -> Report:
        root, model = parse_urdf(robot.urdf, robot.name), robot.model
        kinds = {joint.get("name"): joint for joint in root.findall("joint")}
        joints = []
        for i, name in enumerate(robot.joint_names):
            element = kinds[name]
            moves = element.find("child").get("link", "")  # type: ignore[union-attr]
            lower, upper = robot.position_limits[i]
            mass = model.inertias[model.getJointId(name)].mass
            kind = element.get("type", "")
            joints.append(JointReport(name, kind, moves, mass, lower, upper, robot.rate_limits[i]))
        coupling = robot.coupling(robot.configuration())
        return cls(
            name=robot.name,
            usable=True,
            mass=robot.mass,
            base_mass=model.inertias[1].mass,
            inertia=tuple(float(moment) for moment in np.linalg.eigvalsh(coupling.H_ww)),
            base_link=root_link(root),
            end_effector=end_effector,
            reach=robot.reach if end_effector else None,
            tips=tuple(tip_links(root)),
            frames=tuple(robot.link_names),
            joints=tuple(joints),
            findings=(
                *robot.findings,
                *massless_root(model),
                *massless_joints(model, robot._data),
                *inspect_remaining_bus(root, robot.appendages),
            ),
            flexible=FlexibleReport.of_robot(robot) if robot.appendages else None,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain lists and dictionaries, ready for JSON; what has no limit is None."""

        def plain(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: plain(item) for key, item in value.items()}
            if isinstance(value, list | tuple):
                return [plain(item) for item in value]
            return None if isinstance(value, float) and not np.isfinite(value) else value

        converted: dict[str, Any] = plain(asdict(self))
        return converted

    def __str__(self) -> str:
        lines = [f"{self.name}: {'can be used' if self.usable else 'cannot be used'}"]
        if self.usable and self.inertia is not None:
            moments = ", ".join(f"{moment:.5g}" for moment in self.inertia)
            tips = ", ".join(self.tips)
            named = f"has to be chosen with end_effector, one of: {tips}" if tips else "none, no joint moves"
            if self.end_effector is not None and self.joints:
                named = f"{self.end_effector}, reach {self.reach:.4g} m from the arm's first joint"
            lines += [
                f"  mass          {self.mass:.6g} kg, of which {self.base_mass:.6g} kg fixed to '{self.base_link}'",
                f"  inertia       {moments} kg m2, principal, whole robot about its centre of mass",
                f"  end-effector  {named}",
                f"  frames        {', '.join(self.frames)}",
                f"  joints        {len(self.joints)}",
            ]
            width = max((len(joint.name) for joint in self.joints), default=0)
            for joint in self.joints:
                lines.append(
                    f"    {joint.name:<{width}}  {joint.type:<10}  {joint.mass:8.4g} kg  {_limits(joint):<22}  "
                    f"{_quantity(joint.rate_limit, joint.type, '/s')}"
                )
        if self.flexible is not None:
            lines += self.flexible.lines()
        for level in ("impossible", "suspicious", "note"):
            lines += [f"  {level:<10}  {finding}" for finding in self.findings if finding.level == level]
        if not any(finding.level != "note" for finding in self.findings):
            lines.append("  nothing suspicious")
        return "\n".join(lines)


def _quantity(value: float, kind: str, per: str = "") -> str:
    if not np.isfinite(value):
        return "no limit"
    return f"{value:.4g} m{per}" if kind == "prismatic" else f"{np.rad2deg(value):.4g} deg{per}"


def _limits(joint: JointReport) -> str:
    if joint.type == "continuous":
        return "turns without end"
    if not (np.isfinite(joint.lower) or np.isfinite(joint.upper)):
        return "no position limits"
    return f"{_quantity(joint.lower, joint.type).split()[0]} to {_quantity(joint.upper, joint.type)}"
