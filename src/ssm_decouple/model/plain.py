"""URDF in the plain form that every reader takes alike, and Pinocchio's reading of it."""

from __future__ import annotations

import os
import re
import sys
import tempfile
import threading
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from ssm_decouple.errors import ModelError
from ssm_decouple.model.folded import folded_model, has_many_fixed_links
from ssm_decouple.model.grammar import ATTRIBUTES, MOVING, origin_faults
from ssm_decouple.model.reading import JointLimits, Reading, rotations, unit_axis
from ssm_decouple.model.urdf import joint_end, number, numbers, triple

# Numbers that all readers take alike; of a vector they are apart by blanks.
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d{1,3})?"
_NUMBERS = re.compile(rf"{_NUMBER}(?: +{_NUMBER})*", re.ASCII)
_OTHER_ENCODING = re.compile(r"<\?xml[^>]*encoding\s*=\s*[\"'](?!utf-8)", re.IGNORECASE)

_MOST = repr(float(np.finfo(float).max))  # what Pinocchio itself writes for no limit


def plain_urdf(root: ET.Element, text: str) -> tuple[str, Reading]:
    """Bring a URDF into plain form, in place; return its text and the numbers that it had before.

    A part of the world above the robot is left out (see `world_above`), quaternions become roll, pitch and yaw,
    numbers lose what stands around them, limits that the file leaves out or calls infinite are the largest number, and
    what other readers refuse is left out where it says nothing: an empty <dynamics>, a material twice, a figure that is
    malformed. The text is the one given where it is plain already.

    Args:
        root: A URDF in which `inspect_urdf` found nothing impossible.
        text: What it was parsed from.
    """
    dropped = _without(root, world_above(root))
    reading = Reading.of(root)
    changed = make_plain(root) or dropped
    return ET.tostring(root, encoding="unicode") if changed or _is_unusual(text) else text, reading


def _is_unusual(text: str) -> bool:
    """Say whether a text has what few readers of URDF know of XML: more than elements and comments, other encodings."""
    declares = text.count("<!") != text.count("<!--")
    return declares or "xmlns" in text or text.startswith("\ufeff") or _OTHER_ENCODING.match(text) is not None


def make_plain(root: ET.Element) -> bool:
    """Bring a URDF into plain form, in place; return whether anything had to be changed. See `plain_urdf`."""
    changes = [_without(root, world_above(root)), _without(root, _materials_again(root))]
    if (
        root.get("version", "1.0") != "1.0"
    ):  # later ones only add quaternions, which are gone, and few readers know them
        changes += [root.attrib.pop("version") != "1.0"]
    for link in root.findall("link"):
        inertial = link.find("inertial")
        shapes = [*link.findall("visual"), *link.findall("collision")]
        changes += [_plain_origin(element) for element in ([] if inertial is None else [inertial])]
        if inertial is not None:
            changes += [_plain_numbers(inertial.find("mass"), ("value",))]
            changes += [_plain_numbers(inertial.find("inertia"), ATTRIBUTES["inertia"])]
        for shape in shapes:
            changes.append(_without(link, [shape]) if malformed(shape) else _plain_origin(shape))
    for joint in root.findall("joint"):
        changes += [_plain_origin(joint)]
        if joint.get("type") in MOVING:
            changes += [_plain_axis(joint), _plain_limit(joint), _plain_dynamics(joint)]
    return any(changes)


def malformed(shape: ET.Element) -> bool:
    """Say whether a <visual> or <collision> has an <origin> that cannot be read."""
    origin = shape.find("origin")
    return origin is not None and any(origin_faults(origin))


