"""The viewer without a browser: what is drawn, what is sent, what is written, what is refused."""

from __future__ import annotations

import dataclasses
import re
import shutil
import socket
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pinocchio as pin
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.viewing.viewer import browser, export, law_name, scenes_of
from ssm_decouple.viewing.viewer.live import Live, case_of
from ssm_decouple.viewing.viewer.parts import antenna, bus, spacecraft_parts
from ssm_decouple.viewing.viewer.player import numbers, status
from ssm_decouple.viewing.viewer.plots import curves_of
from ssm_decouple.viewing.viewer.scene import Scene, body_poses, usual_exaggeration, without_jumps
from ssm_decouple.viewing.viewer.server import open_server
from ssm_decouple.viewing.viewer.shapes import Trail, arrow_lengths, from_z_to, rods, simplified, way_out
from ssm_decouple.viewing.viewer.stage import Shown, Stage

MESHED = """<robot name="meshed"><link name="base"><inertial><mass value="100"/>
<inertia ixx="9" iyy="9" izz="9" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="arm"><inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
<visual><origin xyz="0 0 0.1"/><geometry><mesh filename="package://nowhere/arm.stl" scale="2 2 2"/></geometry></visual>
</link>
<link name="tip"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="a" type="continuous"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/></joint>
<joint name="b" type="continuous"><parent link="arm"/><child link="tip"/><origin xyz="0 0 0.8"/><axis xyz="0 0 1"/>
</joint>
</robot>"""


@pytest.fixture(scope="module")
def motions():
    case = dataclasses.replace(ssm.load_case("case3"), duration=12.0, dt=0.5)
    return dict(ssm.compare(case).motions)


@pytest.fixture(scope="module")
def flexible():
    robot = ssm.load_robot("ets_vii_flexible")
    law = ssm.SelectiveLaw(robot, ssm.Protection("none"), rate_limit=np.deg2rad(5.0))
    q = robot.configuration(
        np.deg2rad([150, -20, -10, 0, 0, 0]), pin.SE3(pin.rpy.rpyToMatrix(0.3, 0.2, 0.1), np.ones(3))
    )
    return ssm.simulate(law, q, [0.5, 0.2, 2.0], 6.0, 0.1, ssm.Dynamic(step=0.02))


@pytest.fixture(scope="module")
def scene(motions):
    return Scene.of("selective", motions["selective"])


@pytest.fixture
def server():
    opened = open_server(port=0)
    yield opened
    opened.stop()


def rotation(wxyz):
    return Rotation.from_quat(np.asarray(wxyz)[[1, 2, 3, 0]]).as_matrix()


def test_poses_are_pinocchio_s_placements_at_the_samples(scene):
    model = scene.robot.model
    data = model.createData()
    for sample in (0, 7, 24):
        frame = scene.at(scene.time[sample])
        pin.forwardKinematics(model, data, scene.motion.configuration.values[sample])
        for joint, position, wxyz in zip(scene.joints, frame.positions, frame.quaternions, strict=True):
            np.testing.assert_allclose(position, data.oMi[joint].translation, atol=1e-12)
            np.testing.assert_allclose(rotation(wxyz), data.oMi[joint].rotation, atol=1e-12)


def test_between_samples_poses_lie_between(scene):
    a, b, c = (scene.at(t) for t in (5.0, 5.25, 5.5))
    np.testing.assert_allclose(b.positions, 0.5 * (a.positions + c.positions))
    turn = rotation(a.quaternions[3]).T @ rotation(c.quaternions[3])
    half = rotation(a.quaternions[3]).T @ rotation(b.quaternions[3])
    np.testing.assert_allclose(half @ half, turn, atol=1e-9)
    assert scene.at(-3.0).sample == 0
    assert scene.at(99.0).sample == 24


def test_quaternions_do_not_jump(rng):
    turning = Rotation.from_rotvec(np.outer(np.linspace(0.0, 20.0, 200), [0.0, 0.0, 1.0])).as_quat()
    smooth = without_jumps(turning * rng.choice([-1.0, 1.0], 200)[:, None])
    assert np.all(np.sum(smooth[1:] * smooth[:-1], axis=1) > 0)


