"""Thousands of fixed links: Pinocchio's reader walks them by recursion and looks each up among all, so we fold them.

A model with a chain of some thousand fixed joints overflows the stack of its reader, which ends the process; and its
time grows with the square of their number.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass

import pinocchio as pin

from ssm_decouple.model.urdf import Body, floats, joint_end, read_body, root_link, triple, write_body

MANY = 1000  # fixed joints that Pinocchio's reader still takes in a tenth of a second, and in any stack


@dataclass(frozen=True)
class _Held:
    """A fixed joint and its link: what carries them, where they stand in its frame, and what the link weighs there."""

    joint: str
    link: str
    carrier: str
    parent: str
    pose: pin.SE3
    inertia: pin.Inertia


def has_many_fixed_links(root: ET.Element) -> bool:
    """Say whether a URDF has more fixed joints than Pinocchio's reader should be given."""
    return sum(joint.get("type") == "fixed" for joint in root.findall("joint")) > MANY


def folded_model(root: ET.Element, build: Callable[[str], pin.Model]) -> pin.Model:
    """Build the model of a URDF with its fixed links merged into what carries them, and give it their frames.

    Joints have the order in which Pinocchio reads any file: depth first, siblings by the names of their joints.

    Args:
        root: A URDF in which nothing is impossible.
        build: Makes a model of URDF text.
    """
    folded, held, names = _fold(root)
    model = build(ET.tostring(folded, encoding="unicode"))
    for i, name in enumerate(list(model.names)):
        model.names[i] = names.get(name, name)
    for frame in model.frames:
        frame.name = names.get(frame.name, frame.name)
    places = {frame.name: i for i, frame in enumerate(model.frames) if frame.type == pin.FrameType.BODY}
    carriers = {name: int(model.frames[place].parentJoint) for name, place in places.items()}
    for part in held:
        made = (part.joint, carriers[part.carrier], places[part.parent], part.pose, pin.FrameType.FIXED_JOINT)
        joint = model.addFrame(pin.Frame(*made, part.inertia), False)
        link = pin.Frame(part.link, carriers[part.carrier], joint, part.pose, pin.FrameType.BODY)
        places[part.link] = model.addFrame(link, False)
    above = {joint.get("name"): joint_end(joint, "parent") for joint in root.findall("joint")}
    for frame in model.frames:
        if frame.type == pin.FrameType.JOINT and frame.name in above:
            frame.parentFrame = places[above[frame.name]]
    return model


def flat_collisions(root: ET.Element) -> str:
    """Return URDF text of the links that have collision shapes, all fixed to the root link.

    Pinocchio reads shapes by the name of their link, whose place its model knows, not by how links are joined.
    """
    flat, start = ET.Element("robot", name=root.get("name", "")), root_link(root)
    flat.extend(root.findall("material"))
    for link in root.findall("link"):
        name = link.get("name", "")
        if name != start and link.find("collision") is None:
            continue
        flat.append(link)
        if name != start:
            joint = ET.SubElement(flat, "joint", name=name, type="fixed")
            ET.SubElement(joint, "parent", link=start)
            ET.SubElement(joint, "child", link=name)
    return ET.tostring(flat, encoding="unicode")


def _fold(root: ET.Element) -> tuple[ET.Element, list[_Held], dict[str, str]]:
    """Return the URDF of what moves, what is fixed to it, and the names of the joints, which stand there as numbers."""
    links = {link.get("name", ""): link for link in root.findall("link")}
    below: dict[str, list[ET.Element]] = {}
    for joint in root.findall("joint"):
        below.setdefault(joint_end(joint, "parent"), []).append(joint)
    folded, held = ET.Element("robot", name=root.get("name", "")), list[_Held]()
    names, bodies = dict[str, str](), dict[str, pin.Inertia]()
    # A link, the joint above it, and where that joint's frame stands in the frame of what carries it.
    waiting: list[tuple[str, ET.Element | None, str, pin.SE3]] = [(root_link(root), None, "", pin.SE3.Identity())]
    while waiting:
        link, above, carrier, pose = waiting.pop()
        inertia = _inertia(links[link])
        if above is not None and above.get("type") == "fixed":
            held.append(_Held(above.get("name", ""), link, carrier, joint_end(above, "parent"), pose, inertia))
        else:
            if above is not None:
                number = f"{len(names):09d}"
                names[number] = above.get("name", "")
                folded.append(_moving(above, number, carrier, pose))
            carrier, pose = link, pin.SE3.Identity()
        bodies[carrier] = bodies.get(carrier, pin.Inertia.Zero()) + pose.act(inertia)
        siblings = sorted(below.get(link, []), key=lambda each: each.get("name", "").encode(), reverse=True)
        waiting += [(joint_end(joint, "child"), joint, carrier, pose * _origin(joint)) for joint in siblings]
    for carrier, inertia in bodies.items():
        write_body(ET.SubElement(folded, "link", name=carrier), Body(inertia.mass, inertia.lever, inertia.inertia))
    return folded, held, names


def _moving(joint: ET.Element, number: str, carrier: str, pose: pin.SE3) -> ET.Element:
    """Return a joint under another name, on what carries it; of one that stands on that itself not a digit changes."""
    moved = copy.deepcopy(joint)
    moved.set("name", number)
    parent = moved.find("parent")
    if parent is not None and parent.get("link") != carrier:
        parent.set("link", carrier)
        for origin in moved.findall("origin"):
            moved.remove(origin)
        ET.SubElement(moved, "origin", xyz=triple(pose.translation), rpy=triple(pin.rpy.matrixToRpy(pose.rotation)))
    return moved


def _origin(joint: ET.Element) -> pin.SE3:
    origin = joint.find("origin")
    place = {} if origin is None else origin.attrib
    xyz, rpy = (floats(place.get(key), (0.0, 0.0, 0.0)) for key in ("xyz", "rpy"))
    return pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)


def _inertia(link: ET.Element) -> pin.Inertia:
    body = read_body(link)
    return pin.Inertia(body.mass, body.centre, body.inertia) if body.inertia.any() or body.mass else pin.Inertia.Zero()
