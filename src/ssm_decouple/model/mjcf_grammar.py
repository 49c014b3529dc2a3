"""What the elements of an MJCF file mean: includes, compiler settings, default classes, numbers and orientations."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import ModelError, unknown
from ssm_decouple.model.urdf import Body, floats

Floats = NDArray[np.float64]

EXPAND = (
    "let MuJoCo write the file out, `python -c \"import mujoco; mujoco.mj_saveLastXML('plain.xml', "
    "mujoco.MjModel.from_xml_path('robot.xml'))\"`"
)
_TURNS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
_PLACE = ("name", "class", "pos", *_TURNS)
_PLAIN = ("user", "group", "rgba", "material")
# What is understood of each element, or has no bearing on bodies, joints and frames. Anything else is refused.
_ATTRIBUTES = {
    "frame": ("name", "childclass", "pos", *_TURNS),
    "body": ("name", "childclass", "pos", *_TURNS, "mocap", "gravcomp", "user", "sleep"),
    "inertial": ("pos", *_TURNS, "mass", "diaginertia", "fullinertia"),
    "freejoint": ("name", "group", "align"),
    "joint": (
        *("name", "class", "type", "group", "pos", "axis", "range", "limited", "ref", "springref", "stiffness"),
        *("damping", "armature", "frictionloss", "margin", "springdamper", "user", "align", "actuatorfrcrange"),
        *("actuatorfrclimited", "actuatorgravcomp", "solreflimit", "solimplimit", "solreffriction", "solimpfriction"),
    ),
    "geom": (
        *_PLACE,
        *_PLAIN,
        *("type", "size", "fromto", "mass", "density", "shellinertia", "mesh", "hfield", "fitscale", "contype"),
        *("conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp", "margin", "gap", "fluidshape"),
        "fluidcoef",
    ),
    "site": (*_PLACE, *_PLAIN, "type", "size", "fromto"),
}
_INSIDE = {
    "mujoco": (
        *(
            "compiler",
            "option",
            "size",
            "visual",
            "statistic",
            "default",
            "asset",
            "worldbody",
            "contact",
            "deformable",
        ),
        *("equality", "tendon", "actuator", "sensor", "keyframe", "custom", "extension"),
    ),
    "worldbody": ("body", "frame", "geom", "site"),
    "body": ("body", "frame", "inertial", "joint", "freejoint", "geom", "site"),
    "frame": ("body", "frame", "joint", "freejoint", "geom", "site"),
}
_IGNORED_IN_BODIES = ("camera", "light")
_COMPILER = (
    *("angle", "eulerseq", "autolimits", "boundmass", "boundinertia", "settotalmass", "balanceinertia"),
    *("inertiafromgeom", "inertiagrouprange", "alignfree", "coordinate", "fusestatic", "discardvisual", "usethread"),
    *("strippath", "meshdir", "texturedir", "assetdir", "saveinertial", "exactmeshinertia"),
)


def expanded(text: str, folder: str | Path, inside: tuple[Path, ...] = ()) -> ET.Element:
    """Return the <mujoco> element of an MJCF text, what it includes put in its place.

    Raises:
        ModelError: not XML, not MJCF, or a file that cannot be included.
    """
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise ModelError(f"it is not XML: {error}") from error
    if root.tag not in ("mujoco", "mujocoinclude"):
        raise ModelError(f"its root is <{root.tag}>, expected <mujoco>")
    for parent in list(root.iter()):
        _include(parent, Path(folder), inside)
    return root


def _include(parent: ET.Element, folder: Path, inside: tuple[Path, ...]) -> None:
    for place in range(len(parent) - 1, -1, -1):
        element = parent[place]
        if element.tag != "include":
            continue
        path = folder / element.get("file", "")
        if path in inside:
            raise ModelError(f"'{path}' includes itself")
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            why = getattr(error, "strerror", None) or "it is not text"
            raise ModelError(f"cannot include '{path}': {why}") from error
        parent[place : place + 1] = list(expanded(text, folder, (*inside, path)))


@dataclass(frozen=True)
class Attributes:
    """The attributes of an element, its defaults among them.

    Attributes:
        where: What messages call the element.
        given: Name to text.
    """

    where: str
    given: Mapping[str, str]

    def __contains__(self, key: str) -> bool:
        return key in self.given

    def get(self, key: str, default: str = "") -> str:
        """Return a text."""
        return self.given.get(key, default).strip()

    def numbers(self, key: str, count: int | None, default: tuple[float, ...]) -> Floats:
        """Return finite numbers (count,), as many as there are where it is None.

        Raises:
            ModelError: others.
        """
        try:
            values = floats(self.given.get(key), default)
        except ValueError as error:
            raise ModelError(f'{self.where} has {key}="{self.given[key]}": {error}') from error
        if (count is not None and values.shape != (count,)) or not values.size or not np.all(np.isfinite(values)):
            needs = "finite numbers" if count is None else f"{count} finite numbers"
            raise ModelError(f'{self.where} has {key}="{self.get(key)}"; it needs {needs}')
        return values

    def number(self, key: str, default: float) -> float:
        """Return one finite number."""
        return float(self.numbers(key, 1, (default,))[0])

    def truth(self, key: str, default: bool = False) -> bool:
        """Return whether it is "true".

        Raises:
            ModelError: it is neither that nor "false".
        """
        text = self.get(key, "true" if default else "false")
        if text not in ("true", "false"):
            raise ModelError(f'{self.where} has {key}="{text}"; it is true or false')
        return text == "true"


@dataclass(frozen=True)
class Compiler:
    """What <compiler> says; the defaults are MuJoCo's.

    Attributes:
        angle: Of one unit of its angles, rad.
        eulerseq: Axes of euler angles in their order; small letters turn with the body.
        autolimits: Whether a range alone makes a joint limited.
        boundmass: Least mass of a body, kg.
        boundinertia: Least principal moment of a body, kg m2.
        settotalmass: What all masses are scaled to, kg; None leaves them.
        balanceinertia: Whether moments that no body has become their mean.
        inertiafromgeom: "auto" where a body has no <inertial>, "true" or "false".
        groups: Lowest and highest group of the geoms that weigh.
        alignfree: Whether free joints are aligned with the inertia unless they say otherwise.
    """

    angle: float = float(np.pi / 180)
    eulerseq: str = "xyz"
    autolimits: bool = True
    boundmass: float = 0.0
    boundinertia: float = 0.0
    settotalmass: float | None = None
    balanceinertia: bool = False
    inertiafromgeom: str = "auto"
    groups: tuple[float, float] = (0.0, 5.0)
    alignfree: bool = False

    @classmethod
    def of(cls, root: ET.Element) -> Compiler:
        """Read the <compiler> elements of a file, later ones before earlier ones."""
        merged: dict[str, str] = {}
        for element in root.findall("compiler"):
            merged |= element.attrib
            if len(element):
                raise ModelError(f"compiler: element <{element[0].tag}> is not read; {EXPAND}")
        for key in merged:
            if key not in _COMPILER:
                raise ModelError(f"compiler: {unknown('attribute', key, _COMPILER)}")
        given, plain = Attributes("compiler", merged), cls()
        if given.get("angle", "degree") not in ("degree", "radian"):
            raise ModelError(f"compiler: angle is {given.get('angle')!r}; it is degree or radian")
        if given.get("coordinate", "local") != "local":
            raise ModelError("compiler: global coordinates are no longer part of MJCF")
        sequence = given.get("eulerseq", plain.eulerseq)
        if len(sequence) != 3 or set(sequence) - set("xyzXYZ"):
            raise ModelError(f"compiler: eulerseq is {sequence!r}; it has three of the letters xyzXYZ")
        from_geoms = given.get("inertiafromgeom", "auto")
        if from_geoms not in ("auto", "true", "false"):
            raise ModelError(f"compiler: inertiafromgeom is {from_geoms!r}; it is auto, true or false")
        low, high = given.numbers("inertiagrouprange", 2, plain.groups)
        total = given.number("settotalmass", -1.0)
        return cls(
            angle=1.0 if given.get("angle") == "radian" else plain.angle,
            eulerseq=sequence,
            autolimits=given.truth("autolimits", True),
            boundmass=given.number("boundmass", 0.0),
            boundinertia=given.number("boundinertia", 0.0),
            settotalmass=total if total > 0 else None,
            balanceinertia=given.truth("balanceinertia"),
            inertiafromgeom=from_geoms,
            groups=(float(low), float(high)),
            alignfree=given.truth("alignfree"),
        )

    def bounded(self, body: Body | None, where: str) -> Body | None:
        """Return a body with its least mass and moments, in the order in which MuJoCo sees to them.

        Raises:
            ModelError: its moments are such as no body has.
        """
        if body is None and not (self.boundmass or self.boundinertia):
            return None
        body = body or Body(0.0, np.zeros(3), np.zeros((3, 3)))
        if not body.mass >= 0:
            raise ModelError(f"{where} weighs {body.mass:g} kg; it must be zero or more")
        moments, axes = np.linalg.eigh(body.inertia)
        if moments[0] < -1e-12 * max(moments[2], 0.0):
            raise ModelError(f"{where} has the negative principal moment {moments[0]:g} kg m2")
        balanced = self.balanceinertia and moments[0] + moments[1] < moments[2]
        if not self.boundmass and not self.boundinertia and not balanced:
            return body
        moments = np.maximum(moments, self.boundinertia)
        if self.balanceinertia and moments[0] + moments[1] < moments[2]:
            moments = np.full(3, moments.mean())
        return dataclasses.replace(body, mass=max(body.mass, self.boundmass), inertia=(axes * moments) @ axes.T)


class Grammar:
    """The default classes of a file, and what its elements say with them.

    Args:
        root: The <mujoco> element, with nothing left to include.

    Raises:
        ModelError: classes that MuJoCo would refuse.
    """

    def __init__(self, root: ET.Element) -> None:
        self._classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for element in root:
            self.check(element, root)
        for element in root.findall("default"):
            if element.get("class", "main") != "main":
                raise ModelError(f"the default class '{element.get('class')}' stands at the top, where only main is")
            self._read(element, "main")

    def _read(self, element: ET.Element, name: str) -> None:
        own = self._classes[name]
        for child in element:
            if child.tag != "default":
                tag = child.tag if child.tag in _ATTRIBUTES else "actuator"
                if tag == "actuator" and child.tag not in _ACTUATORS:
                    continue
                self._known(child, f"default class '{name}': ")
                own[tag] = _merged(own.get(tag, {}), child.attrib)
        for child in element.findall("default"):
            below = child.get("class", "")
            if not below or below in self._classes:
                raise ModelError(f"a default class is called '{below}'; each needs a name of its own")
            self._classes[below] = {tag: dict(values) for tag, values in own.items()}
            self._read(child, below)

    def _known(self, element: ET.Element, where: str = "") -> None:
        known = _ATTRIBUTES.get(element.tag)
        for key in element.attrib if known is not None else ():
            if key not in known:  # type: ignore[operator]
                raise ModelError(f"{where}{_described(element)}: {unknown('attribute', key, known or ())}")

    def check(self, child: ET.Element, parent: ET.Element) -> None:
        """Refuse an element that is not understood where it stands.

        Raises:
            ModelError: naming it and the body.
        """
        if child.tag in _IGNORED_IN_BODIES:
            return
        allowed = _INSIDE.get(parent.tag, ())
        if child.tag not in allowed:
            raise ModelError(f"{_described(parent)}: element <{child.tag}> is not read; {EXPAND}")
        if parent.tag != "mujoco":
            self._known(child)

    def attributes(self, element: ET.Element, childclass: str | None) -> Attributes:
        """Return the attributes of an element, its defaults among them.

        Args:
            element: It has its own class, or that of what it stands in.
            childclass: The latter; None is the class of all.

        Raises:
            ModelError: a class that does not exist.
        """
        name = element.get("class", childclass or "main")
        if name not in self._classes:
            raise ModelError(f"{_described(element)}: {unknown('default class', name, list(self._classes))}")
        tag = "actuator" if element.tag in _ACTUATORS else element.tag
        defaults = self._classes[name].get(tag, {}) if tag != "freejoint" else {}
        return Attributes(_described(element), _merged(defaults, element.attrib))

    def is_free(self, element: ET.Element) -> bool:
        """Say whether an element is a free joint."""
        return element.tag == "freejoint" or (element.tag == "joint" and element.get("type") == "free")


_ACTUATORS = (
    *("general", "motor", "position", "velocity", "intvelocity", "damper", "cylinder", "muscle", "adhesion"),
    *("plugin", "dcmotor"),
)


def _merged(defaults: Mapping[str, str], own: Mapping[str, str]) -> dict[str, str]:
    """Put own attributes before defaults: of the ways to turn, a way of one's own replaces all others."""
    turned = [key for key in _TURNS if key in own]
    kept = {key: value for key, value in defaults.items() if not (turned and key in _TURNS)}
    return kept | dict(own)


