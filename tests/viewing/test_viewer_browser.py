"""The viewer in a browser: Chromium by Playwright, without a window, drawing by software.

Pictures of the pages are left in results/screenshots for people to look at.
"""

from __future__ import annotations

import dataclasses
import io
import shutil
import time
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

import ssm_decouple as ssm
from ssm_decouple.viewing.viewer import export, scenes_of
from ssm_decouple.viewing.viewer.live import Live

SCREENSHOTS = Path(__file__).parents[2] / "results" / "screenshots"
PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
PATIENCE = 90e3  # ms: software draws slowly where the machine is busy
GOLD = (0.80, 0.62, 0.22)  # the bus

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="needs a browser: apt install chromium")


@pytest.fixture(scope="module")
def chromium():
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as running:
        browser = running.chromium.launch(executable_path=PROGRAM, args=flags)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def motion():
    return dataclasses.replace(ssm.load_case("case1"), duration=40.0, dt=0.2).run()


@pytest.fixture
def visit(chromium):
    """Open a page and keep its complaints."""
    pages = []

    def visitor(url, size=(680, 340), offline=False):
        context = chromium.new_context(viewport={"width": size[0], "height": size[1]}, offline=offline)
        page = context.new_page()
        page.set_default_timeout(PATIENCE)
        page.complaints = []
        page.asked_for = []
        page.on("console", lambda said: page.complaints.append(said.text) if said.type == "error" else None)
        page.on("pageerror", lambda error: page.complaints.append(str(error)))
        page.on("request", lambda request: page.asked_for.append(request.url))
        page.goto(url)
        pages.append(context)
        return page

    yield visitor
    for context in pages:
        context.close()


def until(page, reached, what):
    """Wait, with the page alive where there is one, until something is so."""
    end = time.monotonic() + PATIENCE / 1e3
    while not reached():
        assert time.monotonic() < end, f"waited in vain for {what}"
        if page is None:
            time.sleep(0.15)
        else:
            page.wait_for_timeout(150)


def nodes(page):
    """Return the names of what the page's scene tree holds, by kind."""
    found = page.evaluate(
        "Object.entries(window.__viserSceneTree?.getState() ?? {}).map(([k, v]) => [k, v?.message?.type ?? ''])"
    )
    return dict(found)


def pixels(page, name=None):
    """Return the picture of the page (h, w, 3), and leave it for people."""
    raw = page.screenshot()
    if name is not None:
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        (SCREENSHOTS / f"{name}.png").write_bytes(raw)
    return np.asarray(Image.open(io.BytesIO(raw)).convert("RGB"), dtype=float)


def gold(picture):
    """Return how many pixels have the hue of the bus."""
    red, green, blue = np.moveaxis(picture, -1, 0)
    return int(np.sum((red > 90) & (red > green) & (green > 1.3 * blue)))


def test_a_motion_plays_and_is_scrubbed(visit, motion):
    with ssm.view(motion, port=0, playing=False) as player:
        page = visit(player.url)
        until(page, player.server.get_clients, "the page")
        shapes = [part.name for part in player.scenes[0].parts]
        until(page, lambda: all(any(f"/{shape}_" in name for name in nodes(page)) for shape in shapes), "the shapes")
        kinds = list(nodes(page).values())
        assert {kind: kinds.count(kind) for kind in ("BoxMessage", "CylinderMessage")} == {
            "BoxMessage": sum(part.kind == "box" for part in player.scenes[0].parts),
            "CylinderMessage": sum(part.kind == "cylinder" for part in player.scenes[0].parts),
        }
        until(page, lambda: gold(pixels(page, "motion_start")) > 500, "the bus")
        drawn = player.frames
        page.get_by_role("button", name="play").click()
        until(page, lambda: player.playing and player.time > 2.0, "the clock")
        assert player.frames > drawn
        page.get_by_role("button", name="pause").click()
        until(page, lambda: not player.playing, "the end of playing")

        field = page.get_by_role("textbox").first  # the number beside the slider
        field.fill("25")
        field.press("Enter")
        until(page, lambda: abs(player.time - 25.0) < 0.05, "the scrub bar")
        until(page, lambda: "t = 25.0 s" in page.content(), "the numbers")
        q = motion.configuration.values[np.searchsorted(motion.time.values, 25.0)]
        expected = player.scenes[0].robot.frame_pose(q, "joint_6").translation
        wrist = player.stage.actors[0].bodies[-1].name
        seen = "n => window.__viserMutable.nodePoseData[n]?.position"
        until(page, lambda: np.allclose(page.evaluate(seen, wrist), expected, atol=2e-3), "the arm")
        pixels(page, "motion_25_s")
        assert page.complaints == []


