"""Shows recordings: in the Rerun viewer, in a browser, or as a picture without any screen.

The viewer is started as a process of its own, bound to this machine: the SDK's own servers
listen on every network, and cannot be told otherwise.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from depthba import durable
from depthba.errors import MissingPackage, RunError
from depthba.run_folder import LATEST, LOGS

RECORDING = "run.rrd"
LOCAL = "127.0.0.1"
WINDOW = (1600, 900)
SCREENSHOT_SECONDS = 240
"""A software renderer on a busy machine needs a minute."""
SOFTWARE_DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")


def recordings(
    runs: Sequence[Path], rebuild: bool = False, dataset: Path | None = None
) -> list[Path]:
    """Return the recordings of run folders; without any, of the newest run in logs/.

    Args:
        runs: run folders, or recordings themselves.
        rebuild: whether to make the recordings of folders anew, from their plain files; where
            there is none, one is made in any case.
        dataset: where the dataset is now, if not where the runs were made.

    Raises:
        RunError: a folder is missing, or is not the whole folder of a run that a recording could
            be made of.

    """
    if not runs:
        latest = LOGS / LATEST
        if not latest.is_dir():
            raise RunError(f"{latest}: no run there yet; name a run folder")
        runs = [latest]
    found = []
    for run in runs:
        if not run.exists():
            raise RunError(f"{run}: no such run folder")
        file = run if run.is_file() else run / RECORDING
        if run.is_dir() and (rebuild or not file.is_file()):
            from eval.rebuild import rebuild as make  # which needs this module

            make(run, dataset)
        found.append(file.resolve())
    return found


def viewer() -> Path:
    """Return the viewer's program, the binary itself, so that it ends when it is told to.

    Raises:
        MissingPackage: rerun-sdk is not installed.

    """
    try:
        import rerun_cli  # type: ignore[import-untyped]
    except ImportError:
        raise MissingPackage("rerun-sdk is not installed: pip install 'depthba[eval]'") from None
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    return Path(str(rerun_cli.__file__)).parent / name


def show(files: Sequence[Path]) -> None:
    """Open recordings in the viewer; return when it is closed.

    Raises:
        RunError: there is no screen, or the viewer failed.

    """
    need_screen("--web or --screenshot FILE.png")
    _run([*_command(), *map(str, files)])


def need_screen(instead: str) -> None:
    """Raise RunError where no window can be opened, and say what to use instead."""
    on_screen = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform.startswith("linux") and not on_screen:
        raise RunError(f"no screen here (DISPLAY is not set): use {instead}")


def serve(files: Sequence[Path], port: int | None = None) -> None:
    """Serve recordings to a browser on this machine alone; return when interrupted.

    Args:
        files: the recordings.
        port: where the page is served; None takes a free one.

    """
    page, data = port or free_port(), free_port()
    print(f"{page_url(page, data)}\nCtrl-C ends it.", file=sys.stderr, flush=True)
    _run([*web_command(page, data), *map(str, files)])


def page_url(page: int, data: int) -> str:
    """Return the address of the web viewer at port ``page`` with what is served at ``data``."""
    return f"http://{LOCAL}:{page}?url=rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{data}%2Fproxy"


def web_command(page: int, data: int) -> list[str]:
    """Return the words that serve the web viewer, on this machine alone."""
    ports = ["--serve-web", "--web-viewer-port", str(page), "--port", str(data)]
    return [str(viewer()), "--bind", LOCAL, *ports]


def screenshot(files: Sequence[Path], picture: Path) -> None:
    """Write a picture of the viewer with these recordings, drawn in software without a screen.

    Raises:
        MissingPackage: Xvfb or the software renderer is not installed.
        RunError: the viewer left no picture.

    """
    driver = software_driver()
    with tempfile.TemporaryDirectory(prefix="depthba-") as folder, _screen() as display:
        shot = Path(folder) / "screenshot.png"
        environment = {
            **os.environ,
            "DISPLAY": display,
            "VK_DRIVER_FILES": str(driver),
            "XDG_RUNTIME_DIR": folder,
        }
        environment.pop("WAYLAND_DISPLAY", None)
        size = f"{WINDOW[0]}x{WINDOW[1]}"
        words = [*_command(), "--window-size", size, "--screenshot-to", str(shot)]
        try:
            done = subprocess.run(
                [*words, *map(str, files)],
                env=environment,
                capture_output=True,
                text=True,
                timeout=SCREENSHOT_SECONDS,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise RunError(
                f"{picture}: the viewer took more than {SCREENSHOT_SECONDS} s, no picture"
            ) from None
        if not shot.is_file():
            told = done.stderr.strip().splitlines() or ["it said nothing"]
            raise RunError(f"{picture}: the viewer left no picture: {told[-1]}")
        picture.parent.mkdir(parents=True, exist_ok=True)
        durable.write_bytes(picture, shot.read_bytes())


def free_port() -> int:
    """Return a port of this machine that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return int(probe.getsockname()[1])


def _command() -> list[str]:
    return [str(viewer()), "--port", "auto", "--bind", LOCAL]


def _run(command: Sequence[str]) -> None:
    """Run the viewer until it ends, the user interrupts or somebody ends this process."""
    with terminated_cleanly():
        process = subprocess.Popen(command, env={"RUST_LOG": "warn", **os.environ})
        try:
            status = process.wait()
        except KeyboardInterrupt:
            return
        finally:
            end(process)
    if status:
        raise RunError(f"{command[0]}: the viewer ended with status {status}")


@contextlib.contextmanager
def terminated_cleanly() -> Iterator[None]:
    """Within, a signal to terminate leaves through all that cleans up, so no viewer is orphaned."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals are the main thread's
        return

    def leave(number: int, _: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def end(process: subprocess.Popen[bytes]) -> None:
    """End a process that we started, gently first."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(timeout=5)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def software_driver() -> Path:
    """Return the description of Mesa's software renderer for Vulkan."""
    for folder in SOFTWARE_DRIVERS:
        for file in sorted(Path(folder).glob("lvp_icd*.json")):
            return file
    raise MissingPackage(
        "no software renderer for Vulkan (lvp_icd*.json): apt-get install mesa-vulkan-drivers"
    )


@contextlib.contextmanager
def _screen() -> Iterator[str]:
    """Give the name of a virtual screen, so large that its pointer rests beside the window.

    The pointer rests in the middle, and the viewer draws a screenshot at twice its size.
    """
    program = shutil.which("Xvfb")
    if program is None:
        raise MissingPackage("Xvfb is not installed: apt-get install xvfb")
    read, write = os.pipe()
    size = f"{4 * WINDOW[0] + 200}x{4 * WINDOW[1] + 200}x24"
    try:
        process = subprocess.Popen(
            [program, "-displayfd", str(write), "-screen", "0", size, "-noreset"],
            pass_fds=[write],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
    finally:
        os.close(write)
    try:
        with os.fdopen(read) as pipe:
            number = pipe.readline().strip()
        if not number:
            raise RunError(f"{program}: ended at once, expected a virtual screen")
        yield f":{number}"
    finally:
        end(process)
