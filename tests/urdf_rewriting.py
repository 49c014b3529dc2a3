"""The same robot in other words: ways to write a URDF that all mean the same."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

NUMERIC = ("xyz", "rpy", "quat_xyzw", "value", "lower", "upper", "effort", "velocity")


def _numeric(root: ET.Element) -> list[tuple[ET.Element, str]]:
    """Return every attribute that holds numbers."""
    inertia = [(e, key) for e in root.iter("inertia") for key in e.attrib]
    return [(e, key) for e in root.iter() for key in e.attrib if key in NUMERIC] + inertia


def white_space(root: ET.Element, rng: np.random.Generator) -> None:
    for element, key in _numeric(root):
        around = [str(rng.choice(["", " ", "\t", "\n", "\r\n", "  "])) for _ in range(2)]
        between = str(rng.choice([" ", "\t", "\n", "   "]))
        element.set(key, around[0] + between.join(element.get(key, "").split()) + around[1])


def number_formats(root: ET.Element, rng: np.random.Generator) -> None:
    for element, key in _numeric(root):
        element.set(key, " ".join(_written(float(word), rng) for word in element.get(key, "").split()))


def _written(value: float, rng: np.random.Generator) -> str:
    text = str(rng.choice([repr(value), f"{value:.17e}", f"{value:.17E}", f"{value:.25e}"]))
    if text.endswith(".0"):
        text = text[:-1]
    if text.startswith(("0.", "-0.")) and "e" not in text.lower() and len(text.lstrip("-")) > 2:
        text = text.replace("0.", ".", 1)
    return "+" + text if value >= 0 and rng.random() < 0.3 else text


def orders(root: ET.Element, rng: np.random.Generator) -> None:
    for element in root.iter():
        attributes, children = list(element.items()), list(element)
        rng.shuffle(attributes)
        element.attrib = dict(attributes)
        order = rng.permutation(len(children))
        element[:] = [children[i] for i in order]


def quaternions(root: ET.Element, rng: np.random.Generator) -> None:
    for origin in root.iter("origin"):
        if origin.get("rpy") is not None and rng.random() < 0.7:
            angles = [float(word) for word in origin.attrib.pop("rpy").split()]
            x, y, z, w = Rotation.from_euler("xyz", angles).as_quat().tolist()
            origin.set("quat_xyzw", f"{x!r} {y!r} {z!r} {w!r}")
    root.set("version", "1.2")


def more_fixed_links(root: ET.Element, rng: np.random.Generator) -> None:
    """Put a link without mass between some links and the joints that they hold, and leave the rest where it is."""
    for i, joint in enumerate(root.findall("joint")):
        if rng.random() < 0.5:
            origin = joint.find("origin")
            ET.SubElement(root, "link", name=f"between_{i}")
            fixed = ET.SubElement(root, "joint", name=f"fixed_{i}", type="fixed")
            fixed.append(joint.find("parent"))
            ET.SubElement(fixed, "child", link=f"between_{i}")
            fixed.append(origin)
            joint.remove(joint.find("parent"))
            joint.remove(origin)
            ET.SubElement(joint, "parent", link=f"between_{i}")


def clashing_names(root: ET.Element, rng: np.random.Generator) -> None:
    """Give links and joints each other's names, and Pinocchio's own; "end_effector" stays."""
    links = [link.get("name", "") for link in root.findall("link") if link.get("name") != "end_effector"]
    joints = [joint.get("name", "") for joint in root.findall("joint")]
    new_links = dict(zip(links, rng.permutation([*joints, "root_joint", "universe"]).tolist(), strict=False))
    new_links["end_effector"] = "end_effector"
    new_joints = dict(zip(joints, rng.permutation([*links, "root_joint"]).tolist(), strict=False))
    for link in root.findall("link"):
        link.set("name", new_links[link.get("name", "")])
    for joint in root.findall("joint"):
        joint.set("name", new_joints[joint.get("name", "")])
        for end in (*joint.findall("parent"), *joint.findall("child")):
            end.set("link", new_links[end.get("link", "")])


def silent_elements(root: ET.Element, rng: np.random.Generator) -> None:
    """Add what says nothing about masses and motion, some of it in a form that other readers refuse."""
    for joint in root.findall("joint"):
        if joint.get("type") != "fixed" and rng.random() < 0.5:
            ET.SubElement(joint, "dynamics")
        if rng.random() < 0.3:
            ET.SubElement(joint, "safety_controller")
        if rng.random() < 0.3:
            ET.SubElement(joint, "calibration", rising="no number")
    for link in root.findall("link"):
        visual = ET.SubElement(link, "visual", name="v")
        ET.SubElement(visual, "origin", xyz=str(rng.choice(["0 0 0", "0 0", "a b c", "0\t0 1"])))
        ET.SubElement(ET.SubElement(visual, "geometry"), str(rng.choice(["box", "mesh", "cone"])), size="1 x")
    for _ in range(2):
        ET.SubElement(ET.SubElement(root, "material", name="grey"), "color", rgba="0.5 0.5 0.5 1")
    ET.SubElement(ET.SubElement(root, "gazebo"), "mass", value="7")
    ET.SubElement(ET.SubElement(root, "transmission", name="t"), "joint", name="j")


def world(root: ET.Element, rng: np.random.Generator) -> None:
    """Say that the robot floats, and fix the world to another."""
    children = {child.get("link") for child in root.findall("joint/child")}
    first = next(link.get("name", "") for link in root.findall("link") if link.get("name") not in children)
    for name in ("map", "world"):
        ET.SubElement(root, "link", name=name)
    for name, kind, parent, child in (("to_map", "fixed", "map", "world"), ("float", "floating", "world", first)):
        joint = ET.SubElement(root, "joint", name=name, type=kind)
        ET.SubElement(joint, "parent", link=parent)
        ET.SubElement(joint, "child", link=child)
        ET.SubElement(joint, "origin", xyz="1 2 3")


WAYS: dict[str, Callable[[ET.Element, np.random.Generator], None]] = {
    "more fixed links": more_fixed_links,
    "clashing names": clashing_names,
    "world": world,
    "quaternions": quaternions,
    "number formats": number_formats,
    "silent elements": silent_elements,
    "orders": orders,
    "white space": white_space,
}

HEADS = {
    "plain": "{}",
    "mark": "\ufeff{}",
    "declared": '<?xml version="1.0" encoding="UTF-16"?>\n{}',
    "comment": "<!-- <robot/> -->\n{}<!-- no more -->",
    "doctype": '<!DOCTYPE robot [<!ENTITY nothing "">]>\n{}',
}


def rewritten(text: str, ways: list[str], head: str, seed: int) -> str:
    """Return URDF text written anew, in the order of `WAYS`."""
    root, rng = ET.fromstring(text), np.random.default_rng(seed)
    for name, way in WAYS.items():
        if name in ways:
            way(root, rng)
    return HEADS[head].format(ET.tostring(root, encoding="unicode"))
