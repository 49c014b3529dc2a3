from __future__ import annotations

import inspect
import json
import tracemalloc

import numpy as np
import pytest
from scipy.stats import qmc, t

import ssm_decouple as ssm
from ssm_decouple.studies import workspace
from ssm_decouple.studies.comparison import write_csv
from ssm_decouple.studies.postures import joint_ranges
from ssm_decouple.studies.workspace import (
    BLOCKS,
    MARGIN,
    PROTECTIONS,
    Grid,
    Workspace,
    arm_joints,
    interval,
    joint_slice,
)
from ssm_decouple.viewing import workspace as viewing

# A yaw joint, a pitch joint and a boom of 0.2 to 1 m on a base that nothing moves: sigma is the distance from the
# z axis.
BOOM = """<robot name="boom">
  <link name="base"><inertial><mass value="1e12"/>
    <inertia ixx="1e12" iyy="1e12" izz="1e12" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="a"/><link name="b"/>
  <link name="end_effector"><inertial><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="yaw" type="continuous"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/></joint>
  <joint name="pitch" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint>
  <joint name="boom" type="prismatic"><parent link="b"/><child link="end_effector"/><axis xyz="1 0 0"/>
    <limit lower="0.2" upper="1.0" effort="1" velocity="1"/></joint>
</robot>"""


def boom_share(margin: float) -> float:
    """Share of the boom's postures that stand further than `margin` from the z axis."""

    def primitive(r: float) -> float:
        return r * np.arccos(margin / r) - margin * np.arccosh(r / margin)

    return 2 / np.pi * (primitive(1.0) - primitive(0.2)) / 0.8


@pytest.fixture(scope="module")
def boom():
    study = Workspace(ssm.Robot(BOOM, name="boom"), margin=0.15, samples=2**14, voxel=0.125)
    study.run()
    return study


@pytest.fixture(scope="module")
def small(ets_vii):
    study = Workspace(ets_vii, samples=256, voxel=0.5)
    study.run()
    return study


def test_the_share_of_joint_space_is_the_closed_form(boom):
    found = {row.margin_m: row for row in boom.rows() if row.protection == "none"}
    for margin in (0.01, 0.05, 0.15):
        assert found[margin].share == pytest.approx(boom_share(margin), abs=2e-3)
    assert found[0.15].samples == 2**14
    # Three joints leave fewer than three freedoms under any protection.
    for row in boom.rows():
        if row.k > 0:
            assert (row.share, row.share_low, row.volume, row.typical) == (0.0, 0.0, 0.0, 0.0)
            assert 0.0 < row.share_high < 1e-3


def test_the_interval_covers_the_truth_as_often_as_it_says():
    robot, covered, narrower = ssm.Robot(BOOM, name="boom"), 0, 0
    for seed in range(20):
        study = Workspace(robot, margin=0.15, samples=2**9, voxel=0.25, seed=seed, protections=("none",))
        study.run()
        row = next(row for row in study.rows() if row.margin_m == 0.15)
        covered += row.share_low <= boom_share(0.15) <= row.share_high
        plain = np.sqrt(boom_share(0.15) * (1 - boom_share(0.15)) / row.samples)
        narrower += row.share_high - row.share_low < 2 * 1.96 * plain
    assert covered >= 16  # of 20: 95 % and more miss four with a chance of 0.3 %
    assert narrower >= 18  # than plain random postures would give


def test_the_voxels_are_those_that_the_boom_reaches(boom):
    best, grid = boom.best("none"), boom.grid
    corners = np.stack(np.meshgrid(*(grid.edges(i) for i in range(3)), indexing="ij"), axis=-1)
    eight = np.stack([np.roll(corners, shift, (0, 1, 2))[1:, 1:, 1:] for shift in np.ndindex(2, 2, 2)])
    radius, off_axis = np.linalg.norm(eight, axis=-1), np.linalg.norm(eight[..., :2], axis=-1)
    inside = (radius.min(axis=0) > 0.2 + grid.edge) & (radius.max(axis=0) < 1.0)
    outside = (radius.min(axis=0) > 1.0 + grid.edge) | (radius.max(axis=0) < 0.2)
    assert inside.sum() > 300
    assert np.all(np.isfinite(best[inside]))
    assert not np.any(np.isfinite(best[outside]))
    # In a voxel the best posture is the farthest from the z axis.
    assert np.all(best[inside] <= off_axis.max(axis=0)[inside] + 1e-9)
    clear = inside & (off_axis.max(axis=0) > 1.3 * boom.margin)
    assert np.all(best[clear] > boom.margin)
    kept = next(row for row in boom.rows() if (row.protection, row.margin_m) == ("none", boom.margin))
    assert kept.volume == np.mean(best[np.isfinite(best)] > boom.margin)
    assert kept.reachable_m3 == pytest.approx(np.isfinite(best).sum() * 0.125**3)


