"""Write the pictures of `acwm play`, play.webp and play.png: `python docs/record_play.py`.

In the animation the behaviour policy of push_cube acts in slow motion, so that every frame can be
captured, and the animation plays them at normal speed. The still shows push_rope. Needs Chromium,
and Playwright from the extra `dev`.
"""

import contextlib
import io
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

DOCS = Path(__file__).resolve().parent
LARGEST = 1_500_000  # bytes
SECONDS, FPS, QUALITY = 6.4, 10, 60  # simulated seconds, frames per second, WebP quality
WIDTH, HEIGHT = 960, 900
STILL = {"width": 1340, "height": 744}
ALONE = "() => document.body.dataset.alone || 0"
"""Free-running time of the model, in simulated seconds."""

CANVASES = "() => [...document.querySelectorAll('canvas')].map((each) => each.toDataURL()).join()"
FLAGS = ["--no-sandbox", "--disable-gpu"]


def main() -> None:
    """Write both pictures."""
    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or playwright.chromium.executable_path
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS)
        with served("push_rope") as address:
            picture = still(browser, address)
        with served("push_cube") as address:
            first, *others = animation(browser, address)
        browser.close()
    picture.quantize(256).save(DOCS / "play.png", optimize=True)
    first.save(
        DOCS / "play.webp", save_all=True, append_images=others, duration=1000 // FPS, loop=0,
        quality=QUALITY, method=6,
    )  # fmt: skip
    size = (DOCS / "play.webp").stat().st_size
    print(f"play.webp: {1 + len(others)} pictures, {size / 1e6:.2f} MB")
    if size > LARGEST:
        sys.exit(f"that is more than {LARGEST / 1e6} MB: lower QUALITY or SECONDS")


@contextlib.contextmanager
def served(world: str) -> Iterator[str]:
    """The address of `acwm play WORLD` while it runs."""
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "acwm_core.cli", "play", world, "--no-browser"]
        words += ["--port", "8427", "--out", folder]
        server = subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        try:
            assert server.stdout is not None
            yield next(
                found[0] for line in server.stdout if (found := re.search(r"http://\S+", line))
            )
        finally:
            server.terminate()
            server.wait()


def opened(browser: Browser, address: str, width: int, height: int) -> Page:
    """The page once the model predicts, with the behaviour policy acting."""
    page = browser.new_page(viewport={"width": width, "height": height}, color_scheme="light")
    page.goto(address)
    page.wait_for_function("() => Number(document.body.dataset.alone) > 0", polling=50)
    page.keyboard.press("p")
    return page


def shot(page: Page, **options: object) -> Image.Image:
    """A screenshot of the page."""
    taken = page.screenshot(**options)  # pyright: ignore[reportArgumentType]
    return Image.open(io.BytesIO(taken), formats=("PNG",)).convert("RGB")


def still(browser: Browser, address: str) -> Image.Image:
    """The page after six seconds of a scene."""
    page = opened(browser, address, **STILL)
    page.keyboard.press("b")  # the same scene from its start
    page.wait_for_function("() => Number(document.body.dataset.alone) < 1", polling=50)
    page.wait_for_function("() => Number(document.body.dataset.alone) >= 6", polling=50)
    picture = shot(page)
    page.close()
    return picture


def animation(browser: Browser, address: str) -> list[Image.Image]:
    """A screenshot of the page for every frame of the environment."""
    page = opened(browser, address, WIDTH, HEIGHT)
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
            pictures.append(shot(page, clip=shown))
        before = now
    page.close()
    return pictures


if __name__ == "__main__":
    main()
