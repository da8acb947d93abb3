"""What goes wrong in a session, over real sockets: it ends in time, says so, and loses nothing."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from depthba.cli import main
from depthba.dataset import Dataset, verify
from rig.cameras import names
from rig.session.interrupts import Interrupts
from rig.session.opening import Opened, opened
from rig.session.options import Session
from rig.session.reading import read_session
from rig.session.record import begin
from rig.session.running import Listeners, Run
from tests.rig.peers import LONGEST
from tests.rig.sessions import STATIONS, changed, command, finished, frames, write
from tests.sim.controllers import BOXED, READY, Running, controller

pytest.importorskip("rtde_control")
if "simulated" not in names():
    pytest.fail(
        "the entry point `simulated` of depthba.cameras is not there: `make setup` installs it",
        pytrace=False,
    )

# Each move takes most of a second: time enough to hit it.
SLOW = {"motion__speed": 0.15, "motion__settle": 0.1, "retries": 1, "give_up": 2}


@pytest.fixture(scope="module")
def shared() -> Iterator[Running]:
    with controller("--scene", BOXED) as running:
        yield running


@pytest.fixture
def robot(shared: Running) -> Iterator[Running]:
    shared.channel.ask("place", joints=list(READY))
    yield shared
    for fault in shared.channel.ask("about")["faults"]:
        shared.fault(fault, False)
    for stop in ("protective-stop", "emergency-stop"):
        shared.fault(stop, False)


def session(tmp_path: Path, robot: Running, **changes: Any) -> Path:
    return write(
        tmp_path / "s.yaml",
        rig__options={"host": robot.host},
        camera__options={"size": [96, 54], "host": robot.host},
        **changes,
    )


@dataclass
class Moment:
    """When something was made to go wrong."""

    at: float = float("inf")


@contextmanager
def when(happens: Callable[[], bool], do: Callable[[], None]) -> Iterator[Moment]:
    """Do something from another thread as soon as something happens."""
    moment, over = Moment(), threading.Event()

    def watch() -> None:
        while not over.wait(0.03):
            if happens():
                moment.at = time.monotonic()
                do()
                return

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield moment
    finally:
        over.set()
        thread.join()


def on_the_way(out: Path, robot: Running, taken: int = 1) -> Callable[[], bool]:
    """Whether the arm moves on after so many frames."""

    def happens() -> bool:
        if len(frames(out)) < taken:
            return False
        moving: bool = robot.truth()["moving"]
        return moving

    return happens


def whole(out: Path, count: int) -> None:
    assert verify(out) == []
    assert len(Dataset.open(out)) == count


MOVING = [
    ("protective-stop", r"protective stop; expected a person"),
    ("emergency-stop", r"emergency stop; expected a person"),
    ("local", r"local mode, expected remote control"),
    ("stalled", r"no new data for 2 s|no answer to|closed the connection"),
]


@pytest.mark.parametrize(("fault", "said"), MOVING, ids=[row[0] for row in MOVING])
def test_a_fault_on_the_way_ends_the_session_which_then_goes_on(
    tmp_path: Path,
    robot: Running,
    capsys: pytest.CaptureFixture[str],
    fault: str,
    said: str,
) -> None:
    out = tmp_path / "out"
    words = ["capture", str(session(tmp_path, robot, **SLOW)), "--out", str(out)]
    with when(on_the_way(out, robot), lambda: robot.fault(fault)) as moment:
        status = main(words)
    took = time.monotonic() - moment.at
    error = capsys.readouterr().err.splitlines()[-1]
    assert status == 1 and took < LONGEST, (status, took, error)
    assert re.search(said, error), error
    assert "ended with 1 of 3 frames whole" in error and "the same command goes on" in error
    whole(out, 1)
    if fault == "protective-stop":
        # Still held: refused at once.
        assert main(words) == 1
        assert "protective stop" in capsys.readouterr().err


def begun(loaded: Session, ready: Opened, out: Path, listeners: Listeners, **more: Any) -> Run:
    """Return a run at its beginning, in a new dataset."""
    writer = begin(out, loaded, ready.space, ready.plan, ready.info, False)
    return Run(
        loaded, ready.space, ready.plan, ready.carrier, ready.camera, ready.info, writer, listeners,
        **more,
    )  # fmt: skip


def test_where_somebody_can_be_asked_a_stop_pauses_the_session(
    tmp_path: Path, robot: Running
) -> None:
    out, asked = tmp_path / "out", []

    def ask(question: str) -> bool:
        asked.append(question)
        if len(asked) == 2:
            robot.fault("protective-stop", False)
        return True

    loaded = read_session(session(tmp_path, robot, **SLOW))
    with opened(loaded, loaded, out, rehearsed=False, move=True) as ready:
        run = begun(loaded, ready, out, Listeners(ask=ask))
        with when(on_the_way(out, robot), lambda: robot.fault("protective-stop")):
            summary = run()
    # Asked while it was held still, and again; then it went on from where it stood.
    assert len(asked) == 2 and all("protective stop" in question for question in asked)
    assert summary.complete and summary.stops == 1
    whole(out, 3)
    assert [line["station"] for line in frames(out)] == [0, 1, 2]


def test_a_controller_that_is_gone_ends_the_session(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    with controller("--scene", BOXED) as robot:
        words = ["capture", str(session(tmp_path, robot, **SLOW)), "--out", str(out)]
        with when(on_the_way(out, robot), robot.process.kill) as moment:
            status = main(words)
        took = time.monotonic() - moment.at
        error = capsys.readouterr().err.splitlines()[-1]
        assert status == 1 and took < LONGEST, (status, took, error)
        assert re.search(r"closed the connection|client ended|no new data|no answer to", error), (
            error
        )
        whole(out, 1)


def test_frames_that_do_not_come_are_tried_for_again_then_skipped_and_listed(
    tmp_path: Path, robot: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    path = session(tmp_path, robot, **SLOW)

    def clear() -> None:
        robot.fault("blind", False)

    def skipped() -> bool:
        return (out / "skipped.jsonl").exists()

    with when(on_the_way(out, robot), lambda: robot.fault("blind")), when(skipped, clear):
        status = main(["capture", str(path), "--out", str(out), "--json"])
    printed = capsys.readouterr()
    assert status == 3, printed.err
    assert '"frames": 2' in printed.out and '"label": "joints 1"' in printed.out
    assert "no answer to 'expose' in time; once more" in printed.err
    whole(out, 2)
    assert main(["capture", str(path), "--out", str(out), "--retry-skipped"]) == 0
    assert [line["station"] for line in frames(out)] == [0, 2, 1]
    whole(out, 3)


def test_a_camera_that_stays_blind_ends_the_session(
    tmp_path: Path, robot: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    path = session(tmp_path, robot, **{**SLOW, "motion__speed": 1.0, "camera__timeout": 0.25})
    with when(on_the_way(out, robot), lambda: robot.fault("blind")) as moment:
        status = main(["capture", str(path), "--out", str(out)])
    took = time.monotonic() - moment.at
    error = capsys.readouterr().err.splitlines()[-1]
    assert status == 1 and took < LONGEST, (status, took, error)
    assert "2 poses in a row without a frame" in error and "no answer to 'expose'" in error
    whole(out, 1)


def test_a_disk_that_is_full_ends_the_session_which_goes_on_once_there_is_room(
    tmp_path: Path, robot: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("only root can make a small disk")
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(disk)], capture_output=True
    )
    if made.returncode != 0:
        pytest.skip(f"no small disk can be made here: {made.stderr.decode().strip()}")
    try:
        out, path = disk / "out", session(tmp_path, robot, **SLOW)

        def fill() -> None:
            with contextlib.suppress(OSError), (disk / "others").open("wb", 0) as file:
                while True:
                    file.write(bytes(4096))

        with when(on_the_way(out, robot), fill) as moment:
            status = main(["capture", str(path), "--out", str(out)])
        took = time.monotonic() - moment.at
        error = capsys.readouterr().err.splitlines()[-1]
        assert status == 1 and took < LONGEST, (status, took, error)
        assert "No space left on device" in error and "1 of 3 frames whole" in error
        whole(out, 1)
        # It is seen before anything moves, too.
        assert main(["capture", str(path), "--out", str(out)]) == 1
        assert re.search(r"0 MB free, expected 16 MB for 3 frames", capsys.readouterr().err)
        (disk / "others").unlink()
        assert main(["capture", str(path), "--out", str(out)]) == 0
        whole(out, 3)
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.parametrize("deaf", [False, True], ids=["heard", "started deaf"])
def test_ctrl_c_brakes_the_arm_and_leaves_a_whole_dataset(
    tmp_path: Path, robot: Running, deaf: bool
) -> None:
    out = tmp_path / "out"
    # Slower than the others: the signal must not come after the last frame on a busy machine.
    path = session(tmp_path, robot, **{**SLOW, "motion__speed": 0.05})
    # As a script starts what it puts into the background.
    before = signal.signal(signal.SIGINT, signal.SIG_IGN if deaf else signal.default_int_handler)
    try:
        process = command(path, "--out", out)
    finally:
        signal.signal(signal.SIGINT, before)
    with when(on_the_way(out, robot), lambda: process.send_signal(signal.SIGINT)) as moment:
        status, _, error = finished(process)
    assert time.monotonic() - moment.at < LONGEST
    assert status == 130 and "1 of 3 frames are whole; the same command goes on" in error
    truth = robot.truth()
    assert not truth["moving"] and abs(truth["joints"][0] - STATIONS[1][0]) > 0.01
    whole(out, 1)


def test_ctrl_c_is_not_lost_where_python_swallows_it(tmp_path: Path, robot: Running) -> None:
    out = tmp_path / "out"
    loaded = read_session(session(tmp_path, robot, **SLOW))
    interrupts = Interrupts()

    class Finalised:
        """The interpreter lets nothing out of a finaliser."""

        def __del__(self) -> None:
            signal.raise_signal(signal.SIGINT)

    things = [Finalised()]
    swallowed: list[type[BaseException]] = []

    def said(text: str, done: int, total: int) -> None:
        if done == 1 and things:
            things.pop()

    with opened(loaded, loaded, out, rehearsed=False, move=True) as ready:
        run = begun(loaded, ready, out, Listeners(say=said), interrupts=interrupts)
        hook, sys.unraisablehook = sys.unraisablehook, lambda what: swallowed.append(what.exc_type)
        try:
            with pytest.raises(KeyboardInterrupt):
                run()
        finally:
            sys.unraisablehook = hook
    assert swallowed == [KeyboardInterrupt]
    assert not robot.truth()["moving"]
    whole(out, 1)


def test_another_session_or_folder_is_refused_before_anything_moves(
    tmp_path: Path, robot: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    quick = {"motion__settle": 0.05, "poses": [{"joints": STATIONS[:1]}]}
    assert main(["capture", str(session(tmp_path, robot, **quick)), "--out", str(out)]) == 0
    capsys.readouterr()
    other = session(tmp_path, robot, **quick, motion__speed=0.4, retries=0)
    assert main(["capture", str(other), "--out", str(out)]) == 1
    error = capsys.readouterr().err
    assert "motion.speed: 0.5 before, 0.4 now; retries: 2 before, 0 now" in error
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    assert main(["capture", str(other), "--out", str(tmp_path / "full")]) == 1
    assert "not empty (thesis.txt)" in capsys.readouterr().err


def test_a_dry_run_checks_all_moves_nothing_and_draws_the_plan(
    tmp_path: Path, robot: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    path = session(tmp_path, robot)
    assert main(["capture", str(path), "--out", str(out), "--dry-run", "--json"]) == 0
    assert '"stations": 3' in capsys.readouterr().out
    assert robot.truth()["encoders"] == list(READY) and not out.exists()
    drawn = tmp_path / "out-plan.rrd"
    try:
        import rerun  # noqa: F401
    except ImportError:
        assert not drawn.exists()
    else:
        assert drawn.stat().st_size > 1000
    beyond = [*changed()["limits"]["camera"][:3], 0.5, 0.35, 0.9]
    path = session(tmp_path, robot, limits__camera=beyond)
    assert main(["capture", str(path), "--out", str(out), "--dry-run"]) == 1
    assert "3 of 3 poses cannot be taken" in capsys.readouterr().err