def test_the_base_rate_is_split_into_its_two_parts(motions):
    for name, k in (("none", 0), ("selective", 2), ("reactionless", 3)):
        scene = Scene.of(name, motions[name])
        attitude = Rotation.from_quat(scene.motion.base_quaternion.values)
        whole = attitude.apply(scene.motion.base_angular_velocity.values)
        np.testing.assert_allclose(scene.rates.sum(axis=0), whole, atol=1e-18)
        along = np.einsum("mij,mj->mi", attitude.inv().as_matrix(), scene.rates[1])
        protected = scene.motion.protected_rate.values
        np.testing.assert_allclose(along @ scene.motion.U_c.values[3:], protected, atol=1e-18)
        if k:
            assert np.abs(protected).max() < 1e-15
            free = attitude.inv().apply(scene.rates[0]) @ scene.motion.U_c.values[3:]
            assert np.abs(free).max() < 1e-15


def test_inertial_directions_keep_their_axes():
    case = ssm.load_case("case1")
    q = case.start()
    q[3:7] = Rotation.from_rotvec([0.4, -0.3, 0.2]).as_quat()
    law = ssm.SelectiveLaw(case.robot, ssm.Protection([0.6, 0.0, 0.8], "inertial"))
    scene = Scene.of("inertial", ssm.simulate(law, q, case.target, 2.0, 0.5))
    np.testing.assert_allclose(np.abs(scene.axes), np.tile([1.0, 0.0, 0.0, 0.0], (5, 1)), atol=1e-12)
    assert np.abs(scene.rates[1]).max() < 1e-15 < np.abs(scene.rates[0]).max()


def test_arrows_show_the_rates_in_one_scale_and_the_momentum_s_direction(scene):
    now = scene.at(2.0).vectors._replace(free=np.array([1e-3, 0, 0]), protected=np.array([0, 0, 1e-19]))
    free, protected, momentum = arrow_lengths(now._replace(momentum=np.array([0, 3.0, 0])), 2000.0, 16.0)
    np.testing.assert_allclose(free, [2.0, 0, 0])
    np.testing.assert_allclose(protected, [0, 0, 2e-16])
    np.testing.assert_allclose(momentum, [0, 0.14 * 16.0, 0])
    assert not scene.has_momentum
    assert not arrow_lengths(now, 2000.0, 16.0)[2].any()


def test_arrows_begin_where_their_direction_leaves_the_bus(scene, rng):
    low, high = box = bus(scene.parts)
    np.testing.assert_allclose([low, high], [[-1.275, -1.28, -1.275], [1.275, 1.28, 1.275]], atol=0.3)
    for _ in range(50):
        attitude, direction = rng.normal(size=(2, 4))
        attitude /= np.linalg.norm(attitude)
        direction = direction[:3] / np.linalg.norm(direction[:3])
        way = way_out(box, attitude, direction)
        np.testing.assert_allclose(np.cross(way, direction), 0.0, atol=1e-12)
        end = rotation(attitude).T @ way
        assert np.all((low <= end + 1e-9) & (end <= high + 1e-9))
        assert np.any(np.isclose(end, low) | np.isclose(end, high))
        np.testing.assert_allclose(rotation(from_z_to(direction))[:, 2], direction, atol=1e-12)
    assert not way_out(box + 5.0, attitude, direction).any()
    assert not bus([]).any()


def test_lines_are_rods_with_their_outsides_out(rng):
    segments = np.cumsum(rng.normal(size=(4, 2, 3)), axis=1)
    import trimesh

    for segment in segments:
        vertices, faces = rods(segment[None], 0.01)
        length = np.linalg.norm(segment[1] - segment[0])
        square = 0.01 * np.sqrt(2.0)  # the side of the rod's section
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        assert mesh.area == pytest.approx(4 * square * length)
        assert mesh.convex_hull.volume == pytest.approx(square**2 * length)
        middles = vertices[faces].mean(axis=1)
        axis = (segment[1] - segment[0]) / length
        outwards = (middles - segment[0]) - np.outer((middles - segment[0]) @ axis, axis)
        assert np.all(np.sum(outwards * mesh.face_normals, axis=1) > 0)