def test_a_plain_loop_counts_the_same(ets_vii, small):
    protections = [ssm.Protection(name) for name in PROTECTIONS]
    visits = np.zeros(small.grid.shape)
    for number in range(BLOCKS):
        sequence = qmc.Sobol(6, seed=np.random.default_rng([0, number]))
        sigmas = []
        for joints in np.pi * (2 * sequence.random(16) - 1):
            q = ets_vii.configuration(joints)
            coupling = ets_vii.coupling(q)
            sigmas.append([coupling.manipulability(protection).smallest for protection in protections])
            cell = (ets_vii.frame_pose(q).translation - small.grid.corner) // 0.5
            visits[tuple(cell.astype(int))] += 1
        for m, margin in enumerate(small.margins):
            np.testing.assert_array_equal(small.shares[number][m], np.mean(np.array(sigmas) > margin, axis=0))
    np.testing.assert_array_equal(small.drawn.visits.reshape(small.grid.shape), visits)
    for row in small.rows():
        place = np.flatnonzero(small.edges == row.margin_m)[0]
        assert small.above(row.protection)[place] == pytest.approx(row.share)


def test_the_best_postures_are_what_they_are_said_to_be(ets_vii, small, rng):
    for p in (0, 3, 7):
        seen = np.flatnonzero(small.elites.sigma[p] >= 0)
        for place in rng.choice(seen, 10):
            q = ets_vii.configuration(small.elites.joints[p, place])
            sigma = ets_vii.coupling(q).manipulability(ssm.Protection(PROTECTIONS[p])).smallest
            assert sigma == pytest.approx(small.elites.sigma[p, place], rel=1e-9, abs=1e-12)
            assert small.grid.place(ets_vii.frame_pose(q).translation[None]) == [place]
    joints, sigma = small.best_posture("all")
    assert sigma == np.nanmax(small.best("all"))
    assert np.all(np.abs(joints) <= np.pi)


def test_searching_finds_more_than_drawing(ets_vii, monkeypatch):
    def kept(climbs: int) -> float:
        monkeypatch.setattr(workspace, "CLIMBS", climbs)
        study = Workspace(ets_vii, samples=2**12, voxel=0.5)
        study.run()
        return next(row.volume for row in study.rows() if (row.protection, row.margin_m) == ("all", 0.05))

    assert kept(4) > 2 * kept(0) > 0


def same(one: Workspace, other: Workspace) -> bool:
    return one.rows() == other.rows() and np.array_equal(one.elites.joints, other.elites.joints)


def test_the_seed_alone_decides(ets_vii, small):
    threaded, reseeded = (Workspace(ets_vii, samples=256, voxel=0.5, **more) for more in ({"threads": 3}, {"seed": 1}))
    threaded.run()
    reseeded.run()
    assert same(small, threaded)
    assert not same(small, reseeded)


def test_an_interrupted_run_keeps_whole_blocks_and_goes_on(ets_vii, small):
    study = Workspace(ets_vii, samples=256, voxel=0.5)

    def stop(share: float) -> None:
        if share > 0.3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        study.run(stop)
    assert study.blocks == 4
    assert {row.samples for row in study.rows()} == {64}
    told = []
    study.run(told.append)
    assert same(study, small)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)


def test_memory_does_not_grow_with_the_samples(ets_vii, monkeypatch):
    monkeypatch.setattr(workspace, "CHUNK", 256)

    def peak(samples: int) -> int:
        study = Workspace(ets_vii, samples=samples, voxel=0.5, threads=1, protections=("none", "all"))
        tracemalloc.start()
        study.run()
        _, most = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return most

    peak(2**8)
    assert peak(2**14) < 1.1 * peak(2**12)


def test_three_freedoms_are_the_least(ets_vii):
    five = ets_vii.with_locked({"joint_6": 0.0})
    study = Workspace(five, samples=2**8, voxel=1.0)
    study.run()
    shares = {row.protection: row.share for row in study.rows() if row.margin_m == MARGIN}
    assert shares["all"] == 0.0
    assert shares["none"] > shares["yaw"] > shares["roll+yaw"] > 0.5


