"""No name and no link in a source leads out of it, unless that is asked for."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from depthba.convert import Reading, importing, registry
from depthba.dataset import Dataset
from depthba.errors import DatasetError


def written(dataset: Dataset, kind: str, path: Path) -> Path:
    write = registry.named(kind).write
    assert write is not None
    write(dataset, dataset.T_world_camera_measured, path)
    return path


@pytest.mark.parametrize("absolute", [False, True], ids=["dots", "absolute"])
def test_a_name_that_leads_out_is_refused(
    depth_set: Dataset, tmp_path: Path, absolute: bool
) -> None:
    tum = written(depth_set, "tum-rgbd", tmp_path / "tum")
    first = sorted((tum / "depth").iterdir())[0]
    away = first.rename(tmp_path / first.name)
    name = str(away) if absolute else f"../{away.name}"
    listing = (tum / "depth.txt").read_text()
    (tum / "depth.txt").write_text(listing.replace(f"depth/{first.name}", name))
    with pytest.raises(DatasetError, match=r"depth\.txt: .* leads out of .*, expected .*--outside"):
        importing.read(tum, Reading())
    assert len(importing.read(tum, Reading(outside=True)).frames) == len(depth_set)


def test_nerfstudio_names_stay_inside_too(depth_set: Dataset, tmp_path: Path) -> None:
    file = written(depth_set, "nerfstudio", tmp_path / "nerf") / "transforms.json"
    raw = json.loads(file.read_text())
    raw["frames"][1]["depth_file_path"] = "/etc/hostname"
    file.write_text(json.dumps(raw))
    with pytest.raises(DatasetError, match=r"transforms\.json: '/etc/hostname' leads out of"):
        importing.read(tmp_path / "nerf", Reading())


@pytest.mark.skipif(not hasattr(os, "symlink"), reason="needs links")
@pytest.mark.parametrize("folder", [False, True], ids=["file", "folder"])
def test_a_link_that_leads_out_is_refused(depth_set: Dataset, tmp_path: Path, folder: bool) -> None:
    scan = written(depth_set, "scannet", tmp_path / "scan")
    inner = scan / "depth" if folder else scan / "pose" / "1.txt"
    inner.rename(tmp_path / "elsewhere")
    inner.symlink_to(tmp_path / "elsewhere", target_is_directory=folder)
    with pytest.raises(DatasetError, match=r"a link out of .*, expected .*--outside"):
        importing.read(scan, Reading())
    assert len(importing.read(scan, Reading(outside=True)).frames) == len(depth_set)


def test_a_link_within_a_source_is_none_of_this(depth_set: Dataset, tmp_path: Path) -> None:
    scan = written(depth_set, "scannet", tmp_path / "scan")
    (scan / "pose" / "1.txt").rename(scan / "one.txt")
    (scan / "pose" / "1.txt").symlink_to("../one.txt")
    (tmp_path / "link").symlink_to(scan)
    assert len(importing.read(tmp_path / "link", Reading()).frames) == len(depth_set)