def test_a_path_is_drawn_with_few_points_and_nowhere_off():
    t = np.linspace(0.0, 4.0, 900)
    path = np.column_stack([np.cos(2.0 * t), np.sin(2.0 * t), 0.1 * t]) * np.minimum(t, 2.0)[:, None]
    kept = simplified(path, 1e-3)
    assert (kept[0], kept[-1]) == (0, 899)
    assert 20 < len(kept) < 200
    for i, point in enumerate(path):
        place = min(np.searchsorted(kept, i, side="right"), len(kept) - 1)
        a, b = path[kept[place - 1]], path[kept[place]]
        share = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
        assert np.linalg.norm(point - a - share * (b - a)) <= 1e-3
    assert len(simplified(np.outer(t, [1.0, 2.0, 3.0]), 1e-9)) == 2
    assert len(simplified(np.zeros((50, 3)), 1e-9)) == 2


def test_a_trail_grows_and_its_rest_takes_no_room(server):
    points = np.cumsum(np.ones((6, 3)), axis=0)
    trail = Trail(server, "/trail", 6, (1, 2, 3), 0.01)
    for count in (0, 1):
        trail.draw(points[:count])
        assert not trail.mesh.visible
    for count in (2, 4, 6):
        trail.draw(points[:count])
        assert trail.mesh.visible
        np.testing.assert_allclose(trail.mesh.vertices.max(axis=0), points[count - 1], atol=0.02)
        np.testing.assert_allclose(trail.mesh.vertices.min(axis=0), points[0], atol=0.02)


def test_momentum_is_told_where_there_is_some(scene):
    assert not scene.has_momentum
    assert numbers(scene, 5.0)[3] == "zero"
    case = ssm.load_case("case1")
    law = ssm.SelectiveLaw(case.robot, ssm.Protection("none"), momentum=[0, 0, 0, 0, 0, 0.5])
    pushed = Scene.of("pushed", ssm.simulate(law, case.start(), case.target, 1.0, 0.5))
    assert pushed.has_momentum
    assert numbers(pushed, 0.5)[3] == "0.5"


def test_wings_bend_as_the_plant_s_segments_do(flexible):
    scene = Scene.of("flexible", flexible)
    assert [wing.appendage.name for wing in scene.wings] == ["wing_left", "wing_right"]
    assert not any(part.name in ("wing_left", "wing_right") for part in scene.parts)
    plant = ssm.Plant.of(ssm.load_robot("ets_vii_flexible"))
    model = plant.robot.model
    data = model.createData()
    i = int(np.abs(flexible.hinge_angles.values).max(axis=1).argmax())
    q = plant.configuration(flexible.configuration.values[i], 50.0 * flexible.hinge_angles.values[i])
    pin.framesForwardKinematics(model, data, q)
    frame = scene.at(scene.time[i], exaggeration=50.0)
    for place, name in ((-2, "wing_left_segment_0"), (-1, "wing_right_segment_0")):
        pose = data.oMf[plant.robot.frame_id(name)]
        np.testing.assert_allclose(frame.positions[place], pose.translation, atol=1e-9)
        np.testing.assert_allclose(rotation(frame.quaternions[place]), pose.rotation, atol=1e-9)
    tip = scene.wings[0].segment
    np.testing.assert_allclose(tip.pose.translation, [0, 3.25, 0], atol=1e-12)
    assert tip.size == (0.04, 6.5, 2.4)
    (drawn,) = (part for part in spacecraft_parts(scene.robot) if part.name == "wing_left")
    np.testing.assert_allclose(np.sort(scene.wings[0].plate.corners, 0), np.sort(drawn.corners, 0), atol=1e-12)
    assert 0.4 <= usual_exaggeration([scene]) * np.abs(flexible.hinge_angles.values).max() / 0.12 <= 1.0


