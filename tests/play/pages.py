"""The page before a real server in a process of its own, and what a browser shows of it."""

import base64
import io
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from PIL import Image

from tests.folders import wait_until

ROOT = Path(__file__).parents[2]


class Served:
    """The server, which can be killed and started again."""

    def __init__(self, run, folder):
        self.out = folder / "out"
        self._run, self._folder = run, folder
        self._port = 0  # any free one, which the server tells

    def start(self):
        words = ["-m", "tests.play.serving", self._run, self.out, self._port]
        log = self._folder / f"log-{time.monotonic_ns()}"
        with log.open("w") as file:
            self._process = subprocess.Popen(
                [sys.executable, *map(str, words)],
                cwd=ROOT,
                env={**os.environ, "ACWM_CACHE": str(self._folder / "cache")},
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        wait_until(lambda: "playing at" in log.read_text(), self._process)
        self.url = re.search(r"http://\S+", log.read_text())[0]
        self._port = urlsplit(self.url).port  # to which open pages come back

    def kill(self):
        self._process.kill()
        self._process.wait()


def until(page, condition, seconds=300):
    """Wait for what a script says; Playwright's own way would need the page to allow eval."""
    deadline = time.monotonic() + seconds
    while not page.evaluate(f"() => {condition}"):
        assert time.monotonic() < deadline, (condition, page.inner_text("body"))
        page.wait_for_timeout(50)


def shown(page, canvas):
    """The pixels of a canvas, `[H, W, 3]`."""
    data = page.evaluate(f"() => document.getElementById('{canvas}').toDataURL()")
    return np.array(Image.open(io.BytesIO(base64.b64decode(data.partition(",")[2]))).convert("RGB"))


def seen(page, condition, seconds=300):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, page.inner_text("body")
        page.wait_for_timeout(50)
