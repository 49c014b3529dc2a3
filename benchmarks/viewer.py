"""How many frames a second the viewer sends, and a browser draws, of 1500 samples of a spacecraft whose wings bend.

What is drawn depends on the graphics card; without one the browser draws by software, which is the slowest there is.

    python benchmarks/viewer.py
"""

from __future__ import annotations

import dataclasses
import os
import time

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from playwright.sync_api import Browser, sync_playwright

import ssm_decouple as ssm
from ssm_decouple.studies.bending import flexible
from ssm_decouple.viewing.viewer.browser import find_browser
from ssm_decouple.viewing.viewer.live import Live
from ssm_decouple.viewing.viewer.player import Player

FLAGS = ["--no-sandbox", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
SIZES = ((700, 300), (900, 500), (1300, 800))  # of the page, of which the controls take 380 pixels of width
SETTLING, SECONDS = (
    12.0,
    6.0,
)  # where frames come late the page takes some seconds to draw fewer pixels
SPEED = "5 x"  # at which a motion of 150 s outlasts both
DRAGS = 100
COUNT = """seconds => new Promise(done => {
    const start = performance.now();
    let frames = 0;
    const tick = now => {
        frames += 1;
        now - start > 1000 * seconds ? done(1000 * frames / (now - start)) : requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
})"""
CARD = """() => {
    const gl = document.createElement("canvas").getContext("webgl");
    const told = gl.getExtension("WEBGL_debug_renderer_info");
    return gl.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""


def frames(browser: Browser, size: tuple[int, int], player: Player) -> tuple[float, float, str]:
    """Return frames a second, drawn and sent, of a page that is opened, and what draws it."""
    page = browser.new_page(viewport={"width": size[0], "height": size[1]})
    page.goto(player.url)
    page.wait_for_timeout(4000)
    player.seek(0.0)
    page.wait_for_timeout(1e3 * SETTLING)
    before = player.frames
    drawn, card = float(page.evaluate(COUNT, SECONDS)), str(page.evaluate(CARD))
    sent = (player.frames - before) / SECONDS
    page.close()
    return drawn, sent, card


def playback() -> None:
    """Print the frames a second of a recorded motion."""
    case = flexible(ssm.load_case("case1"))
    method = ssm.Dynamic(step=0.01, servo=None)
    motion = dataclasses.replace(case, simulation={**case.simulation, "method": method}).run()
    with ssm.view(motion, port=0) as player, sync_playwright() as running:
        browser = running.chromium.launch(executable_path=str(find_browser()), args=FLAGS)
        player.speed.value = SPEED  # type: ignore[misc]  # viser's setter stands in a class between
        print(f"{motion.sizes['time']} samples, {os.cpu_count()} processors")
        print(f"{'page (pixels)':<16} {'drawn/s':>8} {'sent/s':>8}")
        for size in SIZES:
            drawn, sent, card = frames(browser, size, player)
            print(f"{size[0]:>5} x {size[1]:<8} {drawn:8.1f} {sent:8.1f}")
        print(f"drawn by {card}")
        browser.close()


def dragging() -> None:
    """Print how long the law's answer to a dragged target takes, until its poses are on their way to the browser."""
    rng = np.random.default_rng(0)
    with Live(ssm.load_case("case1"), port=0) as live:
        for _ in range(DRAGS):
            live.drag(live.end_effector + rng.uniform(-0.2, 0.2, 3))
            time.sleep(0.05)
        answers = 1e3 * np.array(live.answers)
    middle, most, last = np.percentile(answers, [50, 95, 100])
    print(f"{len(answers)} drags are answered after {middle:.1f} ms, 95 % within {most:.1f}, all within {last:.1f}")


def main() -> None:
    """Print all."""
    playback()
    dragging()


if __name__ == "__main__":
    main()
