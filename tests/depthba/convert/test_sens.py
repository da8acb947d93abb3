"""ScanNet's own file of a scan."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from depthba.convert import Reading, importing
from depthba.errors import DatasetError
from tests.depthba.convert import sens_file, small_scene
from tests.depthba.convert.small_scene import LENS, poses

HEAD = 4 + 8 + 15 + 4 * 64 + 36


@pytest.mark.parametrize("packing", [sens_file.RAW, sens_file.ZLIB])
def test_a_scan_is_read(packing: int, tmp_path: Path) -> None:
    sens_file.write(tmp_path / "scene0000_00.sens", packing, lost=(2,))
    for source in (tmp_path, tmp_path / "scene0000_00.sens"):
        recording = importing.read(source, Reading())
        assert recording.format == "sens"
    here = [0, 1, 3, 4, 5]
    assert [frame.name for frame in recording.frames] == [f"frame {k}" for k in here]
    assert "tracking was lost (frame 2)" in recording.notes[0]
    # to the single precision that the file has
    assert_allclose(recording.T_world_camera, poses()[here], rtol=0, atol=1e-6)
    assert_allclose([f.stamp for f in recording.frames], 5 + 0.033 * np.array(here), atol=1e-9)
    frame = recording.frames[3]
    assert frame.camera is not None and frame.depth is not None and frame.rgb is not None
    assert (frame.camera.fx, frame.camera.fy, frame.camera.cx, frame.camera.cy) == LENS
    assert_allclose(frame.depth(), small_scene.depth(poses()[4]), atol=1e-9)
    assert np.abs(frame.rgb().astype(int) - 160).max() <= 2
    imported = importing.into_dataset(recording, tmp_path / "out", Reading())
    assert_allclose(imported.dataset[3].depth(), small_scene.depth(poses()[4]), atol=1e-9)


def test_extrinsics_that_are_not_applied_are_told(tmp_path: Path) -> None:
    extra = np.eye(4)
    extra[0, 3] = 0.05
    sens_file.write(tmp_path / "a.sens", sens_file.RAW, extra=extra)
    notes = importing.read(tmp_path / "a.sens", Reading()).notes
    assert "the extrinsics of depth are not applied: poses are taken as those of depth" in notes


def test_what_is_no_scan_is_refused_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / "a.sens"
    sens_file.write(path, sens_file.ZLIB)
    whole = path.read_bytes()
    first = HEAD + 64 + 32
    size = struct.unpack_from("<QQ", whole, first - 16)
    for data, told in (
        (b"", "ends within its head"),
        (struct.pack("<I", 3) + whole[4:], "version 3, expected 4"),
        (whole[:5] + b"\xff\xff" + whole[7:], "a sensor's name of"),
        (whole[: HEAD - 32] + struct.pack("<i", 2) + whole[HEAD - 28 :], "packed in way 2"),
        (whole[: HEAD + 200], "ends within frame 0 of 6"),
        (whole[: first + size[0]] + b"?" * size[1] + whole[first + sum(size) :], "packed by zlib"),
    ):
        path.write_bytes(data)
        with pytest.raises(DatasetError, match=f"a.sens: .*{told}") as caught:
            importing.read(path, Reading())
        assert "\n" not in str(caught.value)
