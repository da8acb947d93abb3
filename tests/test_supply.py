"""What comes with an installation: pinned, of a fitting licence, and optional where it says so."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
import venv
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

IMPORTS = {
    "embreex": "embreex", "mujoco": "mujoco",
    "gtsam": "gtsam", "jinja2": "jinja2", "kiss-matcher": "kiss_matcher", "open3d": "open3d",
    "psutil": "psutil", "rerun-sdk": "rerun",
    "pymodbus": "pymodbus", "pyserial": "serial", "ur-rtde": "rtde_control",
    "genicam": "genicam", "harvesters": "harvesters", "pyrealsense2": "pyrealsense2",
    "laspy": "laspy", "mcap": "mcap", "pye57": "pye57", "rosbags": "rosbags",
    "tifffile": "tifffile", "trimesh": "trimesh",
    "dask": "dask", "distributed": "distributed",
    "latex2mathml": "latex2mathml", "mkdocs-material": "material",
    "mkdocstrings-python": "mkdocstrings_handlers",
}  # fmt: skip
"""Import name of what the extras bring."""
BASE = {
    "matplotlib", "numba", "numpy", "cv2", "PIL", "yaml", "rich", "scipy", "small_gicp",
    "threadpoolctl", "tyro",
}  # fmt: skip


def _licences() -> ModuleType:
    spec = importlib.util.spec_from_file_location("licences", ROOT / "setup" / "licences.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_all_that_an_installation_brings_is_pinned() -> None:
    lines = (ROOT / "constraints.txt").read_text().split()
    licences = _licences()
    pinned = {licences.name_of(line.partition("==")[0]) for line in lines}
    assert set(licences.brought()) <= pinned


def test_every_licence_fits_ours_or_was_looked_at() -> None:
    rows = list(_licences().judged())
    assert len(rows) > 100
    assert [f"{name}: {wrong}" for name, _, _, wrong in rows if wrong] == []


def test_what_binds_is_in_no_package_that_is_shipped() -> None:
    pattern = re.compile(r"^\s*(from|import) evo\b", re.MULTILINE)
    for package in ("depthba", "sim", "rig", "eval"):
        for file in (ROOT / package).rglob("*.py"):
            assert not pattern.search(file.read_text()), file


def test_python_is_declared_as_it_is_tested() -> None:
    declared = {c.rpartition(" ")[2] for c in PROJECT["classifiers"] if ":: Python ::" in c}
    assert declared == {"3.11"}
    assert PROJECT["requires-python"] == ">=3.11"


_IMPORT_ALL = """
import importlib, importlib.abc, json, pkgutil, sys
blocked = set(json.loads(sys.argv[1]))
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
found = {}
for package in sys.argv[2:]:
    for module in pkgutil.walk_packages([package], package + "."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except Exception as error:
            found[module.name] = f"{type(error).__name__}: {error}"
print(json.dumps(found))
"""


def _imported(blocked: set[str], *packages: str) -> dict[str, str]:
    done = subprocess.run(
        [sys.executable, "-c", _IMPORT_ALL, json.dumps(sorted(blocked)), *packages],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


def _of_extra(extra: str) -> set[str]:
    names = (re.split(r"[^\w.-]", text, maxsplit=1)[0] for text in
             PROJECT["optional-dependencies"][extra])  # fmt: skip
    return {IMPORTS[name] for name in names}


def test_every_package_of_an_extra_is_known_here() -> None:
    for extra in PROJECT["optional-dependencies"].keys() - {"dev"}:
        assert _of_extra(extra)


@pytest.mark.parametrize(
    ("package", "extras"),
    [("depthba", ()), ("rig", ("rig",)), ("eval", ("eval",)), ("sim", ("sim",))],
)
def test_every_module_is_imported_without_the_extras_of_others(
    package: str, extras: tuple[str, ...]
) -> None:
    own = {name for extra in extras for name in _of_extra(extra)}
    assert _imported(set(IMPORTS.values()) - own, package) == {}


_VERB = """
import importlib.abc, json, sys
blocked = set(json.loads(sys.argv[1]))
class Absent(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Absent())
import importlib.util
real = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: (
    None if name.partition(".")[0] in blocked else real(name, package)
)
from depthba.cli import main
sys.exit(main(sys.argv[2:]))
"""


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ("sim", ["generate", "lab-1", "--out", "{tmp}/x"]),
        ("sim", ["demo"]),
        ("sim", ["simulate-controller"]),
        ("eval", ["benchmark", "--list"]),
        ("eval", ["review", "{tmp}"]),
        ("convert", ["convert", "{tmp}/cloud", "{tmp}/y", "--poses", "identity"]),
        ("rig", ["capture", "docs/sessions/gantry_genicam.yaml", "--out", "{tmp}/z"]),
    ],
)
def test_a_verb_says_in_one_line_which_extra_is_missing(
    extra: str, words: list[str], tmp_path: Path
) -> None:
    (tmp_path / "cloud").mkdir()
    (tmp_path / "cloud" / "a.las").write_bytes(b"LASF")
    done = subprocess.run(
        [sys.executable, "-c", _VERB, json.dumps(sorted(IMPORTS.values())),
         *(word.format(tmp=tmp_path) for word in words)],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    *progress, line = done.stderr.splitlines()
    assert line.startswith("depthba: error: ") and f"pip install 'depthba[{extra}]'" in line
    assert not any("error" in told or "Traceback" in told for told in progress)


@pytest.mark.slow
def test_a_wheel_works_outside_of_the_checkout(tmp_path: Path) -> None:
    """The wheel alone is new: the packages that it needs are those of this environment."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    (wheel,) = tmp_path.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(*words: str | Path) -> str:
        done = subprocess.run(
            list(map(str, words)), cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(python, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", wheel)
    site = Path(run(python, "-c", "import site; print(site.getsitepackages()[0])").strip())
    # the editable installation of the checkout must not come in the wheel's place
    there = next(Path(p) for p in sys.path if p.endswith("site-packages"))
    for entry in there.iterdir():
        if (
            not (site / entry.name).exists()
            and "depthba" not in entry.name
            and (entry.suffix != ".pth" or "rerun" in entry.name)
        ):
            (site / entry.name).symlink_to(entry)
    home = run(python, "-c", "import depthba, sim, rig, eval; print(depthba.__file__)").strip()
    assert Path(home).is_relative_to(tmp_path)
    depthba = tmp_path / "venv" / "bin" / "depthba"
    assert "lab-1" in run(depthba, "generate", "--list")
    run(depthba, "generate", "lab-1", "--out", "set", "--frames", "3", "--size", "64x36")
    run(depthba, "doctor", "set")
    told = json.loads(run(depthba, "evaluate", "--help") and run(
        depthba, "convert", "set", "out", "--to", "tum-rgbd", "--json"
    ))  # fmt: skip
    assert told["frames"] == 3