def test_the_target_is_dragged_by_the_mouse(visit):
    with Live(ssm.load_case("case1"), port=0) as live:
        page = visit(live.url, size=(940, 520))  # so large that no notice of the page covers the handle
        until(page, live.server.get_clients, "the page")
        until(page, lambda: gold(pixels(page)) > 1000, "the bus")
        client = next(iter(live.server.get_clients().values()))
        before, arm = np.array(live.target), live.q[7:].copy()
        answered = len(live.answers)
        tip = before + np.array([0.0, 0.0, 0.75 * live.handle.scale])
        start, end = on_screen(page, client.camera, tip), on_screen(page, client.camera, tip + [0.0, 0.0, 0.3])
        page.mouse.move(*start)
        page.wait_for_timeout(300)
        page.mouse.down()
        for share in np.linspace(0.0, 1.0, 6):
            page.mouse.move(*(start + share * (end - start)))
            page.wait_for_timeout(60)
        page.mouse.up()
        until(page, lambda: live.target[2] > before[2] + 0.05, "the target")
        np.testing.assert_allclose(live.target[:2], before[:2], atol=1e-6)  # it moves along its arrow
        until(page, lambda: len(live.answers) > answered, "an answer")
        until(page, lambda: np.abs(live.q[7:] - arm).max() > 1e-3, "the arm")
        page.get_by_role("combobox").first.click()
        page.get_by_role("option", name="all rotation").click()
        until(page, lambda: live.chosen == "all rotation", "the protection")
        until(page, lambda: "all rotation" in page.content(), "the page's answer")
        axes = page.get_by_role("textbox").first
        for written, told in (("0.6,0", "it needs"), ("0.6,0,0.8", None)):
            axes.fill(written)
            until(page, lambda written=written: live.own.value == written, "the axes")
            page.get_by_role("button", name="protect own axes").click()
            if told is not None:
                until(page, lambda told=told: "not protected" in page.content() and told in page.content(), "a refusal")
        until(page, lambda: live.chosen == "0.6,0,0.8", "the own axes")
        pixels(page, "live")
        assert page.complaints == []
        page.close()
        until(None, lambda: not live.server.get_clients(), "the end of the page")
        clock = live.clock
        until(None, lambda: live.clock > clock + 1.0, "the law, which goes on without a page")
        with urlopen(live.url) as answer:
            assert answer.status == 200


def on_screen(page, camera, point):
    """Return where a point (3,) is on the page, pixels."""
    box = page.locator("canvas").first.bounding_box()
    turn = Rotation.from_quat(np.asarray(camera.wxyz)[[1, 2, 3, 0]]).as_matrix()
    x, y, z = (np.asarray(point) - camera.position) @ turn
    focal = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
    return np.array([box["x"] + 0.5 * box["width"] + focal * x / z, box["y"] + 0.5 * box["height"] + focal * y / z])


def test_the_exported_page_plays_without_server_and_network(visit, motion, tmp_path):
    path = export.write_html(scenes_of({"selective": motion}), tmp_path / "motion.html", speed=20.0)
    page = visit(path.as_uri(), size=(400, 280), offline=True)
    page.wait_for_selector("#summary")
    assert "selective" in page.inner_text("#summary")
    until(page, lambda: gold(pixels(page, "exported")) > 400, "the bus")
    assert [url for url in page.asked_for if not url.startswith(("file:", "data:", "blob:"))] == []
    assert page.complaints == []


def test_pictures_come_without_a_window_and_show_their_time(motion):
    with export._camera(scenes_of({"selective": motion}), (360, 220), True, None, PROGRAM) as picture:
        first, later, again = (picture(now) for now in (0.0, 40.0, 0.0))
    assert first.size == (360, 220)
    assert gold(np.asarray(first, dtype=float)) > 400
    left, middle = (0, 40, 110, 220), (110, 40, 360, 220)  # the numbers, the spacecraft
    for box in (left, middle):
        assert np.array_equal(first.crop(box), again.crop(box))
        assert not np.array_equal(first.crop(box), later.crop(box))
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    later.save(SCREENSHOTS / "picture.png")
