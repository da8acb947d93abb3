"""The command line: what it answers, and with which status."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from depthba import cli
from depthba.dataset import DatasetWriter

HEAVY = ("numpy", "numba", "scipy", "cv2", "matplotlib", "mujoco", "open3d", "rerun", "tyro")


def depthba(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "depthba", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, timeout=300)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames of a bumpy ground, 64 x 48, seen from 1 m; the measured poses are off by 2 mm."""
    path = tmp_path_factory.mktemp("data") / "bumps"
    width, height, f = 64, 48, 80.0
    camera = {"fx": f, "fy": f, "cx": (width - 1) / 2, "cy": (height - 1) / 2}
    sensor = {"kind": "depth", "model": "test", "width": width, "height": height, **camera}
    sensor |= {"distortion": [0, 0, 0, 0, 0], "depth_scale": 0.0001}
    header = {"format": "depthba-dataset", "version": 1, "name": "bumps", "sensor": sensor}
    writer = DatasetWriter.create(path, {**header, "map_frame": "world"})
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([(u - camera["cx"]) / f, (v - camera["cy"]) / f, np.ones_like(u)], -1)
    random = np.random.default_rng(3)
    looking_down = np.diag([1.0, -1.0, -1.0])
    for i in range(4):
        T_true = np.eye(4)
        T_true[:3, :3] = looking_down
        T_true[:3, 3] = 0.08 * (i % 2), 0.08 * (i // 2), 1.0
        z = np.ones((height, width))
        for _ in range(20):  # walk along each ray to the ground
            x, y, _ = np.moveaxis((rays * z[..., None]) @ looking_down.T + T_true[:3, 3], -1, 0)
            z = 1.0 - 0.03 * np.sin(25 * x) * np.cos(19 * y) - 0.02 * np.sin(11 * x + 17 * y)
        T_measured = T_true.copy()
        T_measured[:3, 3] += 0.002 * random.standard_normal(3) * (i > 0)
        writer.add_frame(
            stamp=float(i), depth=z, T_world_camera=T_measured, T_world_camera_true=T_true
        )
    return path


def test_help_lists_every_verb_and_imports_nothing_heavy() -> None:
    code = (
        "import sys; from depthba.cli import main; status = main(['--help']);"
        f"heavy = [name for name in {HEAVY} if name in sys.modules];"
        "sys.exit(f'imported {heavy}' if heavy else status)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for verb in cli.VERBS:
        assert f"\n  {verb} " in done.stdout


@pytest.mark.parametrize("verb", cli.VERBS)
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main([verb, "--help"])
    assert end.value.code == 0
    told = capsys.readouterr().out
    assert f"usage: depthba {verb} " in told
    assert "--config FILE" in told
    assert "--json" in told or verb == "review"


@pytest.mark.parametrize(
    ("words", "status", "told"),
    [
        ([], 2, "usage: depthba VERB"),
        (["fly"], 2, "no verb 'fly'; the verbs are: demo, generate"),
        (["register"], 2, "DATASET"),
        (["register", ".", "--preset", "best"], 2, "invalid choice 'best'"),
        (["register", "/no/such/folder"], 1, "depthba: error: /no/such/folder"),
        (["register", ".", "--config", "absent.yaml"], 1, "absent.yaml: No such file"),
        (["doctor", "/no/such/folder"], 1, ""),
    ],
)
def test_errors_are_short_and_have_their_status(
    words: list[str], status: int, told: str, tmp_path: Path
) -> None:
    done = depthba(*words, cwd=tmp_path)
    assert done.returncode == status
    assert told in done.stderr
    assert "Traceback" not in done.stderr
    if status == 1 and told:
        assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_missing_package_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "needy.py").write_text("import no_such_package.part\n")
    monkeypatch.syspath_prepend(tmp_path)
    known = cli.Verb("needy", "Known to need it.", extra="eval", needs=("no_such_package",))
    found_out = cli.Verb("needy", "Found out when imported.", extra="eval")
    monkeypatch.setattr(cli, "VERBS", {"known": known, "found-out": found_out})
    for name in cli.VERBS:
        assert cli.main([name]) == 1
        told = capsys.readouterr().err
        assert told.count("\n") == 1
        assert f"{name} needs no_such_package, " in told
        assert "pip install 'depthba[eval]'" in told
    assert cli.main(["--help"]) == 0
    assert "Known to need it. (needs no_such_package: pip" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("colour: red", "unknown key 'colour'; choose from: "),
        ("preset: best", "preset is 'best', expected "),
        ("roi: [0, 1]", "roi is [0, 1], expected "),
        ("overwrite: 1", "overwrite is 1, expected bool"),
        ("threads: {a: 1}", "threads is {'a': 1}, expected "),
        ("[1, 2]", "expected keys and values"),
        ("a: [", "not YAML"),
    ],
)
def test_a_wrong_configuration_names_the_offender(
    text: str, told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    assert cli.main(["register", "anything", f"--config={file}"]) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"depthba: error: {file}: ")
    assert told in error
    assert error.count("\n") == 1


