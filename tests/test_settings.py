"""Settings end in records: they act, or they cannot be assigned. And errors of others come through, with the motion."""

from __future__ import annotations

import copy
import inspect
import pickle
import warnings
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.campaign import Campaign
from ssm_decouple.studies.robustness import Robustness
from ssm_decouple.studies.targets import Trials, random_targets
from ssm_decouple.studies.workspace import Workspace

A = np.deg2rad([150.0, -20, -10, 0, 0, 0])
X = np.array([-1.8, -0.3, 1.2])
# What may be assigned, because it acts: the momentum of a law, and results of studies.
ACTS = {"momentum", "found", "drawn", "elites", "unprotected"}


def made(robot: ssm.Robot, tmp_path: Path) -> dict[str, object]:
    case, yaw = ssm.load_case("case1"), ssm.Protection("yaw")
    law = ssm.SelectiveLaw(
        robot, yaw, sample_time=0.1, acceleration_limit=np.ones(6), limits=ssm.Limits(position=[[-3.0, 3.0]] * 6)
    )
    schedule, path = ssm.Schedule([(0, "none"), (1, "yaw")], hand_over=0.5), tmp_path / "a.toml"
    path.write_text('seed = 1\nsamples = 2\ncases = ["case1"]\nprotections = ["none"]\n')
    flexible, task = ssm.load_robot("ets_vii_flexible"), ssm.PostureTask(["joint_1"])
    objects = [
        robot, yaw, law, schedule, ssm.ScheduledLaw(robot, schedule), law.layout, law.limits, task, ssm.PositionTask(),
        ssm.BoresightTask(X), ssm.Clearance(pairs=[["bus", "link_3"]]), ssm.Wheel("w", X, 0.1, 600.0, 0.2),
        flexible, flexible.appendages[0], flexible.modes(), ssm.Plant.of(flexible), ssm.Tolerances(0.1),
        ssm.Servo(torque_limits=np.ones(6)), ssm.Sensors(), ssm.Load(torque=X), ssm.Dynamic(), case,
        ssm.Waypoints([0, 1], [[0, 0, 0], [1, 1, 1]]), ssm.TumblingTarget(np.eye(3), np.eye(3), X, X),
        ssm.batch.Batch(robot), Campaign.load(path), Robustness(case), Workspace(robot, voxel=0.5),
        Trials(random_targets(robot, robot.configuration(A), 2), {"none": ssm.SelectiveLaw(robot, yaw)}),
    ]  # fmt: skip
    return {f"{type(one).__name__} {i}": one for i, one in enumerate(objects)}


def settings_of(one: object) -> list[str]:
    named = [field.name for field in fields(one)] if is_dataclass(one) else list(vars(one))
    return [name for name in named if not name.startswith("_") and name not in ACTS]


def test_no_setting_can_be_assigned_and_no_typing_error_becomes_one(ets_vii, tmp_path):
    for name, one in made(ets_vii, tmp_path).items():
        for setting in [*settings_of(one), "gian"]:
            try:
                setattr(one, setting, 1.0)
            except AttributeError:
                continue
            pytest.fail(f"{setting} of {name} can be assigned")
        assert settings_of(one), name


def mutable(value: object, place: str) -> list[str]:
    """Return where in a setting something could be changed."""
    if isinstance(value, np.ndarray):
        return [place] if value.flags.writeable or (value.base is not None and value.base.flags.writeable) else []
    if isinstance(value, dict | list):
        found = []
        for change in (lambda: value.__setitem__(0, 1), lambda: value.clear(), lambda: value.pop()):
            with pytest.raises(TypeError, match="read-only"):
                change()
        items = value.items() if isinstance(value, dict) else enumerate(value)
        for key, item in items:
            found += mutable(item, f"{place}[{key}]")
        return found
    if isinstance(value, tuple):
        return [where for i, item in enumerate(value) for where in mutable(item, f"{place}[{i}]")]
    return []


def test_what_settings_hold_cannot_be_changed_either(ets_vii, tmp_path):
    for name, one in made(ets_vii, tmp_path).items():
        for setting in settings_of(one):
            if setting not in ("shares", "growth"):  # results of a study
                assert mutable(getattr(one, setting), f"{name}.{setting}") == []


def test_the_users_own_array_stays_his(ets_vii):
    limits, weights, times = np.full(6, 0.1), np.ones(6), np.array([0.0, 1.0])
    law = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), rate_limit=limits, joint_weights=weights)
    path, servo = ssm.Waypoints(times, [[0, 0, 0], [1, 1, 1]]), ssm.Servo(torque_limits=limits)
    case = replace(ssm.load_case("case1"), joints=weights, law={"rate_limit": limits})
    limits[:], weights[:], times[:] = 7.0, 7.0, 7.0
    assert law.rate_limits.max() == 0.1
    assert law.joint_weights.max() == 1.0
    assert path.times.tolist() == [0.0, 1.0]
    assert max(servo.torque_limits) == 0.1
    assert max(case.joints) == 1.0
    assert max(case.law["rate_limit"]) == 0.1


