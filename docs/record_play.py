"""Write play.webp, the animation of `acwm play push_cube`: `python docs/record_play.py`.

The behaviour policy acts in slow motion, so that every frame can be captured; the animation plays
them at normal speed. Needs Chromium, and Playwright from the extra `dev`.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

OUT = Path(__file__).resolve().parent / "play.webp"
LARGEST = 1_500_000  # bytes
SECONDS, FPS, QUALITY = 6.4, 10, 60  # simulated seconds, frames per second, WebP quality
WIDTH, HEIGHT = 960, 900
ALONE = "() => document.body.dataset.alone || 0"
"""How long the model has predicted on its own, in simulated seconds."""

CANVASES = "() => [...document.querySelectorAll('canvas')].map((each) => each.toDataURL()).join()"
FLAGS = ["--no-sandbox", "--disable-gpu"]


def main() -> None:
    """Serve the page, capture it and write the animation."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "acwm_core.cli", "play", "push_cube", "--no-browser"]
        words += ["--port", "8427", "--out", folder]
        server = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            assert server.stdout is not None
            address = next(
                found[0] for line in server.stdout if (found := re.search(r"http://\S+", line))
            )
            pictures = photograph(address)
        finally:
            server.terminate()
            server.wait()
    first, *others = pictures
    first.save(
        OUT, save_all=True, append_images=others, duration=1000 // FPS, loop=0,
        quality=QUALITY, method=6,
    )  # fmt: skip
    size = OUT.stat().st_size
    print(f"{OUT.name}: {len(pictures)} pictures, {size / 1e6:.2f} MB")
    if size > LARGEST:
        sys.exit(f"that is more than {LARGEST / 1e6} MB: lower QUALITY or SECONDS")


def photograph(address: str) -> list[Image.Image]:
    """Take a screenshot of the page for every frame of the environment."""
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or playwright.chromium.executable_path
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
        page.goto(address)
        page.wait_for_function("() => Number(document.body.dataset.alone) > 0", polling=50)
        page.keyboard.press("p")  # the policy acts
        page.locator("input[name=speed][value='0.25']").check(force=True)
        page.keyboard.press("b")  # the same scene from its start
        page.evaluate("() => { document.body.dataset.alone = 0; scrollTo(0, 0) }")
        # Hide the speed of the page, which means nothing in slow motion.
        page.evaluate("() => { document.getElementById('link').style.visibility = 'hidden' }")
        tiles = page.locator("#tiles").bounding_box()
        assert tiles is not None
        bottom = tiles["y"] + tiles["height"] + 10
        shown = {"x": 0, "y": 0, "width": WIDTH, "height": bottom}
        pictures: list[Image.Image] = []
        before = ""
        while float(page.evaluate(ALONE)) < SECONDS:
            now = page.evaluate(CANVASES)
            if now != before:
                taken = page.screenshot(clip=shown)  # pyright: ignore[reportArgumentType]
                picture = Image.open(io.BytesIO(taken), formats=("PNG",))
                pictures.append(picture.convert("RGB"))
            before = now
        browser.close()
    return pictures


if __name__ == "__main__":
    main()
