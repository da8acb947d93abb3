"""The verb `generate`: its words, what it prints, and its exit status."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from depthba.cli import main
from depthba.dataset import Dataset, verify
from depthba.verbs.arguments import parse
from sim.options import GenerateOptions
from sim.verbs.generate import Arguments, options_of

HEAP = "tests.sim.heaps:heap"
QUICK = ["--size", "64x48", "--frames", "2", "--rig", "gantry", "--sensor", "sp1000", "--no-rgb"]


def generate(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    """Exit status, stdout and stderr."""
    status = main(["generate", *map(str, words)])
    return status, *capsys.readouterr()


def test_every_word_becomes_its_option(tmp_path: Path) -> None:
    words = ["heap.xml", "--out", "here", "--seed", "4", "--frames", "7", "--rig", "dome"]
    words += ["--sensor", "zed2", "--size", "64X48", "--no-rgb", "--settled", "--renderer"]
    words += ["mujoco", "--clean", "--without", "dropout", "shadow", "--pose-noise", "0.5"]
    words += ["--start-error", "0.01", "0.02"]
    expected = GenerateOptions(
        seed=4,
        frames=7,
        size=(64, 48),
        start_error=(0.01, 0.02),
        clean=True,
        pose_noise=0.5,
        without=("dropout", "shadow"),
        sensor="zed2",
        rig="dome",
        renderer="mujoco",
        settled=True,
        rgb=False,
    )
    assert options_of(parse(Arguments, words, "depthba generate")) == expected
    file = tmp_path / "these.yaml"
    file.write_text(
        "scene: heap.xml\nout: there\nseed: 4\nframes: 7\nsize: 64x48\nstart_error: [0.01, 0.02]\n"
        "clean: true\nwithout: [dropout, shadow]\npose-noise: 0.5\nsensor: zed2\nrig: dome\n"
        "renderer: mujoco\nsettled: true\nno_rgb: true\ncount: 3\nworkers: 2\n"
    )
    read = parse(Arguments, ["--config", str(file), "--out", "here"], "depthba generate")
    assert (read.scene, read.out) == ("heap.xml", Path("here"))
    assert options_of(read) == expected
    assert (read.batch.count, read.batch.workers, read.batch.scheduler) == (3, 2, None)
    assert options_of(parse(Arguments, ["--list"], "depthba generate")) == GenerateOptions()


def test_one_dataset(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "set"
    words = [HEAP, "--out", out, *QUICK, "--clean", "--start-error", "0.01", "0.02"]
    status, told, _ = generate(capsys, *words, "--stages", "--json")
    said = json.loads(told)
    assert status == 0 and said["path"] == str(out) and said["frames"] == 2 and said["seconds"] > 0
    assert said["stages"] == str(out / "stages.png")
    assert (out / "stages.png").read_bytes().startswith(b"\x89PNG")
    assert Dataset.open(out).header["source"]["config"]["start_error"] == [0.01, 0.02]
    status, told, progress = generate(capsys, *words)  # there already
    assert status == 0 and told.startswith(f"{HEAP}: 2 frames in ") and str(out) in told
    assert "there already" in progress and verify(out) == []


def test_many_datasets(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "heap-000007").mkdir()
    (tmp_path / "heap-000007" / "thesis.txt").write_text("mine")
    words = [HEAP, "--out", tmp_path, "--seed", "6", "--count", "2", "--workers", "1", *QUICK]
    status, told, errors = generate(capsys, *words, "--json")
    said = json.loads(told)
    assert status == 1 and (said["done"], said["skipped"]) == (1, 0)
    (failed,) = said["failed"]
    assert failed["seed"] == 7 and "not empty" in failed["error"]
    last = errors.splitlines()[-1]
    assert last.startswith("depthba: error: ") and "1 of 2 datasets failed: seed 7 (" in last
    (tmp_path / "heap-000007" / "thesis.txt").unlink()
    status, told, progress = generate(capsys, *words)
    assert status == 0 and f"{HEAP}: 1 datasets in" in told and "1 were there already" in told
    assert "1 of 2 datasets" in progress and "2 of 2 datasets" in progress
    for seed in (6, 7):
        dataset = Dataset.open(tmp_path / f"heap-{seed:06d}")
        assert dataset.header["seed"] == seed and len(dataset) == 2


def test_list_shows_all_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    status, told, _ = generate(capsys, "--list", "--json")
    there = json.loads(told)
    assert status == 0
    bay = next(scene for scene in there["scenes"] if scene["id"] == "industrial-6")
    assert (bay["rig"], bay["sensor"], bay["frames"]) == ("gantry", "sp1000", 21)
    assert all(scene["description"] for scene in there["scenes"])
    (eye,) = [sensor for sensor in there["sensors"] if sensor["name"] == "sp1000"]
    assert (eye["width"], eye["height"], eye["baseline_m"]) == (1280, 960, 0.3)
    assert eye["focal_length_px"] == pytest.approx(1108.5, abs=0.1)
    assert {"quantisation": False, "shadow": True}.items() <= {
        stage["name"]: stage["noise"] for stage in there["noise_stages"]
    }.items()
    status, told, _ = generate(capsys, "industrial-6", "--list")
    assert status == 0 and "0.32 mm at 3 m" in told
    for kind, key in (("scenes", "id"), ("rigs", "name"), ("sensors", "name")):
        assert all(f"  {entry[key]} " in told for entry in there[kind])


@pytest.mark.parametrize(
    ("words", "status", "text"),
    [
        (["moon", "--out", "x"], 1, "'moon'"),
        ([HEAP, "--out", "x", "--size", "big"], 1, "size 'big': expected width and height"),
        ([HEAP, "--out", "x", "--size", "4x4"], 1, "size 4x4"),
        ([HEAP, "--out", "x", "--sensor", "eye"], 1, "unknown sensor 'eye'"),
        ([HEAP, "--out", "x", "--rig", "cart"], 1, "unknown rig 'cart'"),
        ([HEAP, "--out", "x", "--count", "2", "--without", "rain"], 1, "'rain'"),
        ([HEAP, "--out", "x", "--count", "0"], 1, "count 0: expected 1 or more"),
        ([HEAP, "--out", "x", "--workers", "2"], 1, "--workers 2: expected --count"),
        ([HEAP, "--out", "x", "--scheduler", "tcp://a:1"], 1, "--scheduler tcp://a:1: expected"),
        ([HEAP, "--out", "x", "--count", "2", "--stages"], 1, "--stages"),
        ([HEAP], 2, "--out DIR is missing"),
        ([], 2, "SCENE is missing"),
    ],
)
def test_wrong_words_get_one_line(
    words: list[str],
    status: int,
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    got, told, errors = generate(capsys, *words)
    assert got == status and told == "" and text in errors.splitlines()[-1]
    assert len([line for line in errors.splitlines() if line.startswith("depthba")]) == 1
    assert not list(tmp_path.rglob("*.*"))


def test_without_dask_the_line_names_the_extra(tmp_path: Path) -> None:
    words = ["generate", HEAP, "--out", str(tmp_path), "--count", "2", "--scheduler", "tcp://a:1"]
    code = (
        "import sys; sys.modules['distributed'] = None;"
        f"from depthba.cli import main; sys.exit(main({words!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "pip install 'depthba[distributed]'" in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_help_imports_nothing_heavy() -> None:
    heavy = ("numpy", "mujoco", "numba", "scipy", "embreex", "distributed")
    code = (
        "import sys; from depthba.cli import main\n"
        "try: main(['generate', '--help'])\n"
        f"finally: assert not set({heavy!r}) & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert all(word in done.stdout for word in ("industrial-6", "--scheduler ADDRESS", "pixels"))
