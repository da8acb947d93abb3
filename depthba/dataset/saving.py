"""Writing a dataset anew: what `depthba.dataset.Dataset.save` does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from depthba import trajectory
from depthba.dataset.listing import pose_file
from depthba.dataset.writing import DatasetWriter
from depthba.errors import DatasetError

if TYPE_CHECKING:
    from depthba.dataset.reading import Dataset


def save(dataset: Dataset, path: Path) -> Dataset:
    """Write the frames of a dataset with all that is known of them into a new folder.

    Raises:
        DatasetError: crops and masks leave nothing; or see `DatasetWriter`.

    """
    header = {**dataset.header, "name": dataset.name, "map_frame": dataset.map_frame}
    header["sensor"] = dict(header["sensor"])
    scale = min((frame.sensor.depth_scale or 0.0 for frame in dataset), default=0.0)
    if scale:  # merged sets may differ: the finest holds them all
        header["sensor"]["depth_scale"] = scale
        for bound in ("depth_min", "depth_max"):  # the frames have been cut by their own already
            header["sensor"].pop(bound, None)
            if len({getattr(frame.sensor, bound) for frame in dataset}) == 1:
                value = getattr(dataset[0].sensor, bound)
                header["sensor"] |= {} if value is None else {bound: value}
    writer = DatasetWriter.create(path, header)
    truth = dataset.T_world_camera_true
    left = False
    for row, frame in enumerate(dataset):
        depth = frame.sensor.kind == "depth"
        z = frame.depth() if depth else None
        cloud = None if depth else frame.points()
        left |= (
            bool(np.isfinite(z).any()) if z is not None else bool(cloud is not None and len(cloud))
        )
        writer.add_frame(
            stamp=frame.stamp,
            T_world_camera=frame.T_world_camera,
            depth=z,
            cloud=cloud,
            rgb=frame.rgb() if depth else None,
            T_world_camera_true=None if truth is None else truth[row],
            joints=frame.joints,
            T_base_flange=frame.T_base_flange,
        )
    if not left and any(frame.cuts for frame in dataset):
        raise DatasetError(
            f"{dataset.path}: the crop or the mask leaves nothing, expected ranges in metres in "
            "which there are points: a region of interest in the map frame, depth from the camera"
        )
    stored = {frame.id: new for frame, new in zip(dataset, writer.ids, strict=True)}
    if markers := dataset.markers():
        writer.write_markers(
            [
                type(m)(m.name, m.p_world, tuple((stored[i], p) for i, p in m.observations))
                for m in markers
            ]
        )
    if (calibration := dataset.calibration()) is not None:
        writer.write_calibration(calibration)
    roots = {frame.root for frame in dataset}
    for file in sorted(dataset.path.glob(pose_file("*"))):
        name = file.name[len("poses_") : -len(".txt")]
        if name not in ("measured", "true") and all((r / file.name).exists() for r in roots):
            trajectory.write_tum(path / file.name, dataset.stamps, dataset.poses(name))
    return type(dataset).open(path)