def test_the_default_margin_is_where_the_law_begins_to_damp():
    default = inspect.signature(ssm.SelectiveLaw).parameters["damping_threshold"].default
    assert default == MARGIN
    from ssm_decouple.cli.workspace import study_workspace

    assert inspect.signature(study_workspace).parameters["margin"].default == MARGIN


def test_the_interval_is_student_s_and_wilson_s():
    shares = np.array([0.2, 0.25, 0.3, 0.21])
    half = t.ppf(0.975, 3) * np.sqrt(np.sum((shares - shares.mean()) ** 2) / 3 / 4)
    np.testing.assert_allclose(interval(shares, 400), (0.24 - half, 0.24 + half))
    low, high = interval(np.zeros(4), 400)
    z2 = 1.959963984540054**2
    assert (low, high) == (0.0, pytest.approx(z2 / (400 + z2)))
    assert interval(np.array([0.0, 0.01]), 400)[0] == 0.0
    assert interval(np.array([0.5]), 100) == (pytest.approx(0.404, abs=1e-3), pytest.approx(0.596, abs=1e-3))


def test_joints_are_drawn_within_their_limits(ets_vii):
    text = ets_vii.urdf.replace('lower="-6.283185307179586" upper="6.283185307179586"', 'lower="-1" upper="2"', 1)
    ranges = joint_ranges(ssm.Robot(text, name="limited"))
    np.testing.assert_array_equal(ranges[0], [-1, 2])
    np.testing.assert_allclose(ranges[1:], np.tile([-np.pi, np.pi], (5, 1)))
    np.testing.assert_allclose(
        joint_ranges(ssm.Robot(BOOM, name="boom")), [[-np.pi, np.pi], [-np.pi, np.pi], [0.2, 1.0]]
    )
    study = Workspace(ssm.Robot(text, name="limited"), samples=2**10, voxel=1.0, protections=("none",))
    study.run()
    shoulder = study.elites.joints[0][study.elites.sigma[0] >= 0][:, 0]
    assert shoulder.min() >= -1
    assert shoulder.max() <= 2


def test_a_plane_through_joint_space(ets_vii, rng):
    posture = np.deg2rad([150, -20, -10, 0, 0, 0])
    cut = joint_slice(ets_vii, posture, ("joint_2", "joint_3"), ("none", "yaw"), points=21)
    assert cut.sigma.shape == (2, 21, 21)
    for i, j in rng.integers(21, size=(8, 2)):
        joints = posture.copy()
        joints[1:3] = cut.angles[0][i], cut.angles[1][j]
        coupling = ets_vii.coupling(ets_vii.configuration(joints))
        for p, name in enumerate(cut.protections):
            assert cut.sigma[p, i, j] == pytest.approx(coupling.manipulability(ssm.Protection(name)).smallest)


def test_the_arm_s_joints_come_first():
    assert arm_joints(ssm.load_robot("two_arms"))[:3] == ["first_joint_1", "first_joint_2", "first_joint_3"]


LIMITLESS = BOOM.replace('lower="0.2" upper="1.0"', "")


@pytest.mark.parametrize(
    ("urdf", "options", "words"),
    [
        (None, {"samples": 0}, "samples is 0"),
        (None, {"samples": 2.5}, "samples is 2.5"),
        (None, {"margin": -0.1}, "margin is -0.1; it must be a positive number"),
        (None, {"margin": np.nan}, "margin is nan"),
        (None, {"seed": -1}, "seed is -1"),
        (None, {"voxel": -1.0}, "voxel is -1.0"),
        (None, {"voxel": 0.01}, r"voxel is 0.01 m, which makes .* take 0\.\d+ m or more"),
        (LIMITLESS, {}, "joint 'boom' of 'odd' (slides without limits|has limits 0 to 0)"),
        (BOOM.replace("continuous", "fixed"), {}, "'odd' has 1 joints, but a position takes three"),
    ],
)
def test_what_makes_no_study_is_refused(ets_vii, urdf, options, words):
    robot = ets_vii if urdf is None else ssm.Robot(urdf, name="odd")
    with pytest.raises(ssm.InputError, match=words):
        Workspace(robot, **options)


