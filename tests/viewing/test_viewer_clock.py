"""The clock of a page goes on, whatever an input, a law or a tick does; the page says what is wrong until it is not."""

from __future__ import annotations

import time

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import viser
from websockets.sync.client import connect

import ssm_decouple as ssm
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.viewing.viewer.live import Live

PATIENCE = 20.0  # s
NOWHERE = [float("nan"), float("inf"), -1e308, 1e300]
WRONG = {float: NOWHERE, str: ["", "nan x", "0,0,0", "nan,0,1", "1,0,0@nowhere", "sideways", "1e999 x", "\0"]}


def until(reached, what):
    end = time.monotonic() + PATIENCE
    while not reached():
        assert time.monotonic() < end, f"waited in vain for {what}"
        time.sleep(0.02)


class Visitor:
    """What a browser does, without one: it connects and sends the messages of inputs."""

    def __init__(self, page):
        self.page, port = page, page.server.get_port()
        self.line = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[f"viser-v{viser.__version__}"], max_size=None, close_timeout=0.2
        )
        before = set(page.server.get_clients())
        self.look()
        until(lambda: set(page.server.get_clients()) - before, "the visitor")
        (number,) = set(page.server.get_clients()) - before
        self.notices, client = [], page.server.get_clients()[number]
        client.add_notification = lambda title, body, **_: self.notices.append((title, body))

    def send(self, kind, **fields):
        self.line.send(msgspec.msgpack.encode({"type": kind, **fields}))

    def look(self, number=1.0, pixels=100):
        places = {"position": [3.0, number, 2.0], "look_at": [0.0] * 3, "up_direction": [0.0, 0.0, number]}
        sizes = {"fov": number, "near": number, "far": number, "image_height": pixels, "image_width": pixels}
        self.send("ViewerCameraMessage", wxyz=[number] * 4, **places, **sizes)

    def put(self, handle, value):
        self.send("GuiUpdateMessage", uuid=handle._impl.uuid, updates={"value": value})

    def drag(self, position, wxyz=(1.0, 0.0, 0.0, 0.0)):
        self.send("TransformControlsUpdateMessage", name="/target", position=[*map(float, position)], wxyz=[*wxyz])


@pytest.fixture
def visit():
    lines = []

    def visitor(page):
        lines.append(Visitor(page))
        return lines[-1]

    yield visitor
    for each in lines:
        each.line.close()


@pytest.fixture
def live():
    with Live(ssm.load_case("case1"), port=0) as page:
        yield page


def goes_on(page, frames=3):
    drawn = page.frames
    until(lambda: page.frames > drawn + frames, "frames")
    assert page._thread.is_alive()


def test_no_input_of_the_live_page_stops_its_clock(live, visit, capfd):
    visitor = visit(live)
    inputs = [handle for handle in live.server.gui._gui_input_handle_from_uuid.values() if not handle._impl.is_button]
    assert len(inputs) == 3  # the protection, the own axes, the speed
    buttons = [handle for handle in live.server.gui._gui_input_handle_from_uuid.values() if handle._impl.is_button]
    own = next(button for button in buttons if button.label == "protect own axes")
    for number in NOWHERE[:2]:
        visitor.look(number)
    visitor.look(pixels=0)
    for handle in inputs:
        for value in WRONG[type(handle._impl.value)]:
            visitor.put(handle, value)
            visitor.put(own, True)
    target = live.target.copy()
    for number in NOWHERE[:2]:
        refused = sum("needs 3 finite" in body for _, body in visitor.notices)
        visitor.drag([number, 0.0, 0.0])
        until(lambda n=refused: sum("needs 3 finite" in body for _, body in visitor.notices) > n, "a refusal")
        np.testing.assert_array_equal(live.target, target)
        visitor.drag(target, [number] * 4)  # of no account where only a position is asked for
    goes_on(live)
    until(lambda: np.allclose(live.target, target), "the last target")
    until(lambda: len(visitor.notices) > 15, "notices")
    assert any(title == "not protected" for title, _ in visitor.notices)
    assert not any("Traceback" in body or "\n" in body for _, body in visitor.notices)
    assert np.all(np.isfinite(live.q))
    until(lambda: not live.trouble.visible, "the end of trouble")
    # Good inputs are heeded as before.
    visitor.put(live.speed, "20 x")
    visitor.put(live.protection, "all rotation")
    visitor.drag(target + [0.0, 0.1, 0.0])
    until(lambda: live.pace == 20.0 and live.chosen == "all rotation" and live.target[1] > target[1] + 0.05, "inputs")
    clock = live.clock
    until(lambda: live.clock > clock + 1.0, "the clock")
    assert "Traceback" not in capfd.readouterr().err


