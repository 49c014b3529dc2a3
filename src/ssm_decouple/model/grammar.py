"""What a URDF says in a form that could be overlooked: elements and attributes out of place, twice, or unreadable."""

from __future__ import annotations

import difflib
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from functools import lru_cache

from ssm_decouple.model.urdf import Finding, number, numbers

MOVING = ("revolute", "continuous", "prismatic")

# What is read of a link, of its <inertial> and of a joint, each at most once, and the attributes of each of these.
_ONCE = {
    "link": ("inertial",),
    "inertial": ("origin", "mass", "inertia"),
    "joint": ("parent", "child", "origin", "axis", "limit", "dynamics", "mimic"),
}
_OTHERS = {"link": ("visual", "collision"), "inertial": (), "joint": ("safety_controller", "calibration", "wheel")}
ATTRIBUTES = {
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
    "parent": ("link",),
    "child": ("link",),
}
# A unit or a scale changes what every number beside it means; URDF has none.
_UNITS = ("unit", "units", "scale", "degrees")
_STRICT = ("origin", "mass", "inertia", "axis")  # an attribute that is not read changes what the element means
_ALIASES = {("limit", "min"): "lower", ("limit", "max"): "upper"}
_NUMBERS = {key for keys in ATTRIBUTES.values() for key in keys} - {"link", "joint"}  # none of a link or joint itself
_WORDS = {word for words in _ONCE.values() for word in words} | {"link", "joint"}


def inspect_grammar(root: ET.Element) -> list[Finding]:
    """Say what a reader of the URDF would overlook or could not read, by link or joint."""
    return [Finding("impossible", where, message) for where, message in _faults(root)]


def _faults(root: ET.Element) -> Iterator[tuple[str, str]]:
    if not root.get("name"):
        yield "robot", 'has no name: write <robot name="..">'
    yield from _stray(root, "robot")
    yield from _units(root, "robot")
    for element in root:
        if element.tag not in ("link", "joint"):
            tag = _local(element.tag)
            meant = _meant(tag, ("link", "joint"))
            if meant or tag in _WORDS:
                mend = f": write <{meant}>, without a prefix" if meant else ""
                yield "robot", f"<{tag}> is not read there{mend}"
            elif tag == "include":
                yield "robot", "<include> is not followed: put what it includes into the file"
            else:
                yield from _buried(element, "robot", ("inertial",))
            continue
        where = f"{element.tag} {element.get('name')}"
        if not element.get("name"):
            yield where, "has no name"
        yield from _contents(element, where)
        inertial = element.find("inertial") if element.tag == "link" else None
        if inertial is not None:
            yield from _contents(inertial, where)
            yield from _inertial_numbers(inertial, where)
        if element.tag == "joint":
            yield from _joint_numbers(element, where)
        for shape in element.findall("collision"):
            yield from _origin_numbers(shape, where)


