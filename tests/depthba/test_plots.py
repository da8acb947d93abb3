"""Pictures of a run: drawn from the plain files, with the figures that they show."""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import cv2
import numpy as np
import pytest

from depthba.cli import main
from depthba.plots.residuals import off_map
from depthba.plots.source import Source
from depthba.plots.trajectory import enlarged
from tests.depthba.analytic_scene import write_scene

KINDS = ("map", "residuals", "trajectory", "covariance")
NOISE = 0.001


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("plots")
    write_scene(folder / "data", frames=4, noise=NOISE)
    assert main(["register", str(folder / "data"), "--out", str(folder / "run")]) == 0
    return folder / "run"


def told(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, dict[str, object]]:
    assert main(["plot", *words, "--json"]) == 0
    return {one["kind"]: one for one in json.loads(capsys.readouterr().out)["plots"]}


def test_every_kind_is_drawn_with_its_figures(
    run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plots = told(capsys, str(run))
    assert tuple(plots) == KINDS
    for kind in KINDS:
        image = cv2.imread(str(run / "plots" / f"{kind}.png"))
        assert image.shape[0] > 300 and image.shape[1] > 900
        assert image.std() > 10  # not an empty sheet
    result = json.loads((run / "result.json").read_text())
    moves = [frame["move_t"] for frame in result["frames"]]
    assert plots["trajectory"]["largest_move_m"] == pytest.approx(max(moves), rel=1e-6)
    # a map of few points a node follows their noise in part
    assert 0.4 * NOISE < plots["residuals"]["sigma_m"] < 1.05 * NOISE
    with np.load(run / "covariance.npz") as arrays:
        sigma = np.sqrt(np.diag(arrays["full"])).reshape(-1, 6)
    assert plots["covariance"]["largest_sigma_m"] == pytest.approx(sigma[:, :3].max())


def test_one_kind_into_one_svg(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "new" / "fit.svg"
    assert main(["plot", str(run), "--kind", "covariance", "--out", str(file)]) == 0
    assert ElementTree.parse(file).getroot().tag.endswith("svg")


def test_a_run_against_itself_has_not_changed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "change.png")
    change = told(capsys, str(run), "--against", str(run), "--out", file, "--least", "0.001")
    assert change["change"]["changed_m2"] == 0.0
    assert change["change"]["area_m2"] > 0.1
    assert Path(file).stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--kind", "change"], "--kind change goes with --against RUN"),
        (["--out", "two.png"], "two.png: is one file for 4 pictures"),
        (["--kind", "map", "--out", "map.jpg"], "map.jpg: expected .png or .svg"),
        (["--dataset", "nowhere"], "its dataset nowhere is not there; say where with --dataset"),
    ],
)
def test_what_cannot_be_drawn_is_said(
    run: Path, words: list[str], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["plot", str(run), *words]) == 1
    assert line in capsys.readouterr().err


def test_points_on_the_map_lie_on_it_and_points_beside_are_unknown(run: Path) -> None:
    depth_map = Source.open(run).depth_map
    s = depth_map.spacing
    rows, columns = (n // 2 for n in depth_map.shape)
    x, y = depth_map.origin[0] + s * columns, depth_map.origin[1] + s * rows
    on = np.array([x, y, depth_map.heights[rows, columns]])
    off = off_map(
        np.stack([on, on + np.array([0, 0, 0.01]), on + np.array([100.0, 0, 0])]), depth_map
    )
    assert off[0] == pytest.approx(0.0, abs=1e-12)
    assert 0.003 < off[1] <= 0.01
    assert np.isnan(off[2])


def test_moves_are_enlarged_in_round_steps() -> None:
    after = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]])
    assert enlarged(after, after + 0.5) == 1
    assert enlarged(after, after + np.array([0.001, 0, 0])) == 100
