"""Putting a fixed-base arm on a bus."""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from ssm_decouple.errors import ModelError, as_floats, as_kind, as_text
from ssm_decouple.model.appendage import Appendage
from ssm_decouple.model.catalogue import describe
from ssm_decouple.model.formats import read_robot
from ssm_decouple.model.grammar import inspect_grammar
from ssm_decouple.model.inspection import inspect_tree, refuse_impossible
from ssm_decouple.model.plain import make_plain
from ssm_decouple.model.robot import Robot, rigid_pose
from ssm_decouple.model.urdf import parse_urdf, root_link, tip_links, triple


def compose(
    bus: str | Path | Robot,
    arm: str | Path | Robot,
    mount: pin.SE3 | ArrayLike,
    *,
    mount_link: str | None = None,
    prefix: str = "",
    end_effector: str | None = None,
    name: str | None = None,
) -> Robot:
    """Put an arm on a bus and return the whole as one robot.

    The two URDFs are merged into one, joined by a fixed joint, so that `robot.urdf` describes the whole and can be
    saved and opened by any other tool. Composing again onto the result puts a second arm on the bus. Flexible
    appendages of the bus stay on it.

    Args:
        bus: The spacecraft: a catalogue name, a path or a robot, with or without arms of its own.
        arm: The arm: the same. Its root link is fixed to the bus.
        mount: Pose of the arm's root link in the mount link's frame: a `pin.SE3`, a homogeneous matrix (4, 4) or a
            position (3,), m.
        mount_link: Link of the bus that carries the arm; None is its root link.
        prefix: Put before each name of the arm, for example "left_"; needed where bus and arm share names.
        end_effector: Link of the arm, without the prefix, that the tasks move. None as in `load_robot`, for the arm.
        name: Name of the whole; None joins the two names.

    Returns:
        The composed robot.

    Raises:
        ModelError: a part cannot be read, the mount link does not exist, names collide, the arm has flexible
            appendages (they belong on the root link of the whole), or the whole is impossible.
        InputError: the mount is not a pose.
    """
    for word, value in (("mount_link", mount_link), ("end_effector", end_effector), ("name", name)):
        if value is not None:
            as_text(word, value)
    as_kind("prefix", prefix, str, "it is a text such as 'left_'")
    (bus_text, bus_name, _, appendages), (arm_text, arm_name, known_tool, lost) = _parts(bus), _parts(arm)
    if lost:
        raise ModelError(
            f"arm '{arm_name}' has the appendages {', '.join(wing.name for wing in lost)}, which would leave the root "
            "link; give them to the whole with compose(..).with_appendages([..])"
        )
    whole, part = _plain(bus_text, bus_name), _plain(arm_text, arm_name)
    carrier = mount_link or root_link(whole)
    links = [link.get("name") for link in whole.findall("link")]
    if carrier not in links:
        raise ModelError(f"bus '{bus_name}' has no link '{carrier}'; it has {', '.join(map(str, links))}")
    tool = _tool(part, arm_name, end_effector, known_tool)
    _rename(part, prefix)
    _refuse_collisions(whole, part, bus_name, arm_name, prefix)
    for child in part:
        if child.tag in ("link", "joint", "material"):
            whole.append(copy.deepcopy(child))
    whole.append(_fixed_joint(carrier, root_link(part), _pose(mount)))
    whole.set("name", name or f"{bus_name}_{prefix}{arm_name}")
    ET.indent(whole)
    return Robot(
        ET.tostring(whole, encoding="unicode"),
        name=whole.get("name", ""),
        end_effector=prefix + tool,
        appendages=appendages,
    )


def _parts(source: str | Path | Robot) -> tuple[str, str, str | None, tuple[Appendage, ...]]:
    """Return URDF text, name, end-effector where it is known, and appendages."""
    if isinstance(source, Robot):
        return source.urdf, source.name, source.end_effector, source.appendages
    found = describe(source)
    return read_robot(found.urdf), found.name, found.end_effector, found.appendages


def _plain(text: str, name: str) -> ET.Element:
    """Return a part in plain form: what is merged is what is read of it."""
    root = parse_urdf(text, name)
    refuse_impossible(name, [*inspect_tree(root), *inspect_grammar(root)])
    make_plain(root)
    return root


def _tool(part: ET.Element, arm_name: str, wanted: str | None, known: str | None) -> str:
    links = [link.get("name", "") for link in part.findall("link")]
    if wanted is not None:
        if wanted not in links:
            raise ModelError(f"arm '{arm_name}' has no link '{wanted}' for its end-effector; it has {', '.join(links)}")
        return wanted
    if known is not None:
        return known
    tips = tip_links(part)
    if "end_effector" in links:
        return "end_effector"
    if len(tips) != 1:
        raise ModelError(f"arm '{arm_name}' has {len(tips)} tips: name one as end_effector: {', '.join(tips)}")
    return tips[0]


def _rename(part: ET.Element, prefix: str) -> None:
    top = {id(element) for element in part}
    for element in part.iter():
        named = element.tag in ("link", "joint", "material", "mimic") and (id(element) in top or element.tag != "link")
        key = {"parent": "link", "child": "link", "mimic": "joint"}.get(element.tag, "name" if named else None)
        if key is not None and element.get(key) is not None:
            element.set(key, prefix + element.get(key, ""))


def _refuse_collisions(whole: ET.Element, part: ET.Element, bus_name: str, arm_name: str, prefix: str) -> None:
    for kind in ("link", "joint"):
        taken = {element.get("name") for element in whole.findall(kind)}
        shared = [str(element.get("name")) for element in part.findall(kind) if element.get("name") in taken]
        if shared:
            more = ", .." if shared[3:] else ""
            raise ModelError(
                f"bus '{bus_name}' and arm '{arm_name}' share the {kind} names {', '.join(shared[:3])}{more}; "
                f"give compose another prefix than '{prefix}'"
            )


def _pose(mount: pin.SE3 | ArrayLike) -> pin.SE3:
    if not isinstance(mount, pin.SE3):
        values = as_floats("mount", mount)
        if values.shape == (3,):
            mount = np.eye(4)
            mount[:3, 3] = values
    return rigid_pose("mount", mount)


def _fixed_joint(parent: str, child: str, pose: pin.SE3) -> ET.Element:
    joint = ET.Element("joint", name=f"{child}_mount", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=triple(pose.translation), rpy=triple(pin.rpy.matrixToRpy(pose.rotation)))
    return joint
