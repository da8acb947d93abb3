"""The GenICam camera on the simulator producer that the genicam wheel brings."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from depthba.camera import Camera
from rig.cameras.genicam import GenicamCamera, GenicamOptions
from rig.cameras.scan3d import Part, Scan3d, colour_of, depth_of
from rig.errors import CameraError, CameraTimeout

genicam = pytest.importorskip("genicam", reason="genicam has no wheel for this platform")
pytest.importorskip("harvesters", reason="the extra cameras is not installed")

PRODUCER = Path(genicam.__file__).with_name("viky.cti")
OPTIONS = GenicamOptions(
    PRODUCER, device="VikyTL_DEV_red", fx=400.0, fy=401.0, cx=199.5, cy=198.5, depth_min=0.01
)


def test_range_images_come_as_depth() -> None:
    """A ball that bounces: z some millimetres above 0 within it, 0 and so nothing elsewhere."""
    camera = GenicamCamera(OPTIONS)
    info = camera.open()
    assert info.camera == Camera(400, 400, 400.0, 401.0, 199.5, 198.5)
    assert "Viky" in info.model
    assert info.settings["component"] == "Range"
    captures = []
    for _ in range(3):
        before = time.time()
        capture = camera.capture(20.0)
        assert before <= capture.stamp <= time.time()
        captures.append(capture)
    for capture in captures:
        seen = ~np.isnan(capture.depth)
        assert 20 <= seen.sum() <= 100 * 100
        depth = capture.depth[seen]
        assert depth.min() > 0
        assert depth.max() < 1.0
        # one blob, where the colour image shows something else than its ground
        rows, columns = np.nonzero(seen)
        assert np.ptp(rows) < 120
        assert np.ptp(columns) < 120
        assert capture.rgb is not None
        assert capture.rgb.shape == (400, 400, 3)
        ball = np.median(capture.rgb[seen], axis=0)
        assert np.abs(ball - np.median(capture.rgb[~seen], axis=0)).max() > 50
    assert not np.array_equal(captures[0].depth, captures[-1].depth, equal_nan=True)
    camera.close()
    camera.close()
    with pytest.raises(CameraError, match="not open"):
        camera.capture(1.0)
    again = GenicamCamera(replace(OPTIONS, device="VikyTL_DEV_blue"))
    again.open()
    assert again.capture(20.0).depth.shape == (400, 400)
    again.close()


def test_features_are_set_and_time_runs_out() -> None:
    slow = GenicamCamera(replace(OPTIONS, features=(("AcquisitionFrameRate", 1.0),)))
    assert slow.open().settings["AcquisitionFrameRate"] == 1.0
    with pytest.raises(CameraTimeout, match=r"no frame within 0\.1 s"):
        slow.capture(0.1)
    slow.close()


def test_says_what_is_there_and_what_was_expected(monkeypatch: pytest.MonkeyPatch) -> None:
    for options, words in (
        (replace(OPTIONS, device=None), "cameras there: VikyTL_DEV_red, .*; expected one, or"),
        (replace(OPTIONS, device="me"), "no cameras are called 'me', expected one of: VikyTL"),
        (replace(OPTIONS, producer=Path("/no/such.cti")), "no such file, expected the vendor's"),
        (replace(OPTIONS, fx=None), "does not tell its intrinsics, expected the options fx"),
        (replace(OPTIONS, component="Disparity"), "ComponentSelector cannot be set to 'Disparity'"),
        (replace(OPTIONS, features=(("Shutter", 1.0),)), "the camera has no feature Shutter"),
        (replace(OPTIONS, component="Intensity"), "Scan3dCoordinateSelector cannot be set"),
        (
            replace(OPTIONS, features=(("AcquisitionFrameRate", 0.5),)),
            "AcquisitionFrameRate cannot be set to 0.5: .* greater than or equal 1",
        ),
    ):
        camera = GenicamCamera(options)
        with pytest.raises(CameraError, match=words) as caught:
            camera.open()
        assert "\n" not in str(caught.value)
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    with pytest.raises(CameraError, match=r"GENICAM_GENTL64_PATH names no folder with a \.cti"):
        GenicamCamera(replace(OPTIONS, producer=None)).open()
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(PRODUCER.parent))
    camera = GenicamCamera(replace(OPTIONS, producer=None))
    camera.open()
    camera.close()


def test_numbers_become_depth_in_every_layout() -> None:
    z = np.array([[1000, 65535, 20], [0, 500, 1500]], np.uint16)
    scan = Scan3d(scale=0.1, offset=5.0, invalid=65535.0, metres=1e-3)
    expected = (z * 0.1 + 5.0) / 1e3
    expected[0, 1] = np.nan
    x = np.full_like(z, 7)
    size = {"width": 3, "height": 2}
    for name, data in (
        ("Coord3D_C16", z.ravel()),
        ("Coord3D_ABC16", np.stack([x, x, z], axis=-1).ravel()),
        ("Coord3D_ABC16_Planar", np.stack([x, x, z]).ravel()),
        ("Coord3D_AC16", np.stack([x, z], axis=-1).ravel()),
        ("Coord3D_AC16_Planar", np.stack([x, z]).ravel()),
    ):
        parts = [
            Part("Mono8", **size, data=np.zeros(6, np.uint8)),
            Part("Coord3D_A16", **size, data=x.ravel()),
            Part(name, **size, data=data),
        ]
        depth = depth_of(parts, scan)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, expected, rtol=1e-6)
    floats = Part("Coord3D_C32f", 3, 1, np.array([1.0, np.nan, -2.0], np.float32))
    np.testing.assert_allclose(
        depth_of([floats], Scan3d(metres=0.0254)), [[0.0254, np.nan, np.nan]]
    )
    # a flag that is not set: the number counts as any other
    assert not np.isnan(depth_of([Part("Coord3D_C16", 3, 2, z.ravel())], Scan3d())[0, 1])
    with pytest.raises(CameraError, match="with 5 numbers, expected 6"):
        depth_of([Part("Coord3D_C16", 3, 2, np.zeros(5))], scan)
    with pytest.raises(CameraError, match="nothing came, expected a Coord3D format"):
        depth_of([], scan)

    pixels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    for name, data, order in (
        ("RGBa8", pixels, [0, 1, 2]),
        ("BGRa8", pixels, [2, 1, 0]),
        ("BGR8", np.ascontiguousarray(pixels[..., :3]), [2, 1, 0]),
        ("Mono8", np.ascontiguousarray(pixels[..., 0]), [0, 0, 0]),
    ):
        rgb = colour_of([Part(name, **size, data=data.ravel())], (2, 3))
        assert rgb is not None
        np.testing.assert_array_equal(rgb, pixels[..., order])
    assert colour_of([Part("RGB8", **size, data=pixels.ravel())], (3, 2)) is None