def test_a_wing_of_an_own_robot_is_drawn_without_a_box_as_the_record_has_it():
    """Three segments, turned, on a robot that no catalogue knows and whose URDF draws nothing of that name."""
    own = ssm.load_robot("ets_vii")
    panel = ssm.Appendage("panel", [0, 0, 1.3], [0, 0, 2], [1, 0, 0], 4.0, 1.0, 20.0, 0.2, 0.01, segments=3, turn=0.7)
    robot = ssm.Robot(own.urdf, name="own", appendages=[panel])
    law = ssm.SelectiveLaw(robot, ssm.Protection("none"), rate_limit=np.deg2rad(5.0))
    q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    motion = ssm.simulate(law, q, [-1.0, 0.5, 2.0], 2.0, 0.2, ssm.Dynamic(step=0.01))
    scene = Scene.of("own", motion)
    (wing,) = scene.wings
    assert wing.appendage == panel
    plant = ssm.Plant.of(robot)
    model, angles = plant.robot.model, np.array([0.1, -0.05, 0.2])
    q = plant.configuration(motion.configuration.values[-1], angles)
    pin.framesForwardKinematics(model, data := model.createData(), q)
    positions, wxyz = wing.poses(angles)
    base = data.oMi[1]
    for i in range(3):
        pose = base.actInv(data.oMf[plant.robot.frame_id(f"panel_segment_{i}")])
        np.testing.assert_allclose(positions[i], pose.translation, atol=1e-12)
        np.testing.assert_allclose(rotation(wxyz[i]), pose.rotation, atol=1e-12)
    last = positions[2] + rotation(wxyz[2]) @ (wing.span / 3)
    assert last @ panel.turned_normal == pytest.approx(float(panel.tip_deflection(angles)))
    np.testing.assert_allclose(np.sort(wing.segment.size), [wing.thickness, 1.0, 4.0 / 3.0])


def test_riding_on_the_base_the_base_stands_still(scene):
    for t in (0.0, 6.0, 12.0):
        frame = scene.at(t)
        position, wxyz = scene.riding(frame)
        seen = rotation(wxyz) @ frame.positions[0] + position
        np.testing.assert_allclose(seen, scene.body_poses[0, 0, :3], atol=1e-12)
        turned = rotation(wxyz) @ rotation(frame.quaternions[0])
        np.testing.assert_allclose(turned, rotation(scene.body_poses[0, 0, 3:]), atol=1e-12)


def test_the_antenna_looks_outwards(scene):
    foot, direction = antenna(scene.parts)
    np.testing.assert_allclose(foot, [-0.75, 1.28, 0.55])
    np.testing.assert_allclose(direction, [0, 1, 0], atol=1e-12)
    assert antenna([part for part in scene.parts if "antenna" not in part.name]) is None


def test_the_stage_sends_poses_and_shows_what_is_asked_for(motions, server):
    scenes = scenes_of(motions)
    stage = Stage(server, scenes)
    stage.draw(6.0)
    for actor in stage.actors:
        frame = actor.scene.at(6.0)
        for body, position in zip(actor.bodies, frame.positions, strict=True):
            np.testing.assert_allclose(body.position, position, atol=1e-4)  # viser leaves smaller changes out
        tool = actor.scene.motion.end_effector_position.sel(time=slice(0.0, 6.0)).values
        np.testing.assert_allclose(actor.trail.mesh.vertices.max(axis=0), tool.max(axis=0), atol=0.05)
        np.testing.assert_allclose(actor.trail.mesh.vertices.min(axis=0), tool.min(axis=0), atol=0.05)
        assert not actor.arrows.rates[2].visible
    none, selective, *_ = stage.actors
    free, now = none.arrows.rates[0], scenes[0].at(6.0).vectors
    assert free.visible
    assert [arrow.visible for arrow in selective.arrows.directions] == [True, True]
    assert free.scale[2] == pytest.approx(np.linalg.norm(stage.rate_scale * now.free))
    np.testing.assert_allclose(rotation(free.wxyz)[:, 2], now.free / np.linalg.norm(now.free), atol=1e-4)
    stage.draw(3.0, shown=Shown(axes=False, rates=False, path=False, sight=False))
    hidden = [*selective.arrows.directions, *none.arrows.rates, none.trail.mesh, *none.sight]
    assert not any(node.visible for node in hidden)
    assert np.ptp(stage.offsets[:, 2]) > 0
    apart = np.diff(stage.offsets[:, 2])
    assert np.all(-apart > scenes[0].box[1, 2] - scenes[0].box[0, 2])


