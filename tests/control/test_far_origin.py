"""Far from the inertial origin, as in an orbit: the numbers are those near it, and the protection is kept."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import random_robot, random_state

import ssm_decouple as ssm
from ssm_decouple.control import kernel
from ssm_decouple.control.collision import Distances
from ssm_decouple.model import origin

START = np.deg2rad([150.0, -20, -10, 0, 0, 0])
TARGET = np.array([-1.75, -0.25, 1.25])  # with no digits that are lost far away
FAR = [np.array([7e6, 0, 0]), np.array([-2.4e7, 3.1e7, 1.5e7]), np.array([0, 0, 11.0])]


def whole(rng: np.random.Generator, distance: float) -> np.ndarray:
    """A place that far away, in whole metres: positions near it are those near the origin, rounded to its digits."""
    way = rng.normal(size=3)
    return np.round(distance * way / np.linalg.norm(way))


def snapped(values: np.ndarray) -> np.ndarray:
    """Multiples of 2^-20 m: they have no digits that are lost 4e7 m away."""
    return np.round(np.asarray(values) * 2.0**20) / 2.0**20


def at(q: np.ndarray, place: np.ndarray) -> np.ndarray:
    moved = q.copy()
    moved[:3] += place
    return moved


def some_state(robot: ssm.Robot, rng: np.random.Generator) -> np.ndarray:
    q = random_state(robot, rng)
    q[:3] = snapped(q[:3])
    return q


def test_both_know_what_is_far():
    assert kernel.FAR == origin.FAR


def tasks_of(kind: int, rng: np.random.Generator, place: np.ndarray):
    """Return tasks, and their targets near the origin and far from it."""
    point, pose = snapped(rng.uniform(-2, 2, 3)), pin.SE3(pin.exp3(rng.normal(size=3)), snapped(rng.uniform(-2, 2, 3)))
    far = pin.SE3(pose.rotation, pose.translation + place)
    return [
        (None, point, point + place),
        (ssm.PoseTask(), pose, far),
        ([ssm.PositionTask(), ssm.PostureTask(level=2)], [point, np.zeros(7)], [point + place, np.zeros(7)]),
        (ssm.BoresightTask([0.3, -0.5, 0.8]), point, point),
        ([ssm.PositionTask(), ssm.ManipulabilityTask()], point, point + place),
        (ssm.RelativePoseTask("end_effector", "bus"), pose, pose),
    ][kind]


@given(
    seed=st.integers(0, 60),
    distance=st.sampled_from([11.0, 300.0, 1e5, 7e6, 4.2e7]),
    words=st.sampled_from(["none", "yaw", "roll+yaw", "all"]),
    frame=st.sampled_from(["base", "inertial", "end_effector"]),
    kind=st.integers(0, 5),
    extra=st.sampled_from(["", "hold", "limits", "momentum", "hold momentum", "asked"]),
)
@settings(max_examples=60)
def test_the_command_is_the_one_near_the_origin(seed, distance, words, frame, kind, extra):
    rng, robot = np.random.default_rng(seed), random_robot(300 + seed, joints=7, branching=0.1 * (kind != 5))
    place = whole(rng, distance)
    tasks, near_target, far_target = tasks_of(kind, rng, place)
    protection = ssm.Protection(words) if words == "none" else ssm.Protection(words, frame=frame)
    options = {"rate_limit": 0.3, "damping": 1e-3}
    if "hold" in extra:
        options |= {"sample_time": 0.1, "hold_nodes": 2}
    if "limits" in extra:
        options |= {"sample_time": 0.1, "limits": ssm.Limits(np.tile([-4.0, 4.0], (7, 1)))}
    if "momentum" in extra:
        options["momentum"] = np.r_[0.0, 0, 0, rng.normal(size=3)]
    try:
        law = ssm.SelectiveLaw(robot, protection, tasks=tasks, **options)
    except ssm.InputError:
        return  # such a task the tree cannot do
    q = some_state(robot, rng)
    asked = {"protected_rate": 1e-3 * rng.normal(size=protection.k)} if extra == "asked" else {}
    near, far = law(q, near_target, **asked), law(at(q, place), far_target, **asked)
    values = far.values.copy()
    values[6 + 7 + kernel.POSITION :][:3] -= place
    # What the two round differently: the position that comes back.
    np.testing.assert_allclose(values[6 + 7 + kernel.POSITION :][:3], near.end_effector_position, atol=1e-8)
    values[6 + 7 + kernel.POSITION :][:3] = near.end_effector_position
    if kind == 4:  # finite differences of the manipulability
        np.testing.assert_allclose(far.joint_rates, near.joint_rates, atol=1e-7)
        values = near.values
    np.testing.assert_allclose(values, near.values, rtol=1e-9, atol=1e-11)
    if extra in ("", "limits"):  # by matrices that another code computes
        coupling = robot.coupling(q)
        R = coupling.rotation_of("base" if protection.k == 0 else protection.frame).T
        w_sub = protection.U_c.T @ (R @ (coupling.J_rc @ far.joint_rates)) if protection.k else np.zeros(1)
        assert np.abs(w_sub).max() <= 1e-17 + 64 * kernel.EPS * np.linalg.norm(coupling.J_rc) * np.linalg.norm(
            far.joint_rates
        )


@pytest.mark.parametrize("place", FAR)
@pytest.mark.parametrize("words", ["yaw", "all"])
def test_the_protected_rate_is_rounding(ets_vii, place, words):
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection(words), gain=0.05, rate_limit=np.deg2rad(5))
    q = at(ets_vii.configuration(START), place)
    rates = law(q, TARGET + place).joint_rates
    assert np.abs(ssm.Protection(words).J_sub(ets_vii.coupling(q)) @ rates).max() < 1e-17


def motions(ets_vii, place, method, **options):
    duration = options.pop("duration", 20.0)
    for there in (np.zeros(3), place):
        law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw", frame="inertial"), gain=0.05, sample_time=0.1, **options)
        yield ssm.simulate(law, at(ets_vii.configuration(START), there), TARGET + there, duration, 0.1, method)


@pytest.mark.parametrize("place", FAR[:2])
@pytest.mark.parametrize(
    ("method", "options"),
    [
        ("explicit", {}),
        ("held", {"hold_nodes": 2}),
        ("held", {"momentum": [0.0, 0, 0, 0.02, 0, 0.05]}),
        ("rk4", {}),
        (ssm.Dynamic(step=0.02), {"duration": 5.0}),
    ],
)
def test_motions_are_those_near_the_origin(ets_vii, place, method, options):
    near, far = motions(ets_vii, place, method, **options)
    for name in near.data_vars:
        if name == "robot_urdf" or near[name].dtype == object:
            continue
        moved = far[name].values
        if name in ("base_position", "end_effector_position", "target_position", "centre_of_mass"):
            moved = moved - place
        if name == "configuration":
            moved = np.c_[moved[:, :3] - place, moved[:, 3:]]
        rounding = 1e-8 if name.endswith("position") or name in ("configuration", "centre_of_mass") else 1e-12
        np.testing.assert_allclose(moved, near[name].values, atol=rounding, rtol=1e-8, err_msg=name)
    assert far.attrs["outcome"] == near.attrs["outcome"]
    assert far.attrs["final_error"] == pytest.approx(near.attrs["final_error"], abs=1e-9)


def test_a_schedule_by_state_sees_true_positions(ets_vii):
    place, seen = FAR[0], []

    def progress(time, q):
        seen.append(q[:3].copy())
        return np.clip(time / 4.0, 0.0, 1.0)

    law = ssm.ScheduledLaw(ets_vii, ssm.Schedule(["none", "yaw"], progress=progress), gain=0.05)
    motion = ssm.simulate(law, at(ets_vii.configuration(START), place), TARGET + place, 6.0, 0.1)
    assert np.abs(np.array(seen) - place).max() < 1.0
    assert np.abs(motion.protected_rate.values[motion.protection_share.values[:, 0] == 1.0]).max() < 1e-17


def test_a_schedule_by_time_far_away_is_the_one_near_the_origin(ets_vii):
    law = ssm.ScheduledLaw(ets_vii, ssm.Schedule([(0.0, "none"), (2.0, "yaw")], hand_over=1.0), gain=0.05)
    q, place = ets_vii.configuration(START), FAR[1]
    near, far = (ssm.simulate(law, at(q, there), TARGET + there, 5.0, 0.1) for there in (np.zeros(3), place))
    np.testing.assert_allclose(far.joint_rates.values, near.joint_rates.values, atol=1e-12)
    np.testing.assert_array_equal(far.protection_share.values, near.protection_share.values)


def test_momentum_and_distances_do_not_depend_on_the_place(ets_vii, rng):
    for place in FAR:
        q, v = some_state(ets_vii, rng), rng.normal(size=12)
        size = np.abs(ets_vii.momentum(q, v)).max()
        np.testing.assert_allclose(ets_vii.momentum(at(q, place), v), ets_vii.momentum(q, v), atol=1e-12 * size)
        here = ets_vii.configuration(START)  # nearest points are found by iteration: to the bit from the same place
        for one, other in zip(
            *(Distances(ets_vii, ssm.Clearance(0.05))(x) for x in (here, at(here, place))), strict=True
        ):
            np.testing.assert_array_equal(one, other)
        law = ssm.SelectiveLaw(ets_vii, ssm.Protection("all"))
        near, far = law.lost_direction(q), law.lost_direction(at(q, place))
        assert near.singular_value == pytest.approx(far.singular_value, rel=1e-9)
        np.testing.assert_allclose(law.base_twist(at(q, place), v[6:]), law.base_twist(q, v[6:]), atol=1e-12)


def test_batches_are_those_near_the_origin(ets_vii, rng):
    law, engine = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw")), ssm.batch.Batch(ets_vii, threads=1)
    starts = np.array([ets_vii.configuration(START + rng.uniform(-0.1, 0.1, 6)) for _ in range(5)])
    for place in FAR[:2]:
        away = starts.copy()
        away[:, :3] += place
        near, far = engine.step(law, starts, TARGET), engine.step(law, away, TARGET + place)
        np.testing.assert_allclose(far.joint_rates, near.joint_rates, atol=1e-9)
        np.testing.assert_allclose(far.end_effector_error, near.end_effector_error, atol=1e-8)
        one, other = (engine.motions(law, q, x, 30.0, 0.1) for q, x in ((starts, TARGET), (away, TARGET + place)))
        np.testing.assert_allclose(other.final_error, one.final_error, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(other.base_rotation, one.base_rotation, atol=1e-9)
        np.testing.assert_allclose(other.configuration[:, :3] - place, one.configuration[:, :3], atol=1e-8)
        assert other.protected_rate.max() < 1e-17


def test_a_traced_motion_is_the_one_near_the_origin(ets_vii):
    jax = pytest.importorskip("jax")
    from ssm_decouple.batch import JaxBatch

    traced, place = JaxBatch(ets_vii).traced(ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))), FAR[0]
    with jax.enable_x64(True):
        near = traced.motion(jax.numpy.array(START), jax.numpy.array(TARGET), 5.0, 0.5)
        pose = jax.numpy.array(np.r_[place, 0.0, 0.0, 0.0, 1.0])
        far = traced.motion(jax.numpy.array(START), jax.numpy.array(TARGET + place), 5.0, 0.5, pose)
        np.testing.assert_allclose(far.joints, near.joints, atol=1e-12)
        np.testing.assert_allclose(np.asarray(far.poses)[:, :3] - place, np.asarray(near.poses)[:, :3], atol=1e-8)
        assert np.abs(np.asarray(far.command.protected_rate)).max() < 1e-17
