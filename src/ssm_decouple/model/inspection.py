"""What is impossible, suspicious or worth a note in a URDF, said before anything is built on it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable, Iterator

import numpy as np

from ssm_decouple.errors import ModelError
from ssm_decouple.model.grammar import MOVING, inspect_grammar
from ssm_decouple.model.plain import malformed, world_above
from ssm_decouple.model.reading import JointLimits
from ssm_decouple.model.urdf import Finding, Level, attribute, inertia_matrix, number, numbers

# Where a number is more likely meant in degrees: no joint turns more than twice and stops there, nor ten times a
# second, and a number that only stands for no limit is larger.
_TURNS = (4 * np.pi, 720.0)  # rad
_RATES = (20 * np.pi, 720.0)  # rad/s
_ANGLE = 6.3  # rad


def inspect_urdf(root: ET.Element) -> list[Finding]:
    """Say everything that is impossible, suspicious or worth a note in a parsed URDF."""
    faults = [*inspect_tree(root), *inspect_grammar(root)]
    unreadable = {fault.where for fault in faults}
    readable = [e for e in root if e.tag in ("link", "joint") and f"{e.tag} {e.get('name')}" not in unreadable]
    joints = [joint for joint in readable if joint.tag == "joint"]
    links = [link for link in readable if link.tag == "link"]
    if not faults:
        faults += _inspect_floating(root)
    found = [*faults, *(finding for joint in joints for finding in _inspect_joint(joint))]
    found += [finding for element in readable for finding in _inspect_turns(element)]
    found += _inspect_inertias(root, links)
    if not (any(_mass(link) > 0 for link in links) or unreadable):
        found.append(Finding("impossible", "robot", "no link has mass, so there is no momentum to conserve"))
    return [*found, *_inspect_figures(root), *_left_out(root)]


def refuse_impossible(name: str, findings: Iterable[Finding]) -> None:
    """Refuse a robot of which something impossible was found.

    Raises:
        ModelError: naming the first.
    """
    impossible = [finding for finding in findings if finding.level == "impossible"]
    if impossible:
        more = f" (and {len(impossible) - 1} more: `ssm-decouple check` lists them)" if impossible[1:] else ""
        raise ModelError(f"robot '{name}': {impossible[0]}{more}")


def inspect_tree(root: ET.Element) -> list[Finding]:
    """Say what keeps links and joints from being one tree."""
    names = [link.get("name", "") for link in root.findall("link")]
    if not names:
        return [Finding("impossible", "robot", "has no <link>")]
    found = [
        Finding("impossible", f"{kind} {name}", f"this name stands {count} times; rename all but one")
        for kind in ("link", "joint")
        for name, count in Counter(element.get("name", "") for element in root.findall(kind)).items()
        if count > 1
    ]
    links, parents = set(names), dict[str, str]()
    for joint in root.findall("joint"):
        ends = {role: end.get("link") for role in ("parent", "child") if (end := joint.find(role)) is not None}
        where, lost = (
            f"joint {joint.get('name')}",
            [role for role in ("parent", "child") if ends.get(role) not in links],
        )
        for role in lost:
            found.append(Finding("impossible", where, f"its {role} link '{ends.get(role)}' does not exist"))
        if lost:
            continue
        child = str(ends["child"])
        if child in parents:
            found.append(Finding("impossible", where, f"link '{child}' already has a parent; URDF is a tree"))
        parents[child] = str(ends["parent"])
    return found or _inspect_roots(names, parents)


def _inspect_roots(links: list[str], parents: dict[str, str]) -> list[Finding]:
    roots = [link for link in links if link not in parents]
    if len(roots) != 1:
        return [Finding("impossible", "robot", f"needs exactly one root link, has {roots or 'a loop'}")]
    below: dict[str, list[str]] = {}
    for child, parent in parents.items():
        below.setdefault(parent, []).append(child)
    reached = list(roots)
    for link in reached:  # grows while it is walked
        reached += below.get(link, [])
    known = set(reached)
    lost = ", ".join(link for link in links if link not in known)
    if not lost:
        return []
    return [Finding("impossible", "robot", f"links {lost} form a loop, away from the root '{roots[0]}'")]


def _inspect_floating(root: ET.Element) -> list[Finding]:
    above = world_above(root)
    if above:
        names = ", ".join(f"'{element.get('name')}'" for element in above if element.tag == "link")
        message = f"the robot floats by itself: the joint and what stands for the world, {names}, are left out"
        return [Finding("note", f"joint {above[-1].get('name')}", message)]
    message = (
        "a floating joint between parts of the robot: its root link floats already, and what floats beside it is a "
        "robot of its own; make the joint fixed, or give each part a file"
    )
    return [
        Finding("impossible", f"joint {joint.get('name')}", message)
        for joint in root.findall("joint")
        if joint.get("type") == "floating"
    ]


def _inspect_joint(joint: ET.Element) -> Iterator[Finding]:
    where, kind, limit = f"joint {joint.get('name')}", joint.get("type", ""), joint.find("limit")
    if kind not in MOVING:
        return
    mimic = joint.find("mimic")
    if mimic is not None:
        message = (
            f"<mimic> is not followed: it moves on its own, not with '{mimic.get('joint')}'; where the hardware "
            f'couples them, lock it: robot.with_locked({{"{joint.get("name")}": ..}})'
        )
        yield Finding("suspicious", where, message)
    if limit is None and kind == "continuous":
        yield Finding("note", where, "no <limit>: its rate is unlimited unless the law is given one")
    elif limit is None:
        advice = 'add <limit lower=".." upper=".." effort=".." velocity=".."/> or make it continuous'
        yield Finding("suspicious", where, f"a {kind} joint without <limit> has no limits; {advice}")
    else:
        yield from _inspect_limit(joint, where, kind, limit)
    soft = joint.find("safety_controller")
    if soft is not None and ("soft_lower_limit" in soft.attrib or "soft_upper_limit" in soft.attrib):
        ends = " to ".join(soft.get(f"soft_{key}_limit", "0") for key in ("lower", "upper"))
        yield Finding("note", where, f"its soft limits {ends} are not kept; those of <limit> are")
    dynamics = joint.find("dynamics")
    if dynamics is not None and dynamics.get("damping") is None and dynamics.get("friction") is None:
        yield Finding("note", where, "its <dynamics> is empty, which other readers refuse; it is left out")


def _inspect_limit(joint: ET.Element, where: str, kind: str, limit: ET.Element) -> Iterator[Finding]:
    limits = JointLimits.of(joint)
    if kind == "continuous":
        lower, upper = (number(limit.get(key, "0")) for key in ("lower", "upper"))
        if lower != upper:
            message = f"its limits {lower:g} to {upper:g} are not kept: a continuous joint turns without end"
            yield Finding("suspicious", where, f"{message}; make it revolute, or leave them out")
    elif np.isinf(limits.lower) and np.isinf(limits.upper):
        yield Finding("suspicious", where, "its <limit> gives it no position limits: add lower and upper")
    else:
        for key in ("lower", "upper"):
            if limit.get(key) is None:
                message = f"its <limit> lacks {key}, which URDF takes as 0: {limits.lower:g} to {limits.upper:g}"
                yield Finding("suspicious", where, message)
        if not limits.upper > limits.lower:
            message = f"position limits [{limits.lower:g}, {limits.upper:g}] leave it no room"
            yield Finding("suspicious", where, message)
    if not 0 < limits.velocity < np.inf:
        message = "no velocity limit above zero" if limits.velocity <= 0 else "its <limit> gives no velocity limit"
        yield Finding("suspicious", where, f"{message}: give the law a rate_limit")
    if np.isinf(limits.effort):
        yield Finding("note", where, "no effort limit")
    if kind != "prismatic":
        yield from _inspect_degrees(joint, where, limits)


def _inspect_degrees(joint: ET.Element, where: str, limits: JointLimits) -> Iterator[Finding]:
    ends = [abs(end) for end in (limits.lower, limits.upper) if np.isfinite(end)]
    if any(_TURNS[0] < end <= _TURNS[1] for end in ends):
        turned = " to ".join(f"{np.deg2rad(end):.4g}" for end in (limits.lower, limits.upper))
        message = (
            f"position limits {limits.lower:g} to {limits.upper:g} rad, more than two turns: degrees? In rad {turned}"
        )
        yield Finding("suspicious", where, message)
    # What turns without end and fast is a wheel.
    if joint.get("type") != "continuous" and _RATES[0] < limits.velocity <= _RATES[1]:
        message = f"velocity limit {limits.velocity:g} rad/s: degrees? In rad/s {np.deg2rad(limits.velocity):.4g}"
        yield Finding("suspicious", where, message)


def _inspect_turns(element: ET.Element) -> Iterator[Finding]:
    for origin in element.findall("origin" if element.tag == "joint" else "inertial/origin"):
        if any(abs(angle) > _ANGLE for angle in numbers(origin.get("rpy", ""))):
            message = f'<origin rpy="{origin.get("rpy")}"> turns more than once: degrees? URDF has rad'
            yield Finding("suspicious", f"{element.tag} {element.get('name')}", message)


def _mass(link: ET.Element) -> float:
    inertial = link.find("inertial")
    return 0.0 if inertial is None else attribute(inertial, "mass", "value")


def _inspect_inertias(root: ET.Element, links: list[ET.Element]) -> Iterator[Finding]:
    moved: dict[str | None, bool] = {}  # whether as a rotor, whose mass may well be left in the root link
    for joint in root.findall("joint"):
        end = joint.find("child")
        if joint.get("type") in MOVING and end is not None:
            moved[end.get("link")] = joint.find("wheel") is not None
    for link in links:
        where, inertial, rotor = f"link {link.get('name')}", link.find("inertial"), moved.get(link.get("name"))
        if inertial is not None:
            yield from _inspect_inertial(where, inertial, rotor is False, rotor is True)
        elif rotor is False:
            yield Finding("note", where, "moved by a joint but has no <inertial>")


def _inspect_inertial(where: str, inertial: ET.Element, moves: bool, rotor: bool) -> Iterator[Finding]:
    mass, inertia = attribute(inertial, "mass", "value"), inertia_matrix(inertial)
    if not (np.isfinite(mass) and mass >= 0):
        yield Finding("impossible", where, f"mass {mass:g} kg; it must be zero or more")
        return
    if not np.all(np.isfinite(inertia)):
        yield Finding("impossible", where, "inertia is not finite")
        return
    if mass == 0 and np.any(inertia) and not rotor:
        yield Finding("suspicious", where, "zero mass but an inertia: is the mass missing?")
    elif mass == 0:
        level: Level = "suspicious" if moves else "note"
        yield Finding(level, where, "zero mass")
    elif moves and not np.any(inertia):
        yield Finding("suspicious", where, f"mass {mass:g} kg but no inertia: a point; is the inertia missing?")
    small, middle, large = np.linalg.eigvalsh(inertia)
    if small < -1e-9 * max(large, 1e-300):
        yield Finding("suspicious", where, f"inertia has the negative principal moment {small:.4g} kg m2")
    elif small + middle < large * (1 - 1e-6):
        moments = f"{small:.4g}, {middle:.4g}, {large:.4g}"
        yield Finding("suspicious", where, f"principal moments {moments} kg m2 break the triangle inequality")


def _inspect_figures(root: ET.Element) -> Iterator[Finding]:
    """Say what is left out of what is only drawn."""
    first: dict[str | None, bytes] = {}
    for material in root.findall("material"):
        name, text = material.get("name"), ET.tostring(material).strip()
        if name not in first:
            first[name] = text
            continue
        same = first[name] == text
        message = f"stands twice{'' if same else ', in different colours'}; other readers refuse that"
        yield Finding("note" if same else "suspicious", f"material {name}", f"{message}, here the first is taken")
    for link in root.findall("link"):
        if any(malformed(visual) for visual in link.findall("visual")):
            message = "a <visual> has a malformed <origin> and is not drawn"
            yield Finding("suspicious", f"link {link.get('name')}", message)


def _left_out(root: ET.Element) -> Iterator[Finding]:
    """Say what a conversion into URDF could not keep, which it has left in the links and joints."""
    for element in (*root.findall("link"), *root.findall("joint")):
        for told in element.findall("left_out"):
            level: Level = "suspicious" if told.get("level") == "suspicious" else "note"
            if told.text:
                yield Finding(level, f"{element.tag} {element.get('name')}", told.text)