def test_everything_is_inside_the_picture(motions, server):
    stage = Stage(server, scenes_of(motions))
    for aspect in (0.6, 1.0, 1.8):
        position, middle, fov = stage.camera(aspect)
        R = rotation(export._looking(position, middle))
        corners = np.array(np.meshgrid(*stage.corners.T)).reshape(3, -1).T
        x, y, z = ((corners - position) @ R).T
        assert np.all(z > 0)
        assert np.abs(y / z).max() < np.tan(fov / 2)
        assert np.abs(x / z).max() < aspect * np.tan(fov / 2)
        assert max(np.abs(y / z).max(), np.abs(x / z).max() / aspect) > 0.6 * np.tan(fov / 2)


def test_the_curves_are_the_motion_with_a_cursor(motions):
    scenes = scenes_of(motions)
    left, protected, attitude, rates = curves_of(scenes, 1)
    assert [name for name, *_ in left.lines] == list(motions)
    assert protected.lines[0][2].min() > -6  # none
    assert protected.lines[1][2].max() < -15
    np.testing.assert_allclose(left.lines[0][2][-1], 1e3 * motions["none"].end_effector_error.values[-1])
    assert [name for name, *_ in attitude.lines] == ["roll", "pitch", "yaw"]
    assert len(rates.lines) == 6
    time, first, *_, cursor = left.with_cursor(4.2)
    at = np.flatnonzero(np.isfinite(cursor))
    np.testing.assert_array_equal(time[at], [4.2, 4.2])
    assert cursor[at[0]] < first.min() < first.max() < cursor[at[1]]
    assert np.all(np.diff(time) >= 0)
    assert np.all(np.isfinite(first))


def test_how_a_motion_stands(motions):
    scene = Scene.of("x", motions["none"].assign_attrs(outcome="stalled", outcome_time=8.0))
    assert [status(scene, t) for t in (7.9, 8.0)] == ["under way", "stalled"]
    assert [law_name(motion) for motion in motions.values()][:3] == ["none", "selective", "reactionless"]


def test_the_page_is_one_file_that_needs_nothing(motions, tmp_path):
    path = export.write_html(scenes_of({name: motions[name] for name in ("none", "selective")}), tmp_path / "page.html")
    text = path.read_text(encoding="utf-8")
    assert path.stat().st_size < 3e6
    assert "__VISER_EMBED_DATA__" in text
    assert "Case 3: Antenna line of sight" in text
    shell = re.sub(r'"[A-Za-z0-9+/=]{1000,}"', '""', text)
    assert not re.findall(r'(?:src|href)=["\'](?!data:)[^"\']', shell)


def alone(page):
    """Stop a page's own thread, so that the test is its only clock."""
    page._over.set()
    for event in ("_changed", "_wake"):
        if hasattr(page, event):
            getattr(page, event).set()
    page._thread.join()
    return page


def test_the_clock_plays_pauses_and_ends(motions):
    with alone(ssm.view(motions, port=0, playing=False)) as player:
        player.server.get_clients = lambda: {0: None}  # somebody looks
        player.seek(11.0)
        assert not player._advance(1.0)
        player.play()
        assert player._advance(0.05)
        assert 11.4 < player.time <= 12.0
        assert player.play_button.label == "pause"
        player.repeat.value = False
        for _ in range(60):
            player._advance(0.05)
        assert (player.time, player.playing) == (12.0, False)
        player.play()
        assert player.time < 1.0
        player.pause()
        player.server.get_clients = dict
        player.seek(99.0)
        assert player.time == 12.0


def test_a_motion_of_one_sample_is_shown(motions, tmp_path):
    """What an interrupted run may leave."""
    first = motions["selective"].isel(time=slice(0, 1))
    with alone(ssm.view({"first": first, "whole": motions["none"]}, port=0, playing=False)) as player:
        assert [actor.trail is None for actor in player.stage.actors] == [True, False]
    with alone(ssm.view(first, port=0, playing=False)) as player:
        player.seek(5.0)
        assert (player.time, player.slider.max) == (0.0, 1e-3)
    assert export.write_html(scenes_of(first), tmp_path / "first.html").stat().st_size > 1e5


