"""A slice of `make crash`: one run of what is quickest to disturb, in each way."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.crash.__main__ import small_dataset
from tests.crash.trials import FAULTS, Verb, finish, trial, verbs

pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("crash")
    small_dataset(folder / "set")
    return folder


def _disturb(name: str, fault: str, home: Path, folder: Path) -> None:
    verb: Verb = next(v for v in verbs(home / "set") if v.name == name)
    undisturbed = home / name / "out"
    if not undisturbed.exists():
        undisturbed.parent.mkdir()
        finish(verb, undisturbed)
    expected = verb.committed(undisturbed)
    tally = trial(verb, fault, folder / "trial", 1, expected)
    if tally.skipped:
        pytest.skip(tally.skipped)
    assert tally.runs == 1 and tally.broken == [] and tally.lost == 0


@pytest.mark.parametrize(
    "fault", [pytest.param("SIGKILL", marks=pytest.mark.slow), "read-only disk"]
)
def test_generate_loses_nothing(fault: str, home: Path, tmp_path: Path) -> None:
    _disturb("generate", fault, home, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["generate", "capture", "register", "benchmark"])
@pytest.mark.parametrize("fault", list(FAULTS))
def test_nothing_is_lost(name: str, fault: str, home: Path, tmp_path: Path) -> None:
    _disturb(name, fault, home, tmp_path)
