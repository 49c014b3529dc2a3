"""Selective decoupling for free-floating space manipulators, on Pinocchio.

Protect the directions of the base that matter, leave the rest of the arm's freedom to the task:

    import numpy as np
    import ssm_decouple as ssm

    robot = ssm.load_robot("ets_vii")
    q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), gain=0.05)
    motion = ssm.simulate(law, q, target=[-1.8, -0.3, 1.2], duration=150.0, dt=0.1)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ssm_decouple import batch as batch
    from ssm_decouple.control.arrays import base_twist_map as base_twist_map
    from ssm_decouple.control.arrays import selective_rates as selective_rates
    from ssm_decouple.control.collision import Clearance as Clearance
    from ssm_decouple.control.law import Command as Command
    from ssm_decouple.control.law import SelectiveLaw as SelectiveLaw
    from ssm_decouple.control.limits import Limits as Limits
    from ssm_decouple.control.schedule import Schedule as Schedule
    from ssm_decouple.control.schedule import ScheduledLaw as ScheduledLaw
    from ssm_decouple.control.task import BoresightTask as BoresightTask
    from ssm_decouple.control.task import ManipulabilityTask as ManipulabilityTask
    from ssm_decouple.control.task import OrientationTask as OrientationTask
    from ssm_decouple.control.task import PoseTask as PoseTask
    from ssm_decouple.control.task import PositionTask as PositionTask
    from ssm_decouple.control.task import PostureTask as PostureTask
    from ssm_decouple.control.task import RelativePoseTask as RelativePoseTask
    from ssm_decouple.errors import DecoupleError as DecoupleError
    from ssm_decouple.errors import DecoupleWarning as DecoupleWarning
    from ssm_decouple.errors import FileError as FileError
    from ssm_decouple.errors import InputError as InputError
    from ssm_decouple.errors import ModelError as ModelError
    from ssm_decouple.model.appendage import Appendage as Appendage
    from ssm_decouple.model.appendage import Modes as Modes
    from ssm_decouple.model.catalogue import example_robot as example_robot
    from ssm_decouple.model.catalogue import load_robot as load_robot
    from ssm_decouple.model.catalogue import models as models
    from ssm_decouple.model.compose import compose as compose
    from ssm_decouple.model.perturb import Tolerances as Tolerances
    from ssm_decouple.model.perturb import perturbed as perturbed
    from ssm_decouple.model.plant import Plant as Plant
    from ssm_decouple.model.report import Report as Report
    from ssm_decouple.model.robot import Robot as Robot
    from ssm_decouple.model.wheels import Wheel as Wheel
    from ssm_decouple.momentum.coupling import Coupling as Coupling
    from ssm_decouple.momentum.metrics import Ellipsoid as Ellipsoid
    from ssm_decouple.momentum.protection import Protection as Protection
    from ssm_decouple.simulation.dynamic import Dynamic as Dynamic
    from ssm_decouple.simulation.dynamic import Load as Load
    from ssm_decouple.simulation.dynamic import Sensors as Sensors
    from ssm_decouple.simulation.dynamic import Servo as Servo
    from ssm_decouple.simulation.motion import load_motion as load_motion
    from ssm_decouple.simulation.motion import save_motion as save_motion
    from ssm_decouple.simulation.reference import TumblingTarget as TumblingTarget
    from ssm_decouple.simulation.reference import Waypoints as Waypoints
    from ssm_decouple.simulation.simulate import DivergenceError as DivergenceError
    from ssm_decouple.simulation.simulate import SimulationInterrupted as SimulationInterrupted
    from ssm_decouple.simulation.simulate import simulate as simulate
    from ssm_decouple.studies.case import Case as Case
    from ssm_decouple.studies.case import cases as cases
    from ssm_decouple.studies.case import load_case as load_case
    from ssm_decouple.studies.comparison import Comparison as Comparison
    from ssm_decouple.studies.comparison import compare as compare
    from ssm_decouple.viewing.viewer import view as view

__version__ = "0.1.0"

# Each public name and the module that it comes from: imported when first used, so that `import ssm_decouple` is quick.
_HOME = {
    "Appendage": "model.appendage",
    "BoresightTask": "control.task",
    "Case": "studies.case",
    "Clearance": "control.collision",
    "Command": "control.law",
    "Comparison": "studies.comparison",
    "Coupling": "momentum.coupling",
    "DecoupleError": "errors",
    "DecoupleWarning": "errors",
    "DivergenceError": "simulation.simulate",
    "Dynamic": "simulation.dynamic",
    "Ellipsoid": "momentum.metrics",
    "FileError": "errors",
    "InputError": "errors",
    "Limits": "control.limits",
    "Load": "simulation.dynamic",
    "ManipulabilityTask": "control.task",
    "ModelError": "errors",
    "Modes": "model.appendage",
    "OrientationTask": "control.task",
    "Plant": "model.plant",
    "PoseTask": "control.task",
    "PositionTask": "control.task",
    "PostureTask": "control.task",
    "Protection": "momentum.protection",
    "RelativePoseTask": "control.task",
    "Report": "model.report",
    "Robot": "model.robot",
    "Schedule": "control.schedule",
    "ScheduledLaw": "control.schedule",
    "SelectiveLaw": "control.law",
    "Sensors": "simulation.dynamic",
    "Servo": "simulation.dynamic",
    "SimulationInterrupted": "simulation.simulate",
    "Tolerances": "model.perturb",
    "TumblingTarget": "simulation.reference",
    "Waypoints": "simulation.reference",
    "Wheel": "model.wheels",
    "base_twist_map": "control.arrays",
    "cases": "studies.case",
    "compare": "studies.comparison",
    "compose": "model.compose",
    "example_robot": "model.catalogue",
    "load_case": "studies.case",
    "load_motion": "simulation.motion",
    "load_robot": "model.catalogue",
    "models": "model.catalogue",
    "perturbed": "model.perturb",
    "save_motion": "simulation.motion",
    "selective_rates": "control.arrays",
    "simulate": "simulation.simulate",
    "view": "viewing.viewer",
}

# Modules that are public as a whole.
_MODULES = ("batch",)

__all__ = ["__version__", *_HOME, *_MODULES]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"ssm_decouple.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'ssm_decouple' has no attribute '{name}'")
    value = getattr(import_module(f"ssm_decouple.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