def test_a_target_beyond_all_reach_is_followed_or_refused(live, visit):
    visitor = visit(live)
    with pytest.warns(ssm.DecoupleWarning, match="looks like degrees"):
        law = SelectiveLaw(live.robot, ssm.Protection("none"), gain=0.05, rate_limit=np.full(6, 1e300))
    live.laws["none"] = law
    live.protect("none")
    start = live.target.copy()
    for far in (1e3, 1e6, 9e8):
        visitor.drag([far, -far, far])
        until(lambda far=far: live.target[0] == far, "the target")
        goes_on(live)
        assert np.all(np.isfinite(live.q))
    with pytest.raises(ssm.InputError, match=r"1e\+300 m away; 1e\+09 m is the farthest"):
        live.drag([0.0, 1e300, 0.0])
    visitor.drag(start)
    until(lambda: live.target[0] == start[0], "the target")
    goes_on(live)
    assert not live.trouble.visible


class Failing(SelectiveLaw):
    """A law that does as it is told."""

    error: object = None
    _assignable = (*SelectiveLaw._assignable, "error")

    def evaluate(self, q, target, velocity, out, *rest, **named):
        said = super().evaluate(q, target, velocity, out, *rest, **named)
        if isinstance(self.error, float):
            out[:] = self.error
        elif self.error is not None:
            raise self.error
        return said


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (float("nan"), "no joint rates for this target"),
        (float("inf"), "no joint rates for this target"),
        (1e200, "no joint rates for this target"),
        (ssm.InputError("q is beside itself"), "q is beside itself"),
        (np.linalg.LinAlgError("Singular matrix"), "LinAlgError: Singular matrix"),
        (ZeroDivisionError("one\nand two"), "ZeroDivisionError: one and two"),
        (RecursionError(), "RecursionError: no more is known"),
        (ValueError("<b>bold</b>"), "ValueError: &lt;b&gt;bold&lt;/b&gt;"),
    ],
)
@pytest.mark.parametrize("sample_time", [None, 0.1])
def test_a_law_that_cannot_be_asked_makes_the_arm_stand_and_is_told(live, visit, error, told, sample_time):
    visitor = visit(live)
    law = Failing(live.robot, ssm.Protection("yaw"), gain=0.05, rate_limit=0.1, sample_time=sample_time)
    live.laws["yaw"] = law
    visitor.put(live.protection, "yaw")
    until(lambda: live.chosen == "yaw", "the law")
    goes_on(live)
    law.error = error
    until(lambda: told in live.trouble.content and live.trouble.visible, "the page's words")
    before = live.q.copy()
    goes_on(live)
    np.testing.assert_array_equal(live.q, before)
    assert live.trouble.visible  # not now and then: all the time
    assert live.numbers()["rate"] is not None
    late = visit(live)  # who comes now is told, too: the words are part of the page
    assert late.page.trouble.visible
    law.error = None
    until(lambda: not live.trouble.visible, "recovery")
    until(lambda: not np.array_equal(live.q, before), "the arm")


def test_a_tick_that_fails_is_told_and_the_next_goes_on(live, monkeypatch):
    draw = live._draw

    def failing():
        raise AssertionError

    monkeypatch.setattr(live, "_draw", failing)
    until(lambda: "AssertionError: no more is known" in live.trouble.content, "the page's words")
    monkeypatch.setattr(live, "_draw", draw)
    until(lambda: not live.trouble.visible, "recovery")
    goes_on(live)


