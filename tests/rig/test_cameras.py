"""Cameras by name, the folder camera, the ZED's adapter, and what makes a frame unfit."""

from __future__ import annotations

import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from depthba.camera import Camera
from depthba.dataset import Dataset
from depthba.errors import MissingPackage, OptionError
from rig.cameras import CameraInfo, Capture, DepthCamera, FrameLimits, checking, find, make, names
from rig.cameras.folder import FolderCamera, FolderOptions
from rig.cameras.zed import camera_from, depth_from, rgb_from, stamp_from
from rig.errors import CameraError
from tests.rig.arm_scene import write_arm
from tests.rig.peers import ROOT

BUILT_IN = {"folder", "genicam", "realsense", "zed"}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_arm(tmp_path_factory.mktemp("recorded") / "scene", frames=3)


# by name ---------------------------------------------------------------------------------------

PLUGIN = """
from dataclasses import dataclass
import numpy as np
from depthba.camera import Camera
from rig.cameras.camera import CameraInfo, Capture

@dataclass(frozen=True)
class Options:
    distance: float
    tilted: bool = False

class Wall:
    Options = Options
    def __init__(self, options):
        self.options = options
    def open(self):
        return CameraInfo("wall", "1", Camera(4, 3, 5.0, 5.0, 2.0, 1.0))
    def capture(self, timeout):
        return Capture(np.full((3, 4), self.options.distance, np.float32), 1.0)
    def close(self):
        pass

class Bare:
    pass
"""
POINTS = """[depthba.cameras]
wall = tiny_wall:Wall
bare = tiny_wall:Bare
broken = tiny_wall_that_is_not_there:Wall
folder = tiny_wall:Wall
"""


def test_another_package_brings_a_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tiny_wall.py").write_text(PLUGIN)
    about = tmp_path / "tiny_wall-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: tiny-wall\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(POINTS)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert {"wall", "bare", "broken", *BUILT_IN} <= set(names())
    camera: DepthCamera = make("wall", {"distance": 2})
    assert camera.open().model == "wall"
    np.testing.assert_array_equal(camera.capture(1.0).depth, np.full((3, 4), 2, np.float32))
    with pytest.raises(CameraError, match=r"'bare' \(tiny_wall:Bare\) has no dataclass Options"):
        make("bare")
    with pytest.raises(CameraError, match=r"'broken' .* cannot be loaded: No module"):
        make("broken")
    assert find("folder") is FolderCamera  # what is built in cannot be taken away
    for values, words in (
        ({}, "camera 'wall': option 'distance' is missing"),
        ({"distance": 1, "speed": 2}, "unknown option 'speed'; choose from: distance, tilted"),
        ({"distance": "far"}, "option 'distance' is 'far', expected float"),
        ({"distance": True}, "option 'distance' is True, expected float"),
        ({"distance": 1.0, "tilted": 1}, "option 'tilted' is 1, expected bool"),
    ):
        with pytest.raises(OptionError, match=words):
            make("wall", values)


def test_an_unknown_name_lists_the_choices() -> None:
    assert set(names()) >= BUILT_IN
    with pytest.raises(
        OptionError, match=r"unknown camera 'kinect'; choose from: .*folder, genicam"
    ):
        make("kinect")


def test_options_come_as_a_session_file_has_them() -> None:
    values = {"path": "a/b", "distortion": [0, 0.1, 0, 0, 0], "fx": 500, "loop": True}
    made: Any = make("folder", values)
    assert made._options == FolderOptions(
        Path("a/b"), distortion=(0.0, 0.1, 0.0, 0.0, 0.0), fx=500.0, loop=True
    )
    with pytest.raises(OptionError, match="option 'distortion' is"):
        make("folder", {"path": "a", "distortion": [0, 0]})
    with pytest.raises(OptionError, match=r"option 'fx' is 'wide', expected float \| None"):
        make("folder", {"path": "a", "fx": "wide"})


def test_no_camera_is_imported_before_it_is_used() -> None:
    code = (
        "import sys, rig.cameras, rig.axes; rig.cameras.names();"
        "rig.cameras.make('genicam'); rig.cameras.make('realsense'); rig.cameras.make('zed');"
        "print(sorted({'pyrealsense2', 'harvesters', 'genicam', 'pyzed', 'pymodbus', 'serial',"
        " 'cv2'} & set(sys.modules)))"
    )
    printed = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert printed.stdout.strip() == "[]"


# folder ----------------------------------------------------------------------------------------