def _contents(element: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    """Check what stands directly in a link, an <inertial> or a joint."""
    once = _ONCE[element.tag]
    yield from _stray(element, where)
    yield from _units(element, where)
    tags = [_local(child.tag) for child in element]
    for key in element.attrib:
        if _local(key) in _NUMBERS:
            yield where, f"<{element.tag} {_local(key)}=..> is not read: it belongs in an element inside"
    for tag in dict.fromkeys(tags):
        count = tags.count(tag)
        if tag in once and element.find(tag) is None:
            yield where, f"<{tag}> has a namespace and is not read: write <{tag}> without a prefix"
        elif tag in once and count > 1:
            yield where, f"has {count} <{tag}>, of which one would be read; keep one"
        elif tag not in once and tag not in _OTHERS[element.tag]:
            meant = "origin" if tag == "pose" else _meant(tag, (*once, *_OTHERS[element.tag]))
            if meant:
                yield where, f"<{tag}> is not read: write <{meant}>"
            elif tag in _WORDS and not all(_is_identity(child) for child in element.findall(tag)):
                yield where, f"<{tag}> is not read in <{element.tag}>; put it where URDF has it"
    for child in element:
        if child.tag in ATTRIBUTES and child.tag in once:
            yield from _leaf(child, where)
        elif child.tag not in once and child.tag != "left_out":
            shape = child.tag in ("visual", "collision", "contact", "self_filter", "sensor")
            yield from _buried(child, where, ("inertial",) if shape else once)


def _local(name: object) -> str:
    """Return the name of an element or attribute without its namespace."""
    return str(name).rpartition("}")[2]


def _buried(element: ET.Element, where: str, words: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    """Say what would be lost with an element that is not read."""
    for inner in element.iter():
        if inner is not element and _local(inner.tag) in words:
            tag = _local(inner.tag)
            yield where, f"<{tag}> inside of <{_local(element.tag)}> is not read; put it where URDF has it"
            return


def _units(element: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    for key in element.attrib:
        if _local(key) in _UNITS:
            tag = element.tag
            yield where, f"<{tag} {_local(key)}=..> is not read: URDF has m, kg, s and rad; write numbers in these"


def _is_identity(element: ET.Element) -> bool:
    """Say whether an element is an <origin> that moves nothing, so that nothing is lost with it."""
    values = [_finite(element.get(key, "0 0 0"), 3) for key in ("xyz", "rpy")]
    return element.tag == "origin" and not any(value is None or any(value) for value in values)


def _leaf(leaf: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    """Check the attributes of an element that has nothing else."""
    known = ATTRIBUTES[leaf.tag]
    yield from _units(leaf, where) if leaf.tag not in _STRICT else ()
    for key in leaf.attrib:
        if key.startswith("{") and _local(key) in known and _local(key) not in leaf.attrib:
            yield where, f"<{leaf.tag} {_local(key)}=..> has a namespace and is not read: write it without a prefix"
        if key in known or key.startswith("{"):
            continue
        meant = _ALIASES.get((leaf.tag, key)) or _meant(key, tuple(word for word in known if word not in leaf.attrib))
        if meant:
            yield where, f"<{leaf.tag} {key}=..> is not read: write {meant}"
        elif leaf.tag in _STRICT:
            yield where, f"<{leaf.tag} {key}=..> is not read; it may have {', '.join(known)}: remove it"
    if len(leaf):
        yield where, f"<{leaf.tag}> has <{leaf[0].tag}> inside, which is not read; it has attributes only"
    if leaf.text and leaf.text.strip():
        example = f'<{leaf.tag} {known[0]}=".."/>'
        yield where, f"<{leaf.tag}> has the text '{_short(leaf.text)}', which is not read: write {example}"


def _stray(element: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    for text in (element.text, *(child.tail for child in element)):
        if text and text.strip():
            yield where, f"has the text '{_short(text)}' outside of any tag: a tag is damaged, or remove it"


def _short(text: str) -> str:
    words = " ".join(text.split())
    return words if len(words) <= 60 else words[:57] + "..."


@lru_cache(maxsize=1024)
def _meant(word: str, known: tuple[str, ...]) -> str | None:
    """Return the known word that another one is a misspelling of."""
    near = difflib.get_close_matches(word.lower(), known, 1, 0.75)
    return near[0] if near else None


def _inertial_numbers(inertial: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    yield from _origin_numbers(inertial, where)
    for tag, keys in (("mass", ("value",)), ("inertia", ATTRIBUTES["inertia"])):
        element = inertial.find(tag)
        for key in keys:
            given = None if element is None else element.get(key)
            if given is None:
                yield where, f"<inertial> lacks <{tag} {key}=..>"
                break
            yield from _unreadable(where, tag, key, given)


def _joint_numbers(joint: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    kind = joint.get("type")
    yield from _origin_numbers(joint, where)
    if kind not in ("fixed", "floating", *MOVING):
        known = ", ".join(MOVING)
        yield where, f"type '{kind}' is not supported; use fixed or one of {known}"
    if joint.get("name") == "universe":
        yield where, "Pinocchio calls its own world 'universe' and takes no joint of that name; rename the joint"
    if kind not in MOVING:
        return
    axis = joint.find("axis")
    given = "1 0 0" if axis is None else axis.get("xyz", "")
    values = _finite(given, 3)
    if values is None or not any(values):
        yield where, f'<axis xyz="{_short(given)}"> needs 3 finite numbers, not all zero'
    for tag in ("limit", "dynamics"):
        element = joint.find(tag)
        for key in () if element is None else ATTRIBUTES[tag]:
            text = None if element is None else element.get(key)
            if text is not None:
                yield from _unreadable(where, tag, key, text, finite=tag == "dynamics")


def _unreadable(where: str, tag: str, key: str, given: str, finite: bool = False) -> Iterator[tuple[str, str]]:
    try:
        value = number(given)
    except ValueError as error:
        yield where, f'<{tag} {key}="{_short(given)}"> is malformed: {error}'
        return
    endless = {"lower": math.inf, "upper": -math.inf, "effort": -math.inf, "velocity": -math.inf}
    if tag != "mass" and tag != "inertia" and (math.isnan(value) or value == endless.get(key)):
        yield where, f'<{tag} {key}="{_short(given)}"> needs a number'
    elif key in ("effort", "velocity") and value < 0:
        yield where, f'<{tag} {key}="{_short(given)}"> is negative; a limit is a size, or is left out'
    elif finite and not math.isfinite(value):
        yield where, f'<{tag} {key}="{_short(given)}"> needs a finite number'


def _origin_numbers(element: ET.Element, where: str) -> Iterator[tuple[str, str]]:
    for origin in element.findall("origin"):
        yield from ((where, fault) for fault in origin_faults(origin))


def origin_faults(origin: ET.Element) -> Iterator[str]:
    """Say what is wrong with the numbers of an <origin>."""
    for key, size in (("xyz", 3), ("rpy", 3), ("quat_xyzw", 4)):
        given = origin.get(key)
        if given is None:
            continue
        values = _finite(given, size)
        if values is None:
            yield f'<origin {key}="{_short(given)}"> needs {size} finite numbers'
        elif key == "quat_xyzw":
            if origin.get("rpy") is not None:
                yield "<origin> has both rpy and quat_xyzw; keep one"
            length = math.hypot(*values)
            if abs(length - 1) > 1e-3:
                yield f'<origin quat_xyzw="{_short(given)}"> has length {length:.6g}; a rotation needs length 1'


def _finite(text: str, size: int) -> tuple[float, ...] | None:
    """Return so many finite numbers, None where it has not these."""
    try:
        values = numbers(text)
    except ValueError:
        return None
    return values if len(values) == size and all(map(math.isfinite, values)) else None