def test_targets_and_orientations_that_are_none_are_refused_at_the_door():
    case = ssm.load_case("case1")
    with Live(case, port=0) as live:
        before = live.target.copy()
        for wrong in ([np.nan, 0, 0], [0, np.inf, 0], [0, 0], "here", None, [[0, 0, 0]]):
            with pytest.raises(ssm.InputError, match=r"position of the target .* needs 3 finite numbers"):
                live.drag(wrong)
        np.testing.assert_array_equal(live.target, before)
        live.posed, live.target = True, pin.SE3(np.eye(3), before)  # as with a pose to reach
        live._over.set()
        for wrong in ([np.nan] * 4, [1, 0, 0], [np.inf, 0, 0, 0]):
            with pytest.raises(ssm.InputError, match=r"orientation of the target .* needs 4 finite numbers"):
                live.drag(before, wrong)
        with pytest.raises(ssm.InputError, match="a quaternion w x y z is no zero"):
            live.drag(before, [0, 0, 0, 0])
        live.drag(before, [2.0, 0, 0, 2.0])
        np.testing.assert_allclose(live.target.rotation @ [1, 0, 0], [0, 1, 0], atol=1e-12)


def test_no_input_of_the_player_stops_its_clock(visit, capfd):
    robot = ssm.load_robot("ets_vii_flexible")
    law = ssm.SelectiveLaw(robot, ssm.Protection("none"), rate_limit=np.deg2rad(5.0))
    q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
    motion = ssm.simulate(law, q, [0.5, 0.2, 2.0], 3.0, 0.1, ssm.Dynamic(step=0.02))
    with ssm.view({"one": motion, "two": motion}, port=0) as player:
        visitor = visit(player)
        inputs = [h for h in player.server.gui._gui_input_handle_from_uuid.values() if not h._impl.is_button]
        assert {type(handle._impl.value) for handle in inputs} == {float, str, bool}
        for handle in inputs:
            for value in WRONG.get(type(handle._impl.value), []):
                visitor.put(handle, value)
        until(lambda: len(visitor.notices) > 20, "notices")
        assert not any("Traceback" in body or "\n" in body for _, body in visitor.notices)
        visitor.put(player.speed, "1 x")
        visitor.put(player.slider, 1.0)
        until(lambda: player.time == 1.0 and player.pace == 1.0, "good inputs")
        player.play()
        goes_on(player)
        assert not player.trouble.visible
        with pytest.raises(ssm.InputError, match="time to show is not a number"):
            player.seek(float("nan"))
        player.seek(float("inf"))
        assert player.time == player.end
    assert "Traceback" not in capfd.readouterr().err


def test_live_w_sub_is_the_law_s_own_in_every_frame(ets_vii, rng):
    """The rate that the page tells is the law's about U_c, in the axes of the base, of space and of any link."""
    case = ssm.load_case("case1")
    with Live(case, port=0) as live:
        live._over.set()
        live._wake.set()
        live._thread.join()
        links = [name for name in ets_vii.link_names if name != ets_vii.link_names[0]][::2]
        twists = np.linalg.qr(rng.normal(size=(6, 2)))[0]
        for frame in ("base", "inertial", *links):
            for axes in ([0.6, 0.0, 0.8], np.eye(3)[:, :2], twists):
                protection = ssm.Protection(axes, frame)
                law = SelectiveLaw(live.robot, protection, gain=0.05, rate_limit=0.1)
                other = SelectiveLaw(live.robot, ssm.Protection("none"), gain=0.05, rate_limit=0.1)
                live.laws, live.chosen = {"the case's own": law, "none": other}, "the case's own"
                live.q = pin.randomConfiguration(live.robot.model, -np.ones(13), np.ones(13))
                live._ask()
                assert np.abs(live._own_rate()).max() < 1e-15
                assert live.past.rate[-1] < 1e-15
                live.chosen = "none"
                live._ask()
                # What the momentum module says of the same joint rates, by another way.
                expected = protection.J_sub(live.robot.coupling(live.q)) @ live.values[6:12]
                np.testing.assert_allclose(live._own_rate(), expected, rtol=1e-9, atol=1e-15)
                assert live.past.rate[-1] == pytest.approx(np.abs(expected).max())
                assert live.past.rate[-1] > 1e-6