def _described(element: ET.Element) -> str:
    name = element.get("name")
    return f"{element.tag} '{name}'" if name else f"a {element.tag} without a name"


def pose_of(given: Attributes, compiler: Compiler) -> pin.SE3:
    """Return the pose that pos and one of quat, axisangle, euler, xyaxes and zaxis say.

    Raises:
        ModelError: two orientations, or numbers that make none.
    """
    turned = [key for key in _TURNS if key in given]
    if len(turned) > 1:
        raise ModelError(f"{given.where} is turned twice, by {' and '.join(turned)}")
    R = _rotation(turned[0], given, compiler) if turned else np.eye(3)
    return pin.SE3(R, given.numbers("pos", 3, (0.0, 0.0, 0.0)))


def _rotation(key: str, given: Attributes, compiler: Compiler) -> Floats:
    counts = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}
    values = given.numbers(key, counts[key], ())
    if key == "euler":
        R = np.eye(3)
        for letter, angle in zip(compiler.eulerseq, compiler.angle * values, strict=True):
            turn = pin.exp3(angle * np.eye(3)["xyz".index(letter.lower())])
            R = R @ turn if letter.islower() else turn @ R
        return R
    if key == "quat":
        w, x, y, z = _unit(values, given, key)
        return pin.Quaternion(w, x, y, z).matrix()
    if key == "axisangle":
        return pin.exp3(compiler.angle * values[3] * _unit(values[:3], given, key))
    if key == "zaxis":
        return _to_z(_unit(values, given, key))
    x = _unit(values[:3], given, key)
    y = _unit(values[3:] - (values[3:] @ x) * x, given, key)
    return np.column_stack([x, y, np.cross(x, y)])


