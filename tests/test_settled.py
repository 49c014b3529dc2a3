"""What is read-only stays so in copies and in other processes."""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.settled import fixed

COPIES = {"copy": copy.copy, "deepcopy": copy.deepcopy, "pickle": lambda made: pickle.loads(pickle.dumps(made))}


def made() -> dict[str, object]:
    robot = ssm.load_robot("ets_vii_flexible")
    return {
        "robot": robot,
        "law": ssm.SelectiveLaw(robot, ssm.Protection("yaw")),
        "protection": ssm.Protection("yaw"),
        "appendage": robot.appendages[0],
        "modes": robot.modes(),
        "plant": ssm.Plant.of(robot),
        "coupling": robot.coupling(robot.configuration()),
        "waypoints": ssm.Waypoints([0.0, 1.0], [[0.0, 0, 0], [1, 0, 0]]),
        "case": ssm.load_case("case1"),
    }


@pytest.mark.parametrize("how", COPIES)
def test_no_public_array_of_a_copy_can_be_changed(how):
    for name, original in made().items():
        found = COPIES[how](original)
        arrays = {key: value for key, value in vars(found).items() if key[0] != "_" and isinstance(value, np.ndarray)}
        assert arrays, name
        for key, array in arrays.items():
            assert not array.flags.writeable, f"{name}.{key}"
            np.testing.assert_array_equal(array, getattr(original, key))


@pytest.mark.parametrize("how", COPIES)
def test_nor_can_the_arrays_in_read_only_tables_and_lists(how):
    table = COPIES[how](fixed({"a": np.arange(3.0), "b": [np.arange(2.0)]}))
    assert not table["a"].flags.writeable
    assert not table["b"][0].flags.writeable
    with pytest.raises(TypeError, match="read-only"):
        table["b"].append(1)


@pytest.mark.parametrize("task", [ssm.PositionTask(), ssm.OrientationTask(), ssm.PoseTask()])
def test_a_task_takes_no_attribute_that_it_has_not(task):
    for name in ("gian", "takes_target", "gain"):
        with pytest.raises(FrozenInstanceError):
            setattr(task, name, 1.0)


def test_the_text_of_a_urdf_is_no_path():
    robot = ssm.load_robot("ets_vii")
    with pytest.raises(ssm.InputError, match=r"Robot\(text") as refusal:
        ssm.load_robot(robot.urdf)
    assert len(str(refusal.value)) < 400
