"""Take the picture of docs/viewer.md: case 1 under three laws at 20 s, in a browser without a window.

python docs/viewer_picture.py
"""

from __future__ import annotations

from pathlib import Path

from playwright.sync_api import sync_playwright

import ssm_decouple as ssm
from ssm_decouple.viewing.viewer.browser import find_browser

IMAGES = Path(__file__).parent / "images"


def main() -> None:
    """Open the page, wait until it is drawn, keep the picture."""
    motions = ssm.compare(ssm.load_case("case1")).motions
    shown = {law: motions[law] for law in ("none", "selective", "reactionless")}
    flags = ["--no-sandbox", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with ssm.view(shown, port=0, playing=False) as player, sync_playwright() as running:
        browser = running.chromium.launch(executable_path=str(find_browser()), args=flags)
        page = browser.new_page(viewport={"width": 1152, "height": 720})
        page.goto(player.url)
        page.wait_for_timeout(15_000)
        player.seek(20.0)
        page.wait_for_timeout(15_000)
        for notice in page.locator(".mantine-Notification-closeButton").all():  # of drawing without a graphics card
            notice.click()
        page.wait_for_timeout(3_000)
        page.screenshot(path=IMAGES / "viewer.png")
        browser.close()


if __name__ == "__main__":
    main()