def _unit(vector: Floats, given: Attributes, key: str) -> Floats:
    length = float(np.linalg.norm(vector))
    if not length > 1e-10:
        raise ModelError(f'{given.where} has {key}="{given.get(key)}", which is no direction')
    return vector / length


def _to_z(direction: Floats) -> Floats:
    """Return the least rotation that takes z to a unit vector; about x where it is -z."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    axis = np.array([1.0, 0.0, 0.0]) if sine < 1e-10 else axis / sine
    return pin.exp3(np.arctan2(sine, direction[2]) * axis)


def shape_pose(given: Attributes, compiler: Compiler) -> tuple[pin.SE3, Floats]:
    """Return the pose and the size (3,) of a geom or site: its radius or half edges, and half lengths, m.

    Raises:
        ModelError: they are not given as its type needs them.
    """
    kind = given.get("type", "sphere")
    size = np.zeros(3)
    if "size" in given:
        values = given.numbers("size", None, ())[:3]
        size[: values.size] = values
    if "fromto" not in given:
        return pose_of(given, compiler), size[: _SIZES.get(kind, 3)]
    if kind not in ("capsule", "cylinder", "box", "ellipsoid"):
        raise ModelError(f"{given.where} has fromto, which a {kind} has not")
    ends = given.numbers("fromto", 6, ())
    along = ends[:3] - ends[3:]
    length = float(np.linalg.norm(along))
    if not length > 1e-10:
        raise ModelError(f'{given.where} has fromto="{given.get("fromto")}", two equal points')
    size = np.array([size[0], 0.5 * length] if kind in ("capsule", "cylinder") else [size[0], size[0], 0.5 * length])
    return pin.SE3(_to_z(along / length), 0.5 * (ends[:3] + ends[3:])), size


_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "ellipsoid": 3}