def test_riding_and_what_is_shown_are_switched_on_the_page(flexible):
    with alone(ssm.view(flexible, port=0, playing=False)) as player:
        actor = player.stage.actors[0]
        player.view.value = "the base"
        player.checks["sight"].value = False
        player.bending.value = 1.0
        assert (player.riding, player.shown.sight, player.exaggeration) == (True, False, 10.0)
        player.seek(6.0)
        player._draw()
        assert not actor.sight[0].visible
        assert np.linalg.norm(actor.view.position) > 1e-6
        assert player.slider.value == 6.0


def test_a_port_that_is_taken_is_told():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.warns(ssm.DecoupleWarning, match=rf"port {port} is taken; using \d+"):
            other = open_server(port=port)
    assert other.get_port() != port
    assert other.get_host() == "127.0.0.1"
    other.stop()
    with pytest.raises(ssm.InputError, match="port is 70000"):
        open_server(port=70000)
    with pytest.raises(ssm.InputError, match=r"cannot listen on '203\.0\.113\.7'"):
        open_server(host="203.0.113.7")


def test_missing_meshes_are_boxes_and_told_once(tmp_path):
    robot = ssm.Robot(MESHED, name="meshed")
    with pytest.warns(ssm.DecoupleWarning, match=r"1 of its meshes .*arm\.stl.*--meshes") as told:
        (part,) = spacecraft_parts(robot)
    assert len(told) == 1
    assert part.kind == "box"
    np.testing.assert_allclose(part.size, [0.096, 0.096, 0.8])
    np.testing.assert_allclose(part.pose.translation, [0, 0, 0.4], atol=1e-12)
    import trimesh

    trimesh.creation.box((0.1, 0.2, 0.3)).export(tmp_path / "arm.stl")
    (found,) = spacecraft_parts(robot, mesh_folders=[tmp_path])
    assert found.kind == "mesh"
    np.testing.assert_allclose(found.extent, [[-0.1, -0.2, -0.3], [0.1, 0.2, 0.3]])
    (tmp_path / "arm.stl").write_text("no mesh")
    with pytest.warns(ssm.DecoupleWarning, match="drawn as boxes"):
        spacecraft_parts(robot, mesh_folders=[tmp_path])


def test_a_urdf_without_visuals_is_drawn_as_boxes_along_its_links(ets_vii):
    bare = ssm.Robot(re.sub(r"(?s)<visual.*?</visual>", "", ets_vii.urdf), name="bare")
    _, *arm = spacecraft_parts(bare)
    assert [part.joint for part in arm] == [2, 3, 4, 5, 6, 7]
    pin.framesForwardKinematics(bare.model, data := bare.model.createData(), bare.configuration([0.3] * 6))
    joints = [data.oMi[joint].translation for joint in range(2, 8)] + [data.oMf[bare.end_effector_id].translation]
    for part, start, end in zip(arm, joints[:-1], joints[1:], strict=True):
        pose = data.oMi[part.joint] * part.pose
        half = np.array([0.0, 0.0, 0.5 * part.size[2]])
        np.testing.assert_allclose([pose.act(-half), pose.act(half)], [start, end], atol=1e-12)


def test_what_is_no_motion_is_refused(motions, call, tmp_path):
    other = motions["none"].assign(robot_urdf=((), np.array(MESHED, dtype=object)))
    other.attrs = {**other.attrs, "end_effector": "tip"}
    bare = motions["none"].drop_attrs()
    wrong = {"motion of another robot": other, "lacks the attribute 'robot'": bare, "is no motion to": {}}
    for words, given in (wrong | {"str is no motion": ["case1"]}).items():
        with pytest.raises(ssm.InputError, match=words):
            scenes_of(given)
    nothing = tmp_path / "nothing.nc"
    nothing.write_text("text")
    path = ssm.save_motion(motions["none"], tmp_path / "none.nc")
    for words, told in (
        (["view", nothing], "is not a netCDF file"),
        (["view"], "give motions to show, or --live"),
        (["view", path, path], "the same motion stands twice"),
        (["view", "--live", "case9"], "neither a file nor one of the cases"),
        (["render", path], "say what to write"),
        (["render", path, "--png", "x.png", "--size", "big"], "size is 'big'"),
        (["render", path, "--png", "x.png", "--browser", "netscape"], "no browser at 'netscape'"),
    ):
        done = call(*words)
        assert (done.returncode, told in done.stderr.replace("\n", " ")) == (1, True), done.stderr


