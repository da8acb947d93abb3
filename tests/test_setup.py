"""The set-up: its pins, its script on machines that lack things, and the rules the linter holds."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIBRARIES = ("libegl1", "libgl1", "libx11-6", "libgomp1", "libusb-1.0-0")


def _name(text: str) -> str:
    return re.sub(r"[-_.]+", "-", re.split(r"[^\w.-]", text, maxsplit=1)[0]).lower()


def test_constraints_pin_everything_by_name_and_version_alone() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    for line in lines:
        assert re.fullmatch(r"[A-Za-z0-9][\w.-]*==[\w.!+]+", line), line
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    wanted = [*project["project"]["dependencies"], *project["build-system"]["requires"]]
    for extra in project["project"]["optional-dependencies"].values():
        wanted += extra
    assert {_name(text) for text in wanted} <= {_name(line) for line in lines}


def _command(folder: Path, name: str, body: str) -> None:
    file = folder / name
    file.write_text(f"#!/bin/sh\n{body}\n")
    file.chmod(0o755)


def _machine(folder: Path, user: int, sudo: bool) -> dict[str, str]:
    """Return the environment of a machine that has no library and a Python that is too old."""
    log = folder / "log"
    _command(folder, "ldconfig", "echo nothing")
    _command(folder, "id", f"echo {user}")
    _command(folder, "apt-get", f'echo "apt-get $*" >> {log}')
    _command(
        folder,
        "sudo",
        f'[ "$1" = -n ] && shift; echo sudo >> {log}; exec "$@"' if sudo else "exit 1",
    )
    _command(folder, "old-python", '[ "$1" = --version ] && echo Python 3.9.2; exit 1')
    path = f"{folder}:{os.environ['PATH']}"
    return {**os.environ, "PATH": path, "PYTHON": str(folder / "old-python")}


def _install(environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["bash", str(ROOT / "setup" / "install.sh")],
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
    )


def test_without_root_one_line_says_what_to_install(tmp_path: Path) -> None:
    done = _install(_machine(tmp_path, user=1000, sudo=False))
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"apt-get install {' '.join(LIBRARIES)}" in done.stderr
    assert not (tmp_path / "log").exists()


@pytest.mark.parametrize("user", [0, 1000], ids=["root", "sudo"])
def test_missing_libraries_are_installed_after_an_update(tmp_path: Path, user: int) -> None:
    done = _install(_machine(tmp_path, user=user, sudo=True))
    log = (tmp_path / "log").read_text()
    assert log.index("apt-get update") < log.index("apt-get install")
    for library in LIBRARIES:
        assert library in log
    assert ("sudo" in log) == (user != 0)
    # then it comes to the Python of this machine
    assert done.returncode == 1
    assert "Python 3.9.2 is too old" in done.stderr


def test_a_second_set_up_does_nothing(tmp_path: Path) -> None:
    stamp = tmp_path / "stamp"
    stamp.touch()
    done = subprocess.run(
        ["make", "setup", f"STAMP={stamp}"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "Nothing to be done for 'setup'" in done.stdout


def test_the_wheel_holds_the_four_packages_and_nothing_else(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names if ".dist-info/" not in name}
    assert tops == {"depthba", "sim", "rig", "eval"}
    for package in tops:
        assert {f"{package}/__init__.py", f"{package}/py.typed"} <= set(names)


@pytest.mark.parametrize(
    ("line", "allowed"),
    [("import eval", False), ("from eval import metrics", True)],
)
def test_the_linter_keeps_the_builtin_eval(line: str, allowed: bool) -> None:
    command = [sys.executable, "-m", "ruff", "check", "--stdin-filename", "sim/new.py", "-"]
    text = f'"""Something new."""\n\n{line}\n'
    done = subprocess.run(command, cwd=ROOT, input=text, capture_output=True, text=True)
    assert ("A004" in done.stdout) == (not allowed)
