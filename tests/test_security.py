"""What docs/security.md promises: nothing that is read is run, nothing listens to the world."""

from __future__ import annotations

import ast
import io
import pickle
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
import yaml

from depthba import documents, stored_run
from depthba.errors import OptionError
from eval import review
from rig.session.reading import read_session
from sim.axes.modbus_device import Options as ModbusOptions
from sim.axes.serving import check_loopback
from sim.controller.options import ControllerOptions
from tests.sim.controllers import controller

ROOT = Path(__file__).parents[1]
PICKLES = {Path("rig/cameras/apart.py"), Path("rig/cameras/apart_child.py")}
"""A camera's process and the one that started it talk by pickles, over a pipe of their own."""


def _calls() -> Iterator[tuple[Path, ast.Call, str]]:
    """Give every call in the product, with the name of what is called."""
    for package in ("depthba", "sim", "rig", "eval"):
        for file in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(file.read_text())):
                if isinstance(node, ast.Call):
                    yield file.relative_to(ROOT), node, ast.unparse(node.func)


def test_nothing_that_is_read_is_run() -> None:
    forbidden = {
        "eval", "exec", "os.system", "os.popen", "marshal.load", "marshal.loads", "shelve.open",
        "yaml.load", "yaml.unsafe_load", "yaml.full_load", "joblib.load", "torch.load",
    }  # fmt: skip
    found = list(_calls())
    assert len(found) > 5000
    for file, call, name in found:
        where = f"{file}:{call.lineno}: {name}"
        assert name not in forbidden, where
        assert not (name.startswith("pickle.load") and file not in PICKLES), where
        words = {word.arg: word.value for word in call.keywords}
        if name in ("np.load", "numpy.load"):
            assert ast.unparse(words["allow_pickle"]) == "False", where
        for word in ("allow_pickle", "shell"):
            assert word not in words or ast.unparse(words[word]) == "False", where


class Runs:
    """What makes a file when it is unpickled."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, ...]:
        return Path.touch, (self.file,)


def test_arrays_of_objects_are_not_unpickled(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    data = io.BytesIO()
    np.savez(data, heights=np.array([Runs(ran)], dtype=object))
    (tmp_path / "map.npz").write_bytes(data.getvalue())
    with pytest.raises(ValueError, match="objects"):
        stored_run.read_map(tmp_path / "map.npz")
    assert not ran.exists()
    pickle.loads(pickle.dumps(Runs(ran)))
    assert ran.exists()  # so it would have been seen


def test_tags_of_yaml_make_no_objects(tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    text = f"name: !!python/object/apply:os.mkdir ['{ran}']\n"
    with pytest.raises(yaml.YAMLError, match="could not determine a constructor"):
        documents.parse_yaml(text)
    example = (ROOT / "docs" / "sessions" / "simulated.yaml").read_text()
    (tmp_path / "s.yaml").write_text(example.replace("name: lab-1-rehearsed\n", text))
    with pytest.raises(OptionError, match=r"s\.yaml"):
        read_session(tmp_path / "s.yaml")
    assert not ran.exists()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.0.7", "localhost.example", "::"])
def test_what_is_simulated_listens_to_this_machine_alone(host: str) -> None:
    with pytest.raises(OptionError, match="loopback"):
        ControllerOptions(host=host)
    with pytest.raises(OptionError, match="loopback"):
        check_loopback(host)
    check_loopback(ModbusOptions().host)


def test_the_simulated_controller_has_no_other_port_open() -> None:
    with controller() as running:
        process = psutil.Process(running.process.pid)
        open_ports = [
            link.laddr for link in process.net_connections("inet") if link.status == "LISTEN"
        ]
    assert {port.port for port in open_ports} == {29990, 29999, 30001, 30002, 30003, 30004}
    assert {port.ip for port in open_ports} == {running.host}
    assert running.host.startswith("127.")


def test_the_viewers_page_is_served_to_this_machine_alone() -> None:
    words = review.web_command(9090, 9091)
    assert words[words.index("--bind") + 1] == "127.0.0.1"


def test_nobody_else_binds() -> None:
    """A new listener belongs into docs/security.md, and here."""
    known = {
        Path("sim/controller/server.py"),  # the simulated controller
        Path("depthba/verbs/machine.py"),  # doctor: is a port free?
        Path("eval/review.py"),  # the viewer: which port is free?
    }
    assert {file for file, _, name in _calls() if name.endswith(".bind")} == known
    servers = {file for file, _, name in _calls() if name.endswith("TcpServer")}
    assert servers == {Path("sim/axes/modbus_device.py")}
    page = (ROOT / "docs" / "security.md").read_text()
    for port in ("29990", "29999", "30001–30004", "5020", "8786"):
        assert port in page
