"""Takes the pictures of the viewer that the pages show: `make screenshots`.

A small scene is generated and registered with both presets. Then the recording of one run and the
comparison of both are opened in the native viewer and in a real browser, and each is photographed.
So is, in the native viewer, a run whose data leave directions open. It takes some minutes:
everything is drawn in software.
"""

from __future__ import annotations

import base64
import contextlib
import importlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from depthba.dataset import Dataset
from depthba.errors import MissingPackage, RunError
from depthba.options import Options
from depthba.verbs.register import register_into
from eval import review
from eval.compare import compare_runs

DOCS = Path(__file__).parent
SCENE, START_ERROR = "industrial-6", (0.01, 0.007)
PRESETS = {"paper": Options(preset="paper", resolution=0.05), "default": Options()}
SHOWN = "default"
"""The run that is shown alone."""
OPEN_SCENE = "lab-1"
"""Its start poses are as its robot errs; its plane leaves directions open."""
FRAMES, SIZE = 12, (320, 240)
WIDTH = 1600
LARGEST = 500_000
"""Bytes of a picture: it is made smaller until it fits."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER_SECONDS = 900.0
"""A busy machine draws a minute for one picture."""
SETTLE_SECONDS = 12.0
"""Between two looks at the page; when both are alike all of it has been drawn."""


def main() -> int:
    """Take all pictures; return the exit status."""
    if missing := missing_packages():
        print(f"screenshots: apt-get install {' '.join(missing)}", file=sys.stderr)
        return 1
    with (
        review.terminated_cleanly(),
        tempfile.TemporaryDirectory(prefix="depthba-") as name,
    ):
        folder = Path(name)
        data = generated(SCENE, folder / "data", START_ERROR)
        runs = {preset: registered(data, folder / preset, preset) for preset in PRESETS}
        both = folder / "compare.rrd"
        compare_runs(list(runs.values()), both)
        table = generated(OPEN_SCENE, folder / "table", None)
        shots = {
            "run": runs[SHOWN] / review.RECORDING,
            "compare": both,
            "open": registered(table, folder / "open", SHOWN) / review.RECORDING,
        }
        for what, file in shots.items():
            native = folder / f"{what}.png"
            review.screenshot([file], native)
            save(native.read_bytes(), DOCS / f"review_{what}.png")
            if what != "open":
                save(browser_shot(file), DOCS / f"review_{what}_web.png")
    return 0


def missing_packages() -> list[str]:
    """Return the Debian packages that bring the programs that are not here."""
    missing = []
    if browser() is None:
        missing.append("chromium")
    if shutil.which("Xvfb") is None:
        missing.append("xvfb")
    try:
        review.software_driver()
    except MissingPackage:
        missing.append("mesa-vulkan-drivers")
    if importlib.util.find_spec("websockets") is None:
        missing.append("python3-websockets")
    return missing


def generated(scene: str, path: Path, start_error: tuple[float, float] | None) -> Dataset:
    """Generate a scene; its start poses are off by so much (m, rad), or as its rig errs."""
    sim = importlib.import_module("sim")
    options = sim.GenerateOptions(
        seed=0, frames=FRAMES, size=SIZE, start_error=start_error, rgb=False
    )
    return Dataset.open(sim.generate(scene, path, options))


def registered(dataset: Dataset, path: Path, preset: str) -> Path:
    """Register a dataset, judged and recorded; return the run folder."""
    register_into(dataset, PRESETS[preset], path, evaluate=True)
    return path


def browser() -> str | None:
    """Return the program of a browser that obeys the DevTools protocol."""
    return next((p for name in BROWSERS if (p := shutil.which(name))), None)


def save(png: bytes, path: Path) -> None:
    """Write a picture with a palette, no wider than `WIDTH` and no larger than `LARGEST`."""
    image = Image.open(BytesIO(png)).convert("RGB")
    width = min(WIDTH, image.width)
    while True:
        size = (width, round(image.height * width / image.width))
        small = image.resize(size, Image.Resampling.LANCZOS)
        out = BytesIO()
        small.quantize(256, dither=Image.Dither.NONE).save(out, "PNG", optimize=True)
        if out.tell() <= LARGEST:
            break
        width = int(0.94 * width)
    path.write_bytes(out.getvalue())
    print(f"{path}: {size[0]} x {size[1]}, {out.tell() // 1000} kB")


def browser_shot(file: Path) -> bytes:
    """Return a picture (PNG) of the web viewer with a recording, in a headless browser.

    Raises:
        RunError: the page was not drawn in time.

    """
    page, data = review.free_port(), review.free_port()
    with (
        process([*review.web_command(page, data), str(file)]),
        tempfile.TemporaryDirectory(prefix="depthba-") as profile,
        process(browser_command(Path(profile))),
    ):
        wait_for(f"http://{review.LOCAL}:{page}/")
        with first_tab(Path(profile)) as tab:
            tab.prepare()
            tab.ask("Page.navigate", url=review.page_url(page, data) + "&renderer=webgl")
            deadline = time.monotonic() + BROWSER_SECONDS
            before = np.zeros((0, 0, 3))
            while time.monotonic() < deadline:
                time.sleep(SETTLE_SECONDS)
                png = tab.picture()
                now = np.asarray(Image.open(BytesIO(png)).convert("RGB"), dtype=float)
                same = now.shape == before.shape and np.abs(now - before).mean() < 0.1
                if same and is_drawn(now):
                    return png
                before = now
    raise RunError(f"{file}: the browser had drawn nothing after {BROWSER_SECONDS:.0f} s")


def is_drawn(image: np.ndarray) -> bool:
    """Tell whether a picture of the viewer shows scenes: much of it is colourful."""
    return float(np.mean(image.max(axis=2) - image.min(axis=2) > 40)) > 0.08


def browser_command(profile: Path) -> list[str]:
    """Return the words that start the browser; it listens on this machine alone."""
    program = browser()
    assert program is not None
    width, height = review.WINDOW
    return [
        program,
        "--headless=new",
        "--no-sandbox",  # it opens nothing but our own page, and root cannot have one
        "--no-first-run",
        "--disable-dev-shm-usage",
        "--hide-scrollbars",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        f"--window-size={width},{height}",
        "--remote-debugging-port=0",
        f"--user-data-dir={profile}",
        "about:blank",
    ]


@contextlib.contextmanager
def first_tab(profile: Path) -> Iterator[Tab]:
    """Give the page of the browser that uses this profile, once it is up."""
    from websockets.sync.client import connect

    deadline = time.monotonic() + 60
    file = profile / "DevToolsActivePort"
    while not file.exists() or not file.read_text().strip():
        if time.monotonic() > deadline:
            raise RunError("the browser did not start within 60 s")
        time.sleep(0.2)
    port = int(file.read_text().split()[0])
    with urllib.request.urlopen(f"http://{review.LOCAL}:{port}/json", timeout=30) as answer:
        pages = [t for t in json.load(answer) if t["type"] == "page"]
    url = pages[0]["webSocketDebuggerUrl"]
    with connect(url, max_size=None, open_timeout=60, ping_interval=None) as socket:
        yield Tab(socket)


class Tab:
    """The one page of a browser, spoken to in the DevTools protocol."""

    def __init__(self, socket: Any) -> None:
        """Take a connection to the page."""
        self._socket, self._count = socket, 0

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Return the browser's answer."""
        self._count += 1
        words = {"id": self._count, "method": method, "params": parameters}
        self._socket.send(json.dumps(words))
        while True:
            answer = json.loads(self._socket.recv(timeout=300))
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RunError(f"the browser refuses {method}: {answer['error']}")
                result: dict[str, Any] = answer["result"]
                return result

    def prepare(self) -> None:
        """Make the page as large as the native window, and dark like it."""
        width, height = review.WINDOW
        self.ask("Page.enable")
        self.ask(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip
        dark = {"name": "prefers-color-scheme", "value": "dark"}
        self.ask("Emulation.setEmulatedMedia", features=[dark])

    def picture(self) -> bytes:
        """Return the page as PNG, at the window's size."""
        return base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])


@contextlib.contextmanager
def process(command: list[str]) -> Iterator[None]:
    """Run a program in the background and end it afterwards."""
    quiet = subprocess.DEVNULL
    environment = {"RUST_LOG": "error", **os.environ}
    started = subprocess.Popen(command, stdout=quiet, stderr=quiet, env=environment)
    try:
        yield
    finally:
        review.end(started)


def wait_for(url: str) -> None:
    """Wait until a page is served."""
    deadline = time.monotonic() + 60
    while True:
        try:
            with urllib.request.urlopen(url, timeout=5):
                return
        except OSError:
            if time.monotonic() > deadline:
                raise RunError(f"{url}: not served within 60 s") from None
            time.sleep(0.2)


if __name__ == "__main__":
    sys.exit(main())