def test_replays_a_dataset_in_order(recorded: Dataset) -> None:
    camera = make("folder", {"path": str(recorded.path), "first": 1})
    info = camera.open()
    assert info.camera == recorded.sensor.camera
    assert (info.model, info.depth_scale) == ("analytic", recorded.sensor.depth_scale)
    assert (info.depth_min, info.depth_max) == (0.1, 1.3)
    assert info.noise == (0.0005, 1.0, 0.0)
    before = time.time()
    for frame in recorded.frames[1:]:
        capture = camera.capture(1.0)
        np.testing.assert_array_equal(capture.depth, frame.depth())
        assert capture.depth.dtype == np.float32
        assert before <= capture.stamp <= time.time()
        reason = checking.check(
            capture, info, FrameLimits(holes=0.9), since=before, now=time.time()
        )
        assert reason is None
        before = capture.stamp
    with pytest.raises(CameraError, match="all 3 frames were replayed"):
        camera.capture(1.0)
    camera.close()
    camera.close()
    with pytest.raises(CameraError, match="not open"):
        camera.capture(1.0)
    again = make("folder", {"path": str(recorded.path), "loop": True, "first": 2})
    again.open()
    again.capture(1.0)
    np.testing.assert_array_equal(again.capture(1.0).depth, recorded[0].depth())


def test_replays_bare_images(tmp_path: Path) -> None:
    import cv2

    depth, colour = tmp_path / "depth", tmp_path / "colour"
    depth.mkdir()
    colour.mkdir()
    for number in (2, 10, 1):
        counts = np.full((6, 8), 1000 * number, np.uint16)
        counts[0, 0] = 0
        cv2.imwrite(str(depth / f"frame{number}.png"), counts)
        cv2.imwrite(
            str(colour / f"frame{number}.png"), np.full((6, 8, 3), (1, 2, number), np.uint8)
        )
    options = FolderOptions(depth, rgb=colour, fx=10.0, fy=11.0, cx=3.5, cy=2.5, depth_scale=0.0005)
    camera = FolderCamera(options)
    assert camera.open().camera == Camera(8, 6, 10.0, 11.0, 3.5, 2.5)
    for number in (1, 2, 10):
        capture = camera.capture(1.0)
        assert np.isnan(capture.depth[0, 0])
        np.testing.assert_allclose(capture.depth[1:], 0.5 * number)
        assert capture.rgb is not None
        np.testing.assert_array_equal(capture.rgb[2, 3], [number, 2, 1])
    with pytest.raises(CameraError, match="expected the options fx, fy, cx, cy and depth_scale"):
        FolderCamera(FolderOptions(depth)).open()
    with pytest.raises(CameraError, match=r"no dataset\.json and no"):
        FolderCamera(FolderOptions(tmp_path)).open()
    with pytest.raises(CameraError, match="no such folder"):
        FolderCamera(FolderOptions(tmp_path / "elsewhere")).open()
    with pytest.raises(CameraError, match=r"3 frames, expected more than 3 \(option first\)"):
        FolderCamera(replace(options, first=3)).open()
    with pytest.raises(CameraError, match=r"uint8, expected one channel of 16 bit"):
        FolderCamera(replace(options, path=colour)).open()


# ZED -------------------------------------------------------------------------------------------


def test_zed_names_what_is_missing() -> None:
    try:
        import pyzed.sl  # noqa: F401
    except ImportError:
        with pytest.raises(MissingPackage, match="pyzed, which comes with Stereolabs' ZED SDK"):
            make("zed").open()
    else:
        pytest.skip("the ZED SDK is installed here")