def test_settled_things_are_copied_pickled_and_described_as_before(ets_vii, tmp_path):
    case = ssm.load_case("case1")
    again = pickle.loads(pickle.dumps(replace(case)))
    assert again.law == case.law
    assert copy.deepcopy(case.law) == case.law
    assert "damping_threshold" in inspect.signature(ssm.SelectiveLaw).parameters
    assert list(inspect.signature(ssm.Robot).parameters)[:2] == ["urdf", "name"]
    yaw = pickle.loads(pickle.dumps(ssm.Protection("yaw")))
    with pytest.raises(AttributeError, match="'U_c' of a Protection cannot be assigned"):
        yaw.U_c = np.eye(3)


def test_momentum_is_the_exception_and_acts(ets_vii):
    law, q = ssm.SelectiveLaw(ets_vii, ssm.Protection("none")), ets_vii.configuration(A)
    before = law(q, X).joint_rates.copy()
    law.momentum = [0, 0, 0, 0, 0, 1.0]
    assert not np.array_equal(law(q, X).joint_rates, before)
    assert law.describe()["momentum"][5] == 1.0


def test_a_model_that_was_changed_is_refused_by_law_engine_and_simulation():
    robot = ssm.load_robot("ets_vii")
    law, q = ssm.SelectiveLaw(robot, ssm.Protection("yaw")), robot.configuration(A)
    lever = robot.model.inertias[3].lever.copy()
    robot.model.inertias[3].lever = lever + 0.01  # the mass stays: only the numbers would tell
    for call in (
        lambda: ssm.SelectiveLaw(robot, ssm.Protection("yaw")),
        lambda: ssm.batch.Batch(robot),
        lambda: ssm.simulate(law, q, X, 1.0, 0.5),
    ):
        with pytest.raises(ssm.ModelError, match=r"joint 'joint_2' in robot\.model was changed"):
            call()


@pytest.mark.parametrize("attitude", [(0, 0, 0), (1.0, 0, 0), (0, 3.1, 0), (0.3, -0.7, 2.0)])
@pytest.mark.parametrize("factor", [0.0, 1.2, 1.0 + 2e-6, 1.0 - 2e-6, -3.0])
def test_a_quaternion_off_unit_length_is_refused_everywhere_in_the_same_words(ets_vii, attitude, factor):
    q = ets_vii.configuration(A, pin.SE3(pin.rpy.rpyToMatrix(*map(float, attitude)), X))
    near = q.copy()
    near[3:7] *= 1.0 + 0.5e-6
    q[3:7] *= factor
    yaw = ssm.Protection("yaw", "inertial")
    laws = [
        ssm.SelectiveLaw(ets_vii, yaw),
        ssm.SelectiveLaw(ets_vii, yaw, sample_time=0.1, hold_nodes=2),
        ssm.SelectiveLaw(ets_vii, yaw, sample_time=0.1, limits=ssm.Limits()),
        ssm.SelectiveLaw(ets_vii, yaw, tasks=[ssm.PoseTask()]),
    ]
    target = [X, X, X, pin.SE3.Identity()]
    doors = [lambda q, law=law, x=x: law(q, x) for law, x in zip(laws, target, strict=True)]
    doors += [lambda q: laws[0].base_twist(q, np.ones(6)), ets_vii.coupling, ets_vii.frame_pose]
    doors += [lambda q: ssm.simulate(laws[0], q, X, 1.0, 0.5), lambda q: ets_vii.momentum(q, np.zeros(12))]
    for door in doors:
        with pytest.raises(ssm.InputError, match=r"quaternion q\[3:7\] has length"):
            door(q)
        if door is not doors[3]:  # the law of a rotation task bears less
            door(near)
    base = ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"))
    with pytest.raises(ssm.InputError, match="not of unit length"):
        ssm.batch.Batch(ets_vii).step(base, q, X)


class TheirsError(ValueError):
    """Of the user's own."""


def fails_at(time_of_failure, value, kind=TheirsError):
    def function(time, *_):
        if time > time_of_failure:
            raise kind("my table ends")
        return value

    return function


def run(robot, **changes):
    protection = changes.pop("schedule", None)
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw")) if protection is None else ssm.ScheduledLaw(robot, protection)
    arguments = {"target": X, "duration": 2.0, "dt": 0.1, **changes}
    return ssm.simulate(law, robot.configuration(A), **arguments)


@pytest.mark.parametrize("kind", [TheirsError, TypeError, FloatingPointError, ZeroDivisionError, ssm.InputError])
def test_an_error_of_the_users_functions_comes_through_with_the_motion_so_far(ets_vii, kind):
    for changes in (
        {"target": fails_at(1.05, (X, np.zeros(3)), kind)},
        {"protected_rate": fails_at(1.05, [0.0], kind)},
        {"schedule": ssm.Schedule(["none", "yaw"], progress=fails_at(1.05, 0.0, kind))},
        {"target": fails_at(1.05, (X, np.zeros(3)), kind), "method": ssm.Dynamic(step=0.01)},
    ):
        with pytest.raises(kind, match="my table ends") as caught:
            run(ets_vii, **changes)
        motion = caught.value.motion
        assert 0.9 < float(motion.time[-1]) < 1.15
        assert "the attribute" not in str(caught.value)
        assert any("'motion'" in note for note in caught.value.__notes__)