def world_above(root: ET.Element) -> list[ET.Element]:
    """Return the links and joints above a floating joint, where they only stand for the world.

    A URDF may say that its robot floats, by a floating joint from a link that stands for the world. Ours always
    floats: such links, which have no mass and are fixed to each other, are no part of it, nor is the floating joint.
    Nothing is returned where the floating joint is anything else.
    """
    joints = {joint_end(joint, "child"): joint for joint in root.findall("joint")}
    floating = [joint for joint in joints.values() if joint.get("type") == "floating"]
    if len(floating) != 1:
        return []
    start = joint_end(floating[0], "child")
    below: dict[str, list[str]] = {}
    for child, joint in joints.items():
        below.setdefault(joint_end(joint, "parent"), []).append(child)
    robot = [start]
    for name in robot:  # grows while it is walked
        robot += below.get(name, [])
    kept = set(robot)
    links = [link for link in root.findall("link") if link.get("name") not in kept]
    above = [joint for child, joint in joints.items() if child not in kept]
    if any(_weighs(link) for link in links) or any(joint.get("type") != "fixed" for joint in above):
        return []
    return [*links, *above, floating[0]]


def _weighs(link: ET.Element) -> bool:
    values = [("mass", "value"), *(("inertia", key) for key in ATTRIBUTES["inertia"])]
    found = [(link.find(f"inertial/{tag}"), key) for tag, key in values]
    return any(number(element.get(key, "0")) != 0 for element, key in found if element is not None)


def _without(parent: ET.Element, elements: Sequence[ET.Element]) -> bool:
    for element in elements:
        parent.remove(element)
    return bool(elements)


def _materials_again(root: ET.Element) -> list[ET.Element]:
    materials = root.findall("material")
    first: dict[str | None, ET.Element] = {}
    return [material for material in materials if first.setdefault(material.get("name"), material) is not material]


@lru_cache(maxsize=8192)
def _is_plain(text: str) -> bool:
    return _NUMBERS.fullmatch(text) is not None


def _plain_numbers(element: ET.Element | None, keys: Sequence[str]) -> bool:
    changed = False
    for key in keys if element is not None else ():
        text = element.get(key)  # type: ignore[union-attr]
        if text is not None and not _is_plain(text):
            element.set(key, " ".join(map(repr, numbers(text))))  # type: ignore[union-attr]
            changed = True
    return changed


def _plain_origin(element: ET.Element) -> bool:
    origin = element.find("origin")
    turned = origin is not None and origin.get("quat_xyzw") is not None
    if origin is not None and turned:
        origin.set("rpy", triple(pin.rpy.matrixToRpy(rotations([origin])[0])))
        del origin.attrib["quat_xyzw"]
    return _plain_numbers(origin, ("xyz", "rpy")) or turned


def _plain_axis(joint: ET.Element) -> bool:
    """Write an axis as a unit vector where its squares leave the range of numbers, in which Pinocchio takes it."""
    axis = joint.find("axis")
    if axis is None or axis.get("xyz") is None:
        return False
    changed = _plain_numbers(axis, ("xyz",))
    largest = max(map(abs, numbers(axis.get("xyz", ""))))
    if 1e-100 < largest < 1e100:
        return changed
    axis.set("xyz", triple(unit_axis(joint)))
    return True


def _plain_limit(joint: ET.Element) -> bool:
    limit, limits = joint.find("limit"), JointLimits.of(joint)
    bounded = joint.get("type") != "continuous"
    if limit is None:
        if not bounded:
            return False
        limit = ET.SubElement(joint, "limit")
    changed = False
    values = {"lower": limits.lower, "upper": limits.upper, "effort": limits.effort, "velocity": limits.velocity}
    for key, value in values.items():
        text = limit.get(key)
        endless = value if text is None else number(text)
        if np.isinf(endless) and (text is not None or bounded or key in ("effort", "velocity")):
            limit.set(key, ("-" if endless < 0 else "") + _MOST)
        elif text is None and bounded:
            limit.set(key, repr(value))
        changed = changed or limit.get(key) != text
    return _plain_numbers(limit, tuple(values)) or changed


def _plain_dynamics(joint: ET.Element) -> bool:
    dynamics = joint.find("dynamics")
    if dynamics is None:
        return False
    if dynamics.get("damping") is None and dynamics.get("friction") is None:
        return _without(joint, [dynamics])
    return _plain_numbers(dynamics, ("damping", "friction"))