def test_what_the_zed_sdk_gives_becomes_a_capture(recorded: Dataset) -> None:
    """A recorded depth, put as the SDK puts it: float32, NaN occluded, +inf far, -inf near."""
    z = recorded[0].depth()
    z[0, :6] = np.nan
    known = ~np.isnan(z)
    millimetres = (1e3 * z).astype(np.float32)
    holes = np.argwhere(~known)
    for value, (v, u) in zip((np.inf, -np.inf, 0.0, -5.0), holes, strict=False):
        millimetres[v, u] = value
    assert len(holes) >= 6
    for given, unit in ((millimetres, "millimeter"), (millimetres[..., None] / 1e3, "meter")):
        depth = depth_from(given, unit)
        assert depth.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(depth), ~known)
        np.testing.assert_allclose(depth[known], z[known], rtol=2e-7)
    with pytest.raises(CameraError, match="unit 'yard', expected one of millimeter"):
        depth_from(millimetres, "yard")
    with pytest.raises(CameraError, match=r"shape \(4, 4, 3\)"):
        depth_from(np.zeros((4, 4, 3)), "meter")

    bgra = np.arange(4 * 5 * 4, dtype=np.uint8).reshape(4, 5, 4)
    rgb = rgb_from(bgra)
    np.testing.assert_array_equal(rgb[1, 2], bgra[1, 2, [2, 1, 0]])
    bgra[:] = 0  # the SDK writes its next image there
    assert rgb.any()
    assert rgb.flags.c_contiguous
    with pytest.raises(CameraError, match=r"expected \(height, width, 4\) uint8"):
        rgb_from(np.zeros((4, 5, 3), np.uint8))

    # to the microsecond in 2026, where a float of seconds has steps of 0.24 us
    assert stamp_from(1_795_372_963_447_702_600) == pytest.approx(1795372963.4477026, abs=2.5e-7)
    assert stamp_from(1_000_000_000) == 1.0
    assert camera_from(1920, 1080, 1400, 1401, 960.5, 540.5, [0.0] * 12) == Camera(
        1920, 1080, 1400.0, 1401.0, 960.5, 540.5
    )
    with pytest.raises(CameraError, match="rectified image with distortion"):
        camera_from(1920, 1080, 1400, 1401, 960.5, 540.5, [0.1, 0, 0, 0, 0])


# fit to be kept --------------------------------------------------------------------------------

INFO = CameraInfo("m", "s", Camera(8, 6, 10.0, 10.0, 3.5, 2.5), 1e-3, 0.5, 2.0)
LIMITS = FrameLimits()
NOW = 1_795_000_000.0


def frame(**changes: Any) -> Capture:
    depth: NDArray[np.float32] = np.linspace(1, 1.5, 48, dtype=np.float32).reshape(6, 8)
    return replace(Capture(depth, NOW), **changes)


def judged(capture: Capture, before: Capture | None = None, limits: FrameLimits = LIMITS) -> str:
    found = checking.check(capture, INFO, limits, since=NOW - 1, now=NOW + 0.1, before=before)
    return "" if found is None else found


def test_says_what_is_wrong_with_a_frame_in_one_line() -> None:
    good = frame()
    assert judged(good) == ""
    assert judged(good, before=frame(stamp=NOW - 2, depth=good.depth + np.float32(1e-4))) == ""

    holed = good.depth.copy()
    holed[:, :5] = np.nan  # 62.5 %
    assert judged(frame(depth=holed)) == (
        "62.5% of the pixels have no depth, expected at most 60.0%"
    )
    assert judged(frame(depth=holed), limits=FrameLimits(holes=0.625)) == ""
    near = good.depth.copy()
    near[:2] = 0.5  # a third
    assert "33.3% of the depths are at the nearest end of the range, 0.5 m" in judged(
        frame(depth=near)
    )
    far = holed.copy()
    far[0, 5:] = 1.9995  # 3 of the 18 measured are within one count of the end
    far[1, 5] = 2.0
    assert "22.2% of the depths are at the farthest end" in judged(
        frame(depth=far), limits=FrameLimits(holes=0.7)
    )
    for value in (np.inf, -1.0, 0.0, 66.0):
        wrong = good.depth.copy()
        wrong[2, 3] = value
        assert f"depth {value:g} m at pixel (u 3, v 2) and 0 more" in judged(frame(depth=wrong))
    assert "shape (6, 7)" in judged(frame(depth=good.depth[:, :7]))
    assert "float64, expected (6, 8) float32" in judged(frame(depth=good.depth.astype(float)))
    assert "colour of shape (6, 8)" in judged(frame(rgb=np.zeros((6, 8), np.uint8)))
    assert "taken 0.500 s before the rig stood still" in judged(frame(stamp=NOW - 1.5))
    assert "0.900 s in the future" in judged(frame(stamp=NOW + 1))
    assert "stamp is nan" in judged(frame(stamp=np.nan))
    assert "is that of the frame before" in judged(good, before=good)
    stuck = frame(stamp=NOW - 2)
    assert "equals that of the frame before in every pixel" in judged(good, before=stuck)
    assert judged(good, before=stuck, limits=FrameLimits(frozen=False)) == ""
    empty = np.full((6, 8), np.nan, np.float32)
    assert "100.0% of the pixels have no depth" in judged(frame(depth=empty))
    assert judged(frame(depth=empty), limits=FrameLimits(holes=1.0)) == ""
