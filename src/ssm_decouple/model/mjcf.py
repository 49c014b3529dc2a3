"""MuJoCo's MJCF, rewritten as the URDF of the same bodies, joints and frames; what that cannot hold is refused."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import ModelError
from ssm_decouple.model.mjcf_grammar import EXPAND, Attributes, Compiler, Grammar, expanded, pose_of, shape_pose
from ssm_decouple.model.urdf import Body, triple, write_body

Floats = NDArray[np.float64]

NOT_LIMITED = repr(float(np.finfo(float).max))  # what Pinocchio itself writes for no limit
_SAME = 1e-15  # a placement this close to the identity is the identity


def urdf_of_mjcf(text: str, source: str, folder: str | Path) -> str:
    """Return the URDF of the robot in an MJCF file.

    Each body is a link with the same axes and each hinge or slide a joint with the same positions; several joints in a
    body, or a joint beside the body's origin, get links without mass between them. Sites become links fixed to their
    body, named as they are, so that one can be the end-effector. Boxes, cylinders, capsules and spheres become shapes.

    Args:
        text: The MJCF.
        source: What messages call it.
        folder: Where the files that it includes are.

    Raises:
        ModelError: it is no MJCF, or has something that a URDF cannot hold or that is not understood; the message names
            the body, the joint or the element.
    """
    try:
        return _Conversion(expanded(text, folder)).urdf()
    except ModelError as error:
        raise ModelError(f"'{source}': {error}") from error


@dataclass
class _Place:
    """Where an element stands: the pose of the frames around it in the body, and the class that its defaults are of."""

    pose: pin.SE3
    childclass: str | None

    def inside(self, element: ET.Element, pose: pin.SE3) -> _Place:
        return _Place(self.pose * pose, element.get("childclass", self.childclass))


class _Conversion:
    """One MJCF file on its way to a URDF."""

    def __init__(self, root: ET.Element) -> None:
        self.grammar = Grammar(root)
        self.compiler = Compiler.of(root)
        self.robot = ET.Element("robot", name=root.get("model") or "robot")
        self.links: dict[str, ET.Element] = {}
        self.joints: dict[str, ET.Element] = {}
        self.notes: list[str] = []
        self.undrawn = 0
        self.waiting: list[tuple[ET.Element, _Place, str]] = []
        self.refs: dict[str, float] = {}
        self.taken = {
            element.get("name", "")
            for element in root.iter()
            if element.tag in ("body", "joint", "site") and element.get("name")
        }
        self.worlds = root.findall("worldbody")
        self.file = root

    def urdf(self) -> str:
        start = _Place(pin.SE3.Identity(), None)
        inside = [found for world in self.worlds for found in self._inside(world, start)]
        bodies = [(element, place) for element, place in inside if element.tag == "body"]
        element, place, alone = self._root(bodies)
        free = [e for e, _ in self._inside(element, place) if self.grammar.is_free(e)]
        moving = [e for e, _ in self._inside(element, place) if e.tag == "joint" and not self.grammar.is_free(e)]
        if free and moving:
            raise ModelError(f"body {_named(element)} has a free joint and others")
        root = self._link(element.get("name") or "base") if not moving else self._link(self._free_name("world"))
        where = f"body {_named(element)}"
        if not alone:
            self._tell(root, "bodies that are fixed to the world are left out")
        if free:
            self._check_free(free[0], where, root)
        else:
            self._tell(root, "the file has no free joint: here its root floats")
        if moving:
            self._body(element, place, root)
        else:
            self._contents(element, place, root, where)
        while self.waiting:  # no recursion: bodies may stand in each other by the thousand
            self._body(*self.waiting.pop())
        self._take_equalities()
        self._take_actuators()
        self._scale_total()
        self._tell(root, "MJCF has no rate limits: give the law a rate_limit", "suspicious")
        self._tell_unread(root)
        ET.indent(self.robot)
        return ET.tostring(self.robot, encoding="unicode")

    # Which body is the robot.

    def _root(self, bodies: list[tuple[ET.Element, _Place]]) -> tuple[ET.Element, _Place, bool]:
        moved = [(e, p) for e, p in bodies if next(e.iter("joint"), None) is not None or _has(e, "freejoint")]
        if len(moved) > 1:
            names = ", ".join(_named(element) for element, _ in moved)
            raise ModelError(f"the world has several robots or free bodies, {names}; keep one, on one body")
        if not moved and len(bodies) != 1:
            names = ", ".join(_named(element) for element, _ in bodies) or "no body at all"
            raise ModelError(f"nothing in it moves and the world has {names}; a robot is one body with others in it")
        element, place = (moved or bodies)[0]
        if element.get("mocap") == "true":
            raise ModelError(f"body {_named(element)} is moved from outside (mocap), which no spacecraft is")
        return element, place, len(bodies) == 1

    def _check_free(self, joint: ET.Element, where: str, root: str) -> None:
        given = self.grammar.attributes(joint, None)
        if given.get("align") == "true" or (given.get("align", "auto") == "auto" and self.compiler.alignfree):
            raise ModelError(
                f"{where}: its free joint is aligned with its inertia, which moves its axes; say align=false"
            )
        if joint.tag == "joint" and given.number("armature", 0.0):
            self._tell(root, f"the free joint's armature {given.number('armature', 0.0):g} is left out")

    # The tree.

    def _inside(self, element: ET.Element, place: _Place) -> Iterator[tuple[ET.Element, _Place]]:
        """Yield what stands in a body, through the frames around it."""
        for child in element:
            self.grammar.check(child, element)
            if child.tag == "frame":
                pose = pose_of(self.grammar.attributes(child, None), self.compiler)
                yield from self._inside(child, place.inside(child, pose))
            else:
                yield child, place

    def _body(self, element: ET.Element, place: _Place, parent: str) -> None:
        where = f"body {_named(element)}"
        attributes = self.grammar.attributes(element, None)
        if attributes.get("mocap") == "true":
            raise ModelError(f"{where} is moved from outside (mocap), inside another body")
        pending = place.pose * pose_of(attributes, self.compiler)
        within = _Place(pin.SE3.Identity(), element.get("childclass", place.childclass))
        joints = [(e, p) for e, p in self._inside(element, within) if e.tag in ("joint", "freejoint")]
        name = element.get("name") or self._free_name(f"{parent}_body")
        last: str | None = parent
        for i, (joint, where_it_stands) in enumerate(joints):
            if self.grammar.is_free(joint):
                raise ModelError(f"{where} has a free joint inside another body; only the robot itself can be free")
            before, pending, moving = self._moving(joint, where_it_stands, where, pending, name, i)
            ends = i + 1 == len(joints) and _is_identity(pending)
            child = self._link(name) if ends else self._link(self._free_name(f"{name}_after_{moving.get('name')}"))
            self._connect(moving, str(last), child, before)
            last = child
        if last != name or not joints:
            self._fixed(str(last), self._link(name), pending)
        self._contents(element, within, name, where)

    def _contents(self, element: ET.Element, place: _Place, link: str, where: str) -> None:
        """Give a link its mass, shapes, sites and the bodies that stand in it."""
        within = _Place(pin.SE3.Identity(), element.get("childclass", place.childclass))
        inside = list(self._inside(element, within))
        write = self._mass(inside, where)
        if write is not None:
            write_body(self.links[link], write)
        for child, at in inside:
            if child.tag == "geom":
                self._draw(child, at, self.links[link])
            elif child.tag == "site" and child.get("name"):
                given = self.grammar.attributes(child, at.childclass)
                pose, _ = shape_pose(given, self.compiler)
                joint = self._fixed(link, self._link(self._site_name(child.get("name", ""))), at.pose * pose)
                ET.SubElement(joint, "site")
        bodies = [(child, at, link) for child, at in inside if child.tag == "body"]
        self.waiting += reversed(bodies)

    def _site_name(self, name: str) -> str:
        bodies = {body.get("name") for world in self.worlds for body in world.iter("body")}
        return self._free_name(f"{name}_site") if name in bodies else name

    # Joints.

    def _moving(
        self, joint: ET.Element, place: _Place, where: str, before: pin.SE3, body: str, count: int
    ) -> tuple[pin.SE3, pin.SE3, ET.Element]:
        """Return where a joint stands, what is to follow it, and the joint itself, without its ends."""
        given = self.grammar.attributes(joint, place.childclass)
        name = joint.get("name") or self._free_name(f"{body}_joint")
        kind = given.get("type", "hinge")
        if kind not in ("hinge", "slide"):
            raise ModelError(
                f"{where}: joint '{name}' is a {kind} joint; only hinges and slides are read: write three hinges"
            )
        axis = place.pose.rotation @ given.numbers("axis", 3, (0.0, 0.0, 1.0))
        if not np.linalg.norm(axis) > 1e-10:
            raise ModelError(f"{where}: joint '{name}' has the axis {triple(axis)}, which is no direction")
        axis /= np.linalg.norm(axis)
        point = place.pose.act(given.numbers("pos", 3, (0.0, 0.0, 0.0)))
        scale = self.compiler.angle if kind == "hinge" else 1.0
        ref = scale * given.number("ref", 0.0)
        if kind == "hinge":
            start = pin.SE3(pin.exp3(-ref * axis), point)
            after = pin.SE3(np.eye(3), -point)
        else:
            start, after = pin.SE3(np.eye(3), -ref * axis), pin.SE3.Identity()
        limits = self._range(given, f"{where}: joint '{name}'", scale)
        moving = ET.Element("joint", name=name, type=_type(kind, limits))
        ET.SubElement(moving, "axis", xyz=triple(axis))
        low, high = ("", "") if limits is None else (repr(limits[0]), repr(limits[1]))
        limit = ET.SubElement(moving, "limit", effort=self._joint_effort(given), velocity=NOT_LIMITED)
        if limits is not None or kind == "slide":
            limit.set("lower", low or f"-{NOT_LIMITED}")
            limit.set("upper", high or NOT_LIMITED)
        self._tell_dynamics(moving, given)
        self.joints[name], self.refs[name] = moving, ref
        return before * start, after, moving

    def _range(self, given: Attributes, where: str, scale: float) -> tuple[float, float] | None:
        limited, has_range = given.get("limited", "auto"), "range" in given
        if limited not in ("auto", "true", "false"):
            raise ModelError(f'{where} has limited="{limited}"; it is true, false or auto')
        if limited == "auto" and has_range and not self.compiler.autolimits:
            raise ModelError(f"{where} has a range but does not say whether it is limited, and autolimits is off")
        if limited == "false" or (limited == "auto" and not has_range):
            return None
        low, high = given.numbers("range", 2, (0.0, 0.0))
        if not low < high:
            raise ModelError(f"{where} is limited to the range {low:g} to {high:g}")
        return float(scale * low), float(scale * high)

    def _joint_effort(self, given: Attributes) -> str:
        limited = given.get("actuatorfrclimited", "auto")
        if limited == "false" or "actuatorfrcrange" not in given:
            return NOT_LIMITED
        return _smaller(given.numbers("actuatorfrcrange", 2, ()))

    def _tell_dynamics(self, moving: ET.Element, given: Attributes) -> None:
        """Say what else the joint has that torques would feel."""
        meanings = {
            "armature": "of the drive's rotor, kg m2 or kg",
            "stiffness": "of a spring, N m/rad or N/m",
            "damping": "N m s/rad or N s/m",
            "frictionloss": "N m or N",
        }
        for key, meaning in meanings.items():
            value = given.numbers(key, None, (0.0,))[0]
            if value:
                level = "suspicious" if key in ("armature", "stiffness") else "note"
                _tell(moving, f"{key} {value:g} ({meaning}) is left out: torques do not feel it here", level)

    # Masses.

    def _mass(self, inside: Sequence[tuple[ET.Element, _Place]], where: str) -> Body | None:
        given = [element for element, _ in inside if element.tag == "inertial"]
        if len(given) > 1:
            raise ModelError(f"{where} has two <inertial>")
        body = self._given_mass(given[0], where) if given else None
        from_geoms = self.compiler.inertiafromgeom
        if from_geoms == "true" or (from_geoms == "auto" and not given):
            body = self._geoms_mass(inside, where) or body
        return self.compiler.bounded(body, where)

    def _given_mass(self, inertial: ET.Element, where: str) -> Body:
        given = self.grammar.attributes(inertial, None)
        for key in ("mass", "pos"):
            if key not in given:
                raise ModelError(f"{where}: its <inertial> has no {key}")
        pose = pose_of(given, self.compiler)
        mass = given.number("mass", 0.0)
        if "fullinertia" in given:
            xx, yy, zz, xy, xz, yz = given.numbers("fullinertia", 6, ())
            tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            if "diaginertia" in given or not _is_identity(pin.SE3(pose.rotation, np.zeros(3))):
                raise ModelError(f"{where}: its <inertial> has fullinertia and a diagonal one, or axes of its own")
        else:
            tensor = np.diag(given.numbers("diaginertia", 3, (0.0, 0.0, 0.0)))
        R = pose.rotation
        return Body(mass, np.array(pose.translation), R @ tensor @ R.T)

    def _geoms_mass(self, inside: Sequence[tuple[ET.Element, _Place]], where: str) -> Body | None:
        low, high = self.compiler.groups
        total = None
        for element, place in inside:
            if element.tag != "geom":
                continue
            given = self.grammar.attributes(element, place.childclass)
            if not low <= given.number("group", 0.0) <= high:
                continue
            inertia = self._geom_inertia(given, f"{where}: geom {_named(element)}")
            if inertia is None:
                continue
            pose, _ = shape_pose(given, self.compiler)
            placed = (place.pose * pose).act(inertia)
            total = placed if total is None else total + placed
        if total is None:
            return None
        return Body(float(total.mass), np.array(total.lever), np.array(total.inertia))

    def _geom_inertia(self, given: Attributes, where: str) -> pin.Inertia | None:
        """Return the inertia of a geom in its own axes; None of one that weighs nothing."""
        if given.get("shellinertia") == "true":
            raise ModelError(f"{where} is a shell (shellinertia), which is not read; give its body an <inertial>")
        mass = given.number("mass", -1.0) if "mass" in given else None
        density = given.number("density", 1000.0)
        if mass == 0 or (mass is None and density == 0):
            return None
        kind = given.get("type", "sphere")
        if kind in ("plane", "hfield"):
            return None
        if "mesh" in given or kind not in _INERTIA:
            raise ModelError(
                f"{where} is a {'mesh' if 'mesh' in given else kind} that weighs, which is not read; give its body an "
                f'<inertial>. MuJoCo writes one with <compiler saveinertial="true"/>: {EXPAND}'
            )
        _, size = shape_pose(given, self.compiler)
        if not np.all(size > 0) or (mass is not None and mass < 0) or density < 0:
            raise ModelError(f"{where} has the size {size.tolist()}, mass {mass} and density {density:g}")
        weighs = density * _volume(kind, size) if mass is None else mass
        return _INERTIA[kind](weighs, size)

    def _scale_total(self) -> None:
        wanted = self.compiler.settotalmass
        if wanted is None:
            return
        found = sum(float(mass.get("value", "0")) for mass in self.robot.findall("link/inertial/mass"))
        if not found > 0:
            raise ModelError("compiler settotalmass scales masses, and there are none")
        for inertial in self.robot.findall("link/inertial"):
            for part in (inertial.find("mass"), inertial.find("inertia")):
                for key, value in part.attrib.items():  # type: ignore[union-attr]
                    part.set(key, repr(float(value) * wanted / found))  # type: ignore[union-attr]

    # Shapes.

    def _draw(self, element: ET.Element, place: _Place, link: ET.Element) -> None:
        given = self.grammar.attributes(element, place.childclass)
        kind = given.get("type", "sphere")
        if "mesh" in given or kind not in ("box", "sphere", "cylinder", "capsule"):
            self.undrawn += 1
            return
        pose, size = shape_pose(given, self.compiler)
        touches = given.number("contype", 1.0) or given.number("conaffinity", 1.0)
        tags = [*(["visual"] if given.number("group", 0.0) < 3 else []), *(["collision"] if touches else [])]
        for tag in tags:
            for at, shape in _shapes(kind, size):
                self._draw_one(tag, place.pose * pose * at, shape, given, link)

    def _draw_one(self, tag: str, pose: pin.SE3, shape: ET.Element, given: Attributes, link: ET.Element) -> None:
        figure = ET.SubElement(link, tag)
        _origin(figure, pose)
        ET.SubElement(figure, "geometry").append(shape)
        if tag == "visual" and "rgba" in given:
            material = ET.SubElement(figure, "material", name="")
            ET.SubElement(material, "color", rgba=given.get("rgba", ""))

    # What else the file says about joints.

    def _take_equalities(self) -> None:
        for element in self.file.findall("equality/*"):
            given = self.grammar.attributes(element, None)
            if not given.truth("active", True):
                continue
            ends = [given.get(key) for key in ("joint1", "joint2", "body1", "body2", "site1", "site2") if key in given]
            polynomial = np.zeros(5)
            told = given.numbers("polycoef", None, (0.0, 1.0))
            polynomial[: told.size] = told[:5]
            joint, leader = (self.joints.get(given.get(key)) for key in ("joint1", "joint2"))
            if element.tag != "joint" or joint is None or leader is None or np.any(polynomial[2:]):
                raise ModelError(
                    f"equality {element.tag} between {' and '.join(ends) or 'nothing'} is not read: it would close a "
                    "loop, or hold the robot; take it out"
                )
            self._tie(joint, leader, polynomial)

    def _tie(self, joint: ET.Element, leader: ET.Element, polynomial: Floats) -> None:
        """Let a joint follow another: MuJoCo counts both from where the file shows them, URDF from zero."""
        follower, leading = joint.get("name", ""), leader.get("name", "")
        offset = self.refs[follower] + polynomial[0] - polynomial[1] * self.refs[leading]
        ET.SubElement(joint, "mimic", joint=leading, multiplier=repr(float(polynomial[1])), offset=repr(float(offset)))

    def _take_actuators(self) -> None:
        forces: dict[str, list[str]] = {}
        for element in self.file.findall("actuator/*"):
            given = self.grammar.attributes(element, None)
            name = given.get("joint") or given.get("jointinparent")
            if name in self.joints:
                forces.setdefault(str(name), []).append(self._force(element, given))
        for name, each in forces.items():
            limit = self.joints[name].find("limit")
            total = sum(float(force) for force in each)
            if limit is not None and total < float(limit.get("effort", NOT_LIMITED)):
                limit.set("effort", repr(total))

    def _force(self, element: ET.Element, given: Attributes) -> str:
        """Return the largest torque of an actuator, where its file bounds it."""
        gear = abs(float(given.numbers("gear", None, (1.0,))[0]))
        bounds = [float("inf")]
        if "forcerange" in given and given.get("forcelimited", "auto") != "false":
            bounds.append(float(_smaller(given.numbers("forcerange", 2, ()))))
        if element.tag == "motor" and "ctrlrange" in given and given.get("ctrllimited", "auto") != "false":
            bounds.append(float(_smaller(given.numbers("ctrlrange", 2, ()))))
        largest = gear * min(bounds)
        return repr(largest) if 0 < largest < float("inf") else NOT_LIMITED

    def _tell_unread(self, root: str) -> None:
        if self.undrawn:
            self._tell(
                root,
                f"{self.undrawn} geoms that are no box, cylinder, capsule or sphere are not drawn, and "
                "clearances do not see them",
            )
        for tendon in self.file.findall("tendon/*"):
            self._tell(root, f"tendon {_named(tendon)} is left out", "suspicious")
        if self.file.find("deformable/flex") is not None:
            raise ModelError("it has a flexible body (flex), which is not read")

    # The URDF.

    def _link(self, name: str) -> str:
        if name in self.links:
            raise ModelError(f"two bodies or sites would be called '{name}'; rename one")
        self.links[name] = ET.SubElement(self.robot, "link", name=name)
        return name

    def _connect(self, joint: ET.Element, parent: str, child: str, pose: pin.SE3) -> None:
        ends = [ET.Element("parent", link=parent), ET.Element("child", link=child)]
        joint[:0] = ends
        _origin(joint, pose)
        self.robot.append(joint)

    def _fixed(self, parent: str, child: str, pose: pin.SE3) -> ET.Element:
        joint = ET.Element("joint", name=self._free_name(f"{child}_fixed"), type="fixed")
        self._connect(joint, parent, child, pose)
        return joint

    def _free_name(self, name: str) -> str:
        found, count = name, 1
        while found in self.taken:
            count += 1
            found = f"{name}_{count}"
        self.taken.add(found)
        return found

    def _tell(self, link: str, message: str, level: str = "note") -> None:
        _tell(self.links[link], message, level)


def _tell(element: ET.Element, message: str, level: str) -> None:
    """Leave a word in a link or joint, which `inspect_urdf` reads."""
    told = ET.SubElement(element, "left_out", level=level)
    told.text = message


def _named(element: ET.Element) -> str:
    return f"'{element.get('name')}'" if element.get("name") else "without a name"


def _has(element: ET.Element, tag: str) -> bool:
    return next(element.iter(tag), None) is not None


def _is_identity(pose: pin.SE3) -> bool:
    return bool(np.abs(pose.homogeneous - np.eye(4)).max() < _SAME)


def _type(kind: str, limits: tuple[float, float] | None) -> str:
    if kind == "slide":
        return "prismatic"
    return "continuous" if limits is None else "revolute"


def _smaller(bounds: Floats) -> str:
    """Return the torque that a drive has in both directions; none where it is not bounded by numbers above zero."""
    smaller = min(abs(float(bounds[0])), abs(float(bounds[1])))
    return repr(smaller) if smaller > 0 else NOT_LIMITED


def _origin(element: ET.Element, pose: pin.SE3) -> None:
    ET.SubElement(element, "origin", xyz=triple(pose.translation), rpy=triple(pin.rpy.matrixToRpy(pose.rotation)))


def _volume(kind: str, size: Floats) -> float:
    r = float(size[0])
    if kind == "box":
        return float(8 * np.prod(size[:3]))
    if kind == "cylinder":
        return float(np.pi * r**2 * 2 * size[1])
    sphere = float(4 / 3 * np.pi * r**3)
    if kind == "capsule":
        return sphere + float(np.pi * r**2 * 2 * size[1])
    return sphere if kind == "sphere" else float(4 / 3 * np.pi * np.prod(size[:3]))


_INERTIA: dict[str, Callable[[float, Floats], pin.Inertia]] = {
    "sphere": lambda m, s: pin.Inertia.FromSphere(m, s[0]),
    "capsule": lambda m, s: pin.Inertia.FromCapsule(m, s[0], 2 * s[1]),
    "cylinder": lambda m, s: pin.Inertia.FromCylinder(m, s[0], 2 * s[1]),
    "ellipsoid": lambda m, s: pin.Inertia.FromEllipsoid(m, s[0], s[1], s[2]),
    "box": lambda m, s: pin.Inertia.FromBox(m, 2 * s[0], 2 * s[1], 2 * s[2]),
}


def _shapes(kind: str, size: Floats) -> Iterator[tuple[pin.SE3, ET.Element]]:
    at = pin.SE3.Identity()
    if kind == "box":
        yield at, ET.Element("box", size=triple(2 * size[:3]))
    if kind == "sphere":
        yield at, ET.Element("sphere", radius=repr(float(size[0])))
    if kind in ("cylinder", "capsule"):
        yield at, ET.Element("cylinder", radius=repr(float(size[0])), length=repr(float(2 * size[1])))
    if kind == "capsule":
        for end in (-size[1], size[1]):
            yield pin.SE3(np.eye(3), np.array([0.0, 0.0, end])), ET.Element("sphere", radius=repr(float(size[0])))