def test_a_motion_is_not_lost_to_its_last_call_of_progress(ets_vii):
    def progress(share):
        if share == 1.0:
            raise TheirsError("no window")

    with pytest.raises(TheirsError, match="no window") as caught:
        run(ets_vii, progress=progress)
    assert float(caught.value.motion.time[-1]) == 2.0


def test_an_error_that_takes_no_attribute_comes_through_as_well(ets_vii):
    class ClosedError(Exception):
        def __setattr__(self, name, value):
            raise AttributeError(name)

    with pytest.raises(ClosedError):
        run(ets_vii, target=fails_at(1.0, (X, np.zeros(3)), ClosedError))


@pytest.mark.parametrize("told", [None, X, (X,), "ab", (X, X, X), {1: X, 2: X}])
def test_what_is_no_target_and_velocity_is_said_to_be_so(ets_vii, told):
    with pytest.raises(ssm.InputError, match="a target function returns two things"):
        run(ets_vii, target=lambda time: told)


def test_an_error_of_a_case_keeps_its_motion():
    case = replace(ssm.load_case("case1"), target=fails_at(3.0, (X, np.zeros(3)), ssm.InputError), duration=5.0)
    with pytest.raises(ssm.InputError, match="case 'case1': my table ends") as caught:
        case.run()
    assert float(caught.value.motion.time[-1]) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("call", "mend"),
    [
        (lambda r: ssm.SelectiveLaw("ets_vii", ssm.Protection("yaw")), r"load_robot\('ets_vii'\)"),
        (lambda r: ssm.SelectiveLaw(r, "yaw"), r"Protection\('yaw'\)"),
        (lambda r: ssm.SelectiveLaw(ssm.Protection("yaw"), r), "load_robot"),
        (lambda r: ssm.SelectiveLaw(r, ssm.Protection("yaw"), sample_time=0.1, limits={}), r"Limits\(braking"),
        (lambda r: ssm.SelectiveLaw(r, ssm.Protection("yaw"), tasks=ssm.PoseTask), r"PositionTask\(\)"),
        (lambda r: ssm.SelectiveLaw(r, ssm.Protection("yaw"), tasks=[ssm.PoseTask]), r"make one: PoseTask\(..\)"),
        (lambda r: ssm.SelectiveLaw(r, ssm.Protection), r"Protection\('yaw'\)"),
        (lambda r: ssm.batch.Batch("ets_vii"), r"load_robot\('ets_vii'\)"),
        (lambda r: ssm.compare("case1"), r"load_case\('case1'\)"),
        (lambda r: ssm.load_robot(None), "name of the catalogue"),
        (lambda r: ssm.load_robot("/"), "is a folder"),
        (lambda r: ssm.save_motion(None, "x.nc"), "simulate"),
        (lambda r: ssm.simulate("law", r.configuration(), X, 1, 0.1), "SelectiveLaw"),
        (lambda r: run(r, target="there"), "real numbers"),
        (lambda r: run(r, dt="0.1"), "real numbers"),
        (lambda r: run(r, dt=3.0), "longer than the duration"),
        (lambda r: run(r, progress=5), "must be a function"),
        (lambda r: run(r, stop_early="no"), "True or False"),
        (lambda r: ssm.Servo(protects="no"), "True or False"),
        (lambda r: r.coupling(r.configuration()).manipulability("yaw"), r"Protection\('yaw'\)"),
        (lambda r: ssm.Protection.parse(None), "give a name"),
        (lambda r: ssm.Protection.parse("1,0,0@@base"), "behind one '@'"),
    ],
)  # fmt: skip
def test_first_mistakes_get_a_message_with_the_mend(ets_vii, call, mend):
    with pytest.raises(ssm.InputError if "folder" not in mend else ssm.ModelError, match=mend):
        call(ets_vii)


def test_degrees_for_radians_are_told(ets_vii):
    degrees = np.rad2deg(A)
    for call in (
        lambda: ets_vii.configuration(degrees),
        lambda: ets_vii.configuration({"joint_1": 150.0}),
        lambda: ets_vii.with_locked({"joint_1": 150.0}),
    ):
        with pytest.warns(ssm.DecoupleWarning, match="150 rad at 'joint_1' looks like degrees"):
            call()
    with pytest.warns(ssm.DecoupleWarning, match=r"rate_limit of 'ets_vii': 5 rad/s at 'joint_1' looks like degrees"):
        ssm.SelectiveLaw(ets_vii, ssm.Protection("yaw"), rate_limit=5.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ets_vii.configuration(np.full(6, 12.0))
        wheels = ets_vii.with_wheels([ssm.Wheel("w", [0, 0, 1], 0.1, 600.0, 0.2)])
        wheels.configuration({"w": 500.0})
        ssm.SelectiveLaw(wheels, ssm.Protection("yaw"))