def test_without_a_browser_it_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(browser.shutil, "which", lambda _: None)
    monkeypatch.setattr(browser, "_MAC", ())
    monkeypatch.setattr(browser.Path, "home", lambda: tmp_path)
    with pytest.raises(ssm.InputError, match="apt install chromium"):
        browser.find_browser()
    bundled = tmp_path / ".cache/ms-playwright/chromium-1/chrome-linux/chrome"
    bundled.parent.mkdir(parents=True)
    bundled.touch()
    assert browser.find_browser() == bundled


@pytest.fixture
def filmed(monkeypatch, motions):
    """Scenes whose pictures are grey, so that films need no browser."""
    scenes = scenes_of(motions["selective"])

    @contextmanager
    def camera(*_):
        pixels = np.full((90, 100, 4), [90, 90, 90, 255], dtype=np.uint8)
        yield lambda now: export._captioned(pixels, scenes, now, (160, 90), True, 1.0)

    monkeypatch.setattr(export, "_camera", camera)
    return scenes


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs ffmpeg: apt install ffmpeg")
def test_a_film_is_mp4_and_ffmpeg_s_complaint_is_told(filmed, tmp_path):
    shares = []
    path = export.write_film(filmed, tmp_path / "film.mp4", 4.0, 5, (160, 90), progress=shares.append)
    assert path.read_bytes()[4:8] == b"ftyp"
    assert (len(shares), shares[-1]) == (16, 1.0)
    with pytest.raises(ssm.FileError, match="ffmpeg cannot write"):
        export.write_film(filmed, tmp_path / "film.unknown", 4.0, 5, (160, 90))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["film.mp4"]


def test_a_picture_is_written_whole(filmed, tmp_path):
    path = export.write_png(filmed, tmp_path / "end.png", at=99.0, size=(160, 90))
    with Image.open(path) as image:
        assert image.size == (160, 90)
        assert image.getpixel((155, 60)) == (90, 90, 90) != image.getpixel((2, 88))
    with pytest.raises(ssm.FileError, match="cannot write"):
        export.write_png(filmed, tmp_path / "nowhere" / "end.png", size=(160, 90))


def test_without_ffmpeg_a_gif_is_written_and_said(filmed, monkeypatch, tmp_path):
    monkeypatch.setattr(export.shutil, "which", lambda _: None)
    with pytest.warns(ssm.DecoupleWarning, match=r"ffmpeg is not installed; writing .*film\.gif"):
        path = export.write_film(filmed, tmp_path / "film.mp4", speed=6.0, size=(160, 90))
    with Image.open(path) as film:
        assert film.size == (160, 90)
        assert film.n_frames > 5