def test_the_command_line_wins_over_the_file_and_the_file_over_the_defaults(
    tmp_path: Path,
) -> None:
    from depthba.verbs.arguments import parse
    from depthba.verbs.register import Arguments

    file = tmp_path / "some.yaml"
    file.write_text(
        "preset: paper\nmax-iterations: 7\nprior_t: 1e-3\noverwrite: true\n"
        "roi: [-1, 1, -2, 2, 0, 0.5]\nthreads: null\nresolution: 0.02\n"
    )
    words = ["data", "--config", str(file), "--resolution", "0.05", "--no-overwrite"]
    parsed = parse(Arguments, words, prog="depthba register")
    assert parsed.dataset == Path("data")
    assert not parsed.overwrite
    options = parsed.options
    assert (options.preset, options.max_iterations, options.prior_t) == ("paper", 7, 1e-3)
    assert options.roi == (-1.0, 1.0, -2.0, 2.0, 0.0, 0.5)
    assert options.resolution == 0.05
    assert options.threads is None
    assert options.init == "measured"


def test_register_prints_one_object_and_takes_its_own_configuration_back(
    dataset: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    first = depthba("register", dataset, "--out", run, "--resolution", 0.02, "--json")
    assert first.returncode in (0, 3), first.stderr
    told = json.loads(first.stdout)
    assert first.returncode == (0 if told["trusted"] else 3)
    assert told["frames"] == 4
    assert told["run"] == str(run)
    assert "level 1/" in first.stderr
    saved = json.loads((run / "result.json").read_text())
    assert saved["status"] == told["status"]
    assert yaml.safe_load((run / "config.yaml").read_text())["resolution"] == 0.02

    # a folder that is taken is left alone, unless told otherwise
    taken = depthba("register", dataset, "--out", run)
    assert taken.returncode == 1
    assert taken.stderr.count("\n") == 1
    assert str(run) in taken.stderr
    assert json.loads((run / "result.json").read_text()) == saved

    again = depthba(
        "register", dataset, "--out", run, "--overwrite", "--config", run / "config.yaml"
    )
    assert again.returncode == first.returncode, again.stderr
    assert str(run) in again.stdout
    assert json.loads((run / "result.json").read_text())["options"] == saved["options"]


def test_an_interrupt_leaves_nothing_half_written(dataset: Path, tmp_path: Path) -> None:
    words = ["register", dataset, "--out", tmp_path / "run", "--resolution", "0.003"]
    process = subprocess.Popen(
        [sys.executable, "-m", "depthba", *map(str, words)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        # whoever runs the tests in the background may have switched the signal off
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert process.stderr is not None
    assert any("level 1/" in line for line in process.stderr)
    assert (tmp_path / "run").is_dir()
    process.send_signal(signal.SIGINT)
    told = process.stderr.read()
    assert process.wait(timeout=60) == 130
    assert "Traceback" not in told
    assert told.endswith("depthba: interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_doctor_lists_every_fault_of_a_dataset_and_describes_a_whole_one(
    dataset: Path, tmp_path: Path
) -> None:
    whole = depthba("doctor", dataset, "--json")
    assert whole.returncode == 0, whole.stderr
    told = json.loads(whole.stdout)
    assert told["ok"]
    assert told["dataset"]["frames"] == 4
    assert told["dataset"]["truth"]

    broken = tmp_path / "broken"
    subprocess.run(["cp", "-r", dataset, broken], check=True)
    (broken / "depth" / "000001.png").unlink()
    (broken / "depth" / "000003.png").write_bytes(b"not a picture")
    done = depthba("doctor", broken)
    assert done.returncode == 1
    assert "000001.png" in done.stdout
    assert "000003.png" in done.stdout


def test_doctor_says_where_the_dataset_of_a_run_is(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert cli.main(["register", str(dataset), "--out", str(run)]) in (0, 3)
    capsys.readouterr()
    assert cli.main(["doctor", str(run)]) == 1
    told = capsys.readouterr().out
    assert f"{run}: a run of depthba, expected a dataset; its own is {dataset}\n" in told
    (run / "poses.txt").unlink()
    assert cli.main(["doctor", str(run), "--json"]) == 1
    (fault,) = json.loads(capsys.readouterr().out)["faults"]
    assert "a run of depthba, expected a dataset (" in fault["text"]


def test_doctor_leaves_out_a_model_without_a_name(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    nameless = tmp_path / "nameless"
    subprocess.run(["cp", "-r", dataset, nameless], check=True)
    header = json.loads((nameless / "dataset.json").read_text())
    for model, words in (("", ", with true poses"), ("mine", " from mine, with true poses")):
        header["sensor"]["model"] = model
        (nameless / "dataset.json").write_text(json.dumps(header))
        assert cli.main(["doctor", str(nameless)]) == 0
        told = capsys.readouterr().out
        size = f"{header['sensor']['width']} x {header['sensor']['height']}"
        assert f"depth frames of {size}{words}" in told


def test_options_that_may_be_left_out_do_not_offer_none(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for verb in ("register", "convert"):
        with pytest.raises(SystemExit):
            cli.main([verb, "--help"])
        told = capsys.readouterr().out
        assert "--axes {opencv,opengl}" in told and "{None" not in told
    from depthba.verbs import convert
    from depthba.verbs.arguments import parse

    for words, axes in ((["--axes", "opengl"], "opengl"), (["--axes", "None"], None), ([], None)):
        assert parse(convert.Arguments, words, "convert").reading.axes == axes
    with pytest.raises(SystemExit):
        parse(convert.Arguments, ["--axes", "odd"], "convert")


def test_doctor_looks_at_the_machine() -> None:
    done = depthba("doctor", "--json")
    told = json.loads(done.stdout)
    assert done.returncode == (0 if told["ok"] else 1)
    seen = {check["name"]: check for check in told["checks"]}
    assert seen["numpy"]["ok"]
    assert seen["numpy"]["required"]
    assert {"EGL", "GL", "OSMesa", "port 30004", "cores", "memory", "numba threads"} <= seen.keys()