def pinocchio_text(root: ET.Element, shapes: str | None = None) -> str:
    """Return what Pinocchio reads of a plain URDF: links, joints and their numbers; no figures, no other elements.

    Args:
        root: The robot.
        shapes: "collision" to keep these shapes.
    """
    parts = [f"<robot name={_quoted(root.get('name', ''))}>"]
    for element in root:
        if element.tag == "link":
            inertial = element.find("inertial")
            body = ""
            if inertial is not None:
                numbers_read = "".join(_written(child) for child in inertial if child.tag in _OF_AN_INERTIAL)
                body = f"<inertial>{numbers_read}</inertial>"
            kept = [ET.tostring(shape, encoding="unicode") for shape in element.findall(shapes)] if shapes else []
            parts.append(f"<link name={_quoted(element.get('name', ''))}>{body}{''.join(kept)}</link>")
        elif element.tag == "joint":
            kind = element.get("type", "")
            read = _OF_A_JOINT if kind in MOVING else _OF_A_JOINT[:3]
            body = "".join(_written(child) for child in element if child.tag in read)
            parts.append(f'<joint name={_quoted(element.get("name", ""))} type="{kind}">{body}</joint>')
    return "".join([*parts, "</robot>"])


_OF_AN_INERTIAL = ("origin", "mass", "inertia")
_OF_A_JOINT = ("parent", "child", "origin", "axis", "limit", "dynamics")


def _written(element: ET.Element) -> str:
    known = ATTRIBUTES[element.tag]
    attributes = [f"{key}={_quoted(value)}" for key, value in element.items() if key in known]
    return f"<{element.tag} {' '.join(attributes)}/>"


_quoted = lru_cache(maxsize=8192)(quoteattr)


def pinocchio_model(root: ET.Element) -> pin.Model:
    """Build the model of a plain URDF on a free-flyer root.

    The root's joint is called "root_joint", as Pinocchio calls it by itself, unless the file has that name.

    Raises:
        ModelError: Pinocchio cannot, with what its parser says.
    """
    taken = {element.get("name") for element in root if element.tag in ("link", "joint")}
    name = "root_joint"
    while name in taken:
        name += "_"
    said: list[str] = []

    def build(text: str) -> pin.Model:
        with parser_heard(said):
            return pin.buildModelFromXML(text, pin.JointModelFreeFlyer(), name)

    try:
        model = folded_model(root, build) if has_many_fixed_links(root) else build(pinocchio_text(root))
    except (ValueError, RuntimeError) as error:
        why = "; ".join([*said, " ".join(str(error).split())])
        raise ModelError(f"Pinocchio cannot read it: {why}") from error
    if said:
        print(*said, sep="\n", file=sys.stderr)  # it may be another thread's, and nothing is to be lost
    return model


def said_of(text: str) -> list[str]:
    """Return what Pinocchio's parser complains of in URDF text, figures and all, each complaint once.

    It is not asked about thousands of fixed links, which would overflow its stack.
    """
    said: list[str] = []
    if has_many_fixed_links(ET.fromstring(text)):
        return said
    with parser_heard(said), suppress(ValueError, RuntimeError):
        pin.buildModelFromXML(text)
    return list(dict.fromkeys(said))


_hearing = threading.Lock()


@contextmanager
def parser_heard(said: list[str]) -> Iterator[None]:
    """Collect what the C++ parser writes on standard error, one line a complaint, rather than on the terminal.

    The file descriptor is the whole process's: one thread at a time has it, and it is given back in any case.
    """
    with _hearing, tempfile.TemporaryFile() as heard:
        try:
            terminal = os.dup(2)
        except OSError:  # there is no standard error
            yield
            return
        try:
            os.dup2(heard.fileno(), 2)
            yield
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)
            heard.seek(0)
            said += complaints(heard.read().decode("utf-8", "replace"))


def complaints(text: str) -> list[str]:
    """Return what urdfdom complains of, without its places in its own source."""
    lines = [" ".join(line.split()) for line in text.splitlines()]
    kept = [line for line in lines if line and not re.match(r"at line \d+ in ", line)]
    return [re.sub(r"^(Error|Warning):\s*", "", line) for line in kept]
