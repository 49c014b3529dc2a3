"""Robots in MuJoCo, free to float, without gravity."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np

import ssm_decouple as ssm


def mujoco_model(robot: ssm.Robot) -> mujoco.MjModel:
    root = ET.fromstring(robot.urdf)
    for link in root.findall("link"):
        for kind in ("visual", "collision"):
            for shape in link.findall(kind):
                link.remove(shape)
    options = ET.SubElement(root, "mujoco")
    ET.SubElement(options, "compiler", fusestatic="false", strippath="false", boundmass="0", boundinertia="0")
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    spec.option.gravity = [0, 0, 0]
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.worldbody.first_body().add_freejoint(name="root")
    return spec.compile()


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    M = np.empty((model.nv, model.nv))
    for i, unit in enumerate(np.eye(model.nv)):
        mujoco.mj_mulM(model, data, M[i], unit)
    return M
