"""A Pinocchio model against what the URDF says: every number, to rounding."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import ModelError
from ssm_decouple.model.grammar import MOVING
from ssm_decouple.model.reading import UNLIMITED, JointReading, Placed, Reading

Floats = NDArray[np.float64]

_SAME = 1e-12  # relative
_ROUNDING = 1e-15  # what each fixed joint in a row may add


def refuse_other_numbers(model: pin.Model, reading: Reading) -> None:
    """Refuse a model that holds anything else than the URDF says, to 1e-12 of its size.

    Compared are every body's mass, centre of mass and inertia (links on fixed joints merged), every joint's parent,
    placement, type, axis, limits, damping and friction, and the frame of every link and fixed joint. The work is
    linear in the number of links.

    Raises:
        ModelError: naming the link or joint, what of it, and both values.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond all numbers is equal to nothing
        placed = reading.placed()
        ids = _joint_ids(model, reading)
        _compare_joints(model, reading, placed, ids)
        _compare_bodies(model, reading, placed, ids)
        _compare_frames(model, reading, placed, ids)


def _joint_ids(model: pin.Model, reading: Reading) -> dict[int, int]:
    """Return the Pinocchio joint that moves each link that a joint moves, and of the root that which floats."""
    moved = {joint.name: i + 1 for i, joint in enumerate(reading.joints) if joint.kind in MOVING}
    names = list(model.names)[2:]
    if sorted(names) != sorted(moved):
        odd = sorted({*names} ^ {*moved}) or names
        raise ModelError(f"joint {odd[0]}: Pinocchio reads other joints than the file has: {', '.join(names)}")
    return {0: 1} | {moved[name]: j + 2 for j, name in enumerate(names)}


def _differs(where: str, what: str, written: ArrayLike, held: ArrayLike) -> ModelError:
    """Return the error that says so."""
    shown = [" ".join(repr(np.asarray(value, dtype=float).tolist()).split()) for value in (written, held)]
    return ModelError(
        f"{where}: its {what} is {shown[0]} in the file but {shown[1]} as Pinocchio reads it, so that nothing computed "
        "from it would be right"
    )


def _compare_joints(model: pin.Model, reading: Reading, placed: Placed, ids: dict[int, int]) -> None:
    poses: list[tuple[str, pin.SE3]] = []
    moved = np.array([link - 1 for link in ids if link], dtype=int)
    for i in moved:
        joint, index, holder = reading.joints[i], ids[i + 1], placed.held_by[i]
        if int(model.parents[index]) != ids[int(placed.carrier[holder])]:
            hung = model.names[model.parents[index]]
            raise ModelError(f"joint {joint.name}: Pinocchio hangs it on '{hung}', the file on '{joint.parent}'")
        _compare_motion(model, index, joint)
        poses.append((f"joint {joint.name}", model.jointPlacements[index]))
    holders, lengths = placed.held_by[moved], np.linalg.norm(reading.offsets[moved], axis=1)
    lengths += placed.reach[holders]
    _compare_poses(poses, placed.turned[moved], placed.offset[moved], lengths, placed.row[holders])


def _compare_poses(
    poses: list[tuple[str, pin.SE3]], R: Floats, p: Floats, lengths: Floats, rows: NDArray[np.int_]
) -> None:
    """Compare placements (k) that come after rows of fixed joints of these lengths, m, in all."""
    same = _SAME + _ROUNDING * rows
    for what, written, size in (("translation", p, lengths), ("rotation", R, np.ones(len(poses)))):
        held = np.array([getattr(pose, what) for _, pose in poses]).reshape(written.shape)
        off = np.abs(held - written).max(axis=tuple(range(1, written.ndim)))
        wrong = np.flatnonzero(~(off <= same * size))
        if wrong.size:
            first = int(wrong[0])
            raise _differs(poses[first][0], what, written[first], held[first])