def test_the_least_voxel_that_is_named_is_taken(ets_vii):
    with pytest.raises(ssm.InputError) as refused:
        Grid.about(ets_vii, 0.01)
    least = float(str(refused.value).split("take ")[1].split(" m")[0])
    assert Grid.about(ets_vii, least).count <= workspace.VOXELS


def test_a_boom_without_limits_is_refused_by_name():
    robot = ssm.Robot(BOOM, name="odd")
    robot.__dict__["position_limits"] = np.array([[-np.inf, np.inf]] * 3)  # no URDF of such a joint is loaded
    with pytest.raises(ssm.InputError, match="joint 'boom' of 'odd' slides without limits"):
        joint_ranges(robot)


def test_asking_too_early_or_for_another_protection(ets_vii, small):
    early = Workspace(ets_vii, voxel=0.5)
    assert early.rows() == []
    with pytest.raises(ssm.InputError, match="no block of 'ets_vii' is done"):
        early.fit_share("none")
    with pytest.raises(ssm.InputError, match="'x' was not looked at; there are none, roll"):
        small.best("x")


def test_the_tables_tell_the_rows(small, tmp_path):
    rows = small.rows()
    at_margin = [row for row in rows if row.margin_m == MARGIN]
    assert [line[1] for line in viewing.kept_table(at_margin)[1:]] == list(PROTECTIONS)
    assert viewing.kept_table(at_margin)[8][3] == f"{100 * at_margin[-1].share:.2f}"
    by_margin = viewing.margin_table(rows)
    assert by_margin[0][2:] == ["0.005 m", "0.01 m", "0.02 m", "0.05 m", "0.1 m", "0.2 m"]
    assert by_margin[8][2].startswith(f"{100 * rows[-len(small.margins)].share:.1f} / ")
    assert len(write_csv(rows, tmp_path / "rows.csv").read_text().splitlines()) == 1 + len(rows)


def test_the_figures_show_the_study(small):
    sheet = viewing.slices(small)
    share = sheet.axes[7].collections[0].get_array().reshape(small.grid.shape[2], small.grid.shape[0])
    np.testing.assert_array_equal(share, 100 * small.fit_share("all")[:, small.grid.shape[1] // 2].T)
    cloud = viewing.volumes(small)
    assert [panel.get_title().split("\n")[0] for panel in cloud.axes][::3] == ["nothing protected", "all three"]
    (panel,) = viewing.distributions([small]).axes
    np.testing.assert_array_equal(panel.lines[7].get_ydata(), 100 * small.above("all"))
    assert len(viewing.distributions([small] * 4).axes) == 6


def test_the_command(call, tmp_path):
    words = ("study", "workspace", "--samples", 200, "--voxel", 1.0, "--margin", 0.03, "-o", tmp_path)
    done = call(*words, "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert {row["robot"] for row in rows} == {"ets_vii"}
    assert {row["samples"] for row in rows} == {256}
    assert {row["margin_m"] for row in rows} == {0.005, 0.01, 0.02, 0.03, 0.05, 0.1, 0.2}
    assert {path.name for path in tmp_path.rglob("*.png")} == {
        "workspace.png",
        "slices.png",
        "volumes.png",
        "joint_plane.png",
    }
    told = call(*words, "--no-figures", "seven_joint")
    assert "joint space (%)" in told.stdout
    assert "postures drawn: seven_joint 256" in told.stdout
    assert "1 files in" in told.stdout


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("nothing",), "'nothing' is neither a file nor a robot of the catalogue"),
        (("--samples", 0), "samples is 0"),
        (("--margin", -1), "margin is -1"),
        (("ets_vii_bus",), "'ets_vii_bus' has 0 joints"),
        (("ets_vii", "ets_vii"), "two robots have the same name"),
    ],
)
def test_the_command_refuses(call, tmp_path, words, told):
    done = call("study", "workspace", "-o", tmp_path, *words)
    assert done.returncode == 1
    assert told in done.stderr
    assert not list(tmp_path.iterdir())


def test_the_command_keeps_what_was_done(call, tmp_path, monkeypatch):
    whole = Workspace._draw

    def interrupted(self, *given):
        if self.blocks == 3:
            raise KeyboardInterrupt
        return whole(self, *given)

    monkeypatch.setattr(Workspace, "_draw", interrupted)
    done = call("study", "workspace", "--samples", 256, "--voxel", 1.0, "-o", tmp_path, "--no-figures", "--json")
    assert done.returncode == 130
    assert {row["samples"] for row in json.loads(done.stdout)["rows"]} == {48}