def test_without_viser_the_extra_is_named():
    code = (
        "import sys; sys.modules['viser'] = None; import ssm_decouple as ssm\n"
        "try: ssm.view([])\nexcept ssm.InputError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "pip install 'ssm-decouple[viewer]'" in done.stdout, done.stderr


@pytest.fixture(scope="module")
def live():
    with alone(Live(ssm.load_case("case1"), port=0)) as page:
        yield page


def test_the_live_law_is_the_simulation(live):
    """With nobody at the handle the live motion is the explicit method's."""
    live.restart()
    live._wake.clear()
    live._ask()
    for _ in range(10):
        live.advance(0.1)  # at pace 5
    case = dataclasses.replace(live.case, duration=5.0)
    motion = case.run()
    assert live.clock == pytest.approx(5.0)
    np.testing.assert_allclose(live.q, motion.configuration.values[-1], atol=1e-9)
    np.testing.assert_allclose(live.end_effector, motion.end_effector_position.values[-1], atol=1e-9)


def test_a_dragged_target_is_answered_at_once(live):
    before, rates, there = live.end_effector, live.values.copy(), live.target + np.array([0.0, 0.5, 0.0])
    live.drag(there)
    live.advance(0.02)
    assert not np.allclose(live.values, rates)
    assert len(live.answers) == 1
    live.advance(2.0)
    assert np.linalg.norm(live.end_effector - there) < 0.9 * np.linalg.norm(before - there)


def test_protections_change_on_the_way_and_reactionless_control_refuses(live):
    assert list(live.laws) == ["none", "yaw", "the case's own", "all rotation"]
    live.restart()
    live.drag(np.array(live.case.target))
    live.protect("all rotation")
    base = live.q[:7].copy()
    for _ in range(16):
        live.advance(1.0)
    assert live.outcome() == "stalled"
    assert live.numbers()["rho"] > 0
    assert live.numbers()["left"] > 0.2
    np.testing.assert_allclose(live.q[3:7], base[3:7], atol=1e-9)
    assert "stalled" in live._state()
    assert "no way on" in live._state()
    assert len(live.arrows.directions) == 3
    assert not any(arrow.visible for arrow in live.arrows.rates)
    live.protect("none")
    live._draw()
    assert len(live.arrows.directions) == 0
    for _ in range(20):
        live.advance(1.0)
    assert live.outcome() == "arrived"
    live.protect("0.6,0,0.8")
    live._ask()
    np.testing.assert_allclose(live.law.protection.U_c.T, [[0.6, 0.0, 0.8]])
    assert abs(live.values[3:6] @ [0.6, 0.0, 0.8]) < 1e-16 < np.linalg.norm(live.values[3:6])
    assert live.protection.options[-1] == live.protection.value == "0.6,0,0.8"
    with pytest.raises(ssm.InputError, match="'sideways'"):
        live.protect("sideways")
    assert live.chosen == "0.6,0,0.8"


def test_live_arrows_are_those_of_the_record(live):
    """What the page draws of the law's rates is what a recorded motion of it draws, and its momentum too."""
    live.restart()
    live.drag(np.array(live.case.target))
    live.protect("the case's own")
    live._wake.clear()
    live.law.momentum = [0.1, 0.0, 0.0, 0.0, 0.3, 0.4]
    try:
        live._ask()
        now = live._vectors(body_poses(live.robot, live.q[None], live.joints)[0, 0])
        scene = Scene.of("it", ssm.simulate(live.law, live.q, live.case.target, 0.2, 0.1))
        recorded = scene.at(0.0).vectors
        np.testing.assert_allclose(now.free, recorded.free, rtol=1e-9)
        assert np.linalg.norm(now.protected) < 1e-15
        np.testing.assert_allclose(now.momentum, recorded.momentum, atol=1e-9)
        for one, other in zip(now[:4], recorded[:4], strict=True):
            np.testing.assert_allclose(one, other, atol=1e-12)
        live._draw()
        free, protected, momentum = live.arrows.rates
        assert (free.visible, protected.visible, momentum.visible) == (True, False, True)
    finally:
        live.law.momentum = None


def test_a_robot_can_be_live_and_a_case_of_other_tasks_cannot(write):
    case = case_of("ets_vii")
    np.testing.assert_allclose(case.robot.frame_pose(case.start()).translation, case.target)
    text = ssm.cases()["case1"].read_text()
    posture = text.replace(
        re.search(r"\[target\]\nposition.*\n", text)[0],
        '[[task]]\nkind = "posture"\npositions = [0, 0, 0, 0, 0, 0]\n',
    )
    with pytest.raises(ssm.InputError, match="tasks PostureTask"):
        Live(ssm.load_case(write(posture, "posture.toml")), port=0)


def test_body_poses_are_one_row_a_sample(ets_vii, rng):
    q = np.array([pin.randomConfiguration(ets_vii.model, -np.ones(13), np.ones(13)) for _ in range(3)])
    poses = body_poses(ets_vii, q, (1, 4))
    assert poses.shape == (3, 2, 7)
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0)