def _compare_motion(model: pin.Model, index: int, joint: JointReading) -> None:
    moving, where = model.joints[index], f"joint {joint.name}"
    wanted = np.zeros(6)
    wanted[slice(0, 3) if joint.kind == "prismatic" else slice(3, 6)] = joint.axis
    motion = np.ravel(moving.createData().S)
    if motion.shape != (6,) or (moving.nq == 2) != (joint.kind == "continuous"):
        raise ModelError(f"{where}: it is {joint.kind} in the file but {moving.shortname()} as Pinocchio reads it")
    if not np.abs(motion - wanted).max() <= _SAME:
        raise _differs(where, "axis (linear; angular)", wanted, motion)
    limits, v, q = joint.limits, moving.idx_v, moving.idx_q
    numbers = [
        ("effort limit", limits.effort, model.effortLimit[v]),
        ("velocity limit", limits.velocity, model.velocityLimit[v]),
        ("damping", joint.damping, model.damping[v]),
        ("friction", joint.friction, model.friction[v]),
    ]
    if joint.kind != "continuous":
        numbers += [
            ("lower limit", limits.lower, model.lowerPositionLimit[q]),
            ("upper limit", limits.upper, model.upperPositionLimit[q]),
        ]
    for what, written, held in numbers:
        endless = np.isinf(written) and abs(held) >= UNLIMITED and (held > 0) == (written > 0)
        if not endless and not abs(held - written) <= _SAME * abs(written):
            raise _differs(where, what, written, held)


def _compare_bodies(model: pin.Model, reading: Reading, placed: Placed, ids: dict[int, int]) -> None:
    count, carrier, R = len(reading.links), placed.carrier, placed.R
    turned = (R @ reading.centres[:, :, None])[:, :, 0]
    centres = placed.p + turned
    masses = _summed(carrier, reading.masses)
    sums = _summed(carrier, reading.masses[:, None] * centres)
    weighs = masses > 0
    means = np.where(weighs[:, None], sums / np.where(weighs, masses, 1.0)[:, None], centres)
    arms = centres - means[carrier]
    squares = np.einsum("ij,ij->i", arms, arms)
    steiner = squares[:, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None, :]
    tensors = R @ reading.inertias @ R.transpose(0, 2, 1)
    inertias = _summed(carrier, tensors + reading.masses[:, None, None] * steiner)
    # What rounding may change in each: arms are differences of positions that reach far longer.
    lengths = placed.reach + np.linalg.norm(reading.centres, axis=1)
    longest, rows = np.zeros(count), np.zeros(count)
    heavy = reading.masses > 0
    np.maximum.at(longest, carrier[heavy], lengths[heavy])
    np.maximum.at(rows, carrier, placed.row)
    size = np.abs(tensors).sum(axis=(1, 2)) + reading.masses * (squares + 1e-2 * np.sqrt(squares) * longest[carrier])
    sizes = _summed(carrier, size)
    for link, index in ids.items():
        body, same = model.inertias[index], _SAME + _ROUNDING * rows[link]
        where = _body_name(reading, carrier, link)
        if not abs(body.mass - masses[link]) <= same * masses[link]:
            raise _differs(where, "mass", masses[link], body.mass)
        if weighs[link] and not np.abs(body.lever - means[link]).max() <= same * longest[link]:
            raise _differs(where, "centre of mass", means[link], body.lever)
        if not np.abs(body.inertia - inertias[link]).max() <= same * sizes[link]:
            raise _differs(where, "inertia", inertias[link], body.inertia)


def _summed(carrier: NDArray[np.int_], values: Floats) -> Floats:
    """Add up values by link (l, ...) over the links that move together, at the place of their carrier."""
    sums = np.zeros_like(values)
    np.add.at(sums, carrier, values)
    return sums


def _body_name(reading: Reading, carrier: NDArray[np.int_], link: int) -> str:
    together = [reading.links[i] for i in np.flatnonzero(carrier == link)[:4]]
    if len(together) == 1:
        return f"link {together[0]}"
    return f"links {', '.join(together[:3])}{', ..' if together[3:] else ''} (fixed to each other)"


def _compare_frames(model: pin.Model, reading: Reading, placed: Placed, ids: dict[int, int]) -> None:
    bodies, fixed = {}, {}
    for frame in model.frames:
        if frame.type == pin.FrameType.BODY:
            bodies[frame.name] = frame
        elif frame.type == pin.FrameType.FIXED_JOINT:
            fixed[frame.name] = frame
    links, poses = [], []
    for link, name in enumerate(reading.links):
        index = ids[int(placed.carrier[link])]
        named = [(f"link {name}", bodies.get(name))]
        if link and reading.joints[link - 1].kind not in MOVING:
            joint = reading.joints[link - 1].name
            named.append((f"joint {joint}", fixed.get(joint)))
        for where, frame in named:
            if frame is None or frame.parentJoint != index:
                on = "leaves it out" if frame is None else f"has it on '{model.names[frame.parentJoint]}'"
                raise ModelError(f"{where}: Pinocchio {on}, unlike the file")
            links.append(link)
            poses.append((where, frame.placement))
    _compare_poses(poses, placed.R[links], placed.p[links], placed.reach[links], placed.row[links])
