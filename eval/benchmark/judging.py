"""Judges what a method found: against truth, markers and map where there are any, and by itself."""

from __future__ import annotations

import numpy as np

from depthba import se3
from depthba.picture import CELL_SPACINGS
from eval.marker_metrics import marker_metrics
from eval.methods import Estimate, Task
from eval.metrics import Metric, consistency, pose_metrics
from eval.self_consistency import agreement, map_rotation


def judge(task: Task, estimate: Estimate) -> list[Metric]:
    """Return the figures of an estimate, frame 0 put onto its true pose where that is known."""
    dataset, T = task.dataset, estimate.T_world_camera
    T_true = dataset.T_world_camera_true
    found: list[Metric] = []
    reference = dataset.T_world_camera_measured if T_true is None else T_true
    aligned = se3.align_first(T, reference)
    if T_true is not None:
        found += pose_metrics(T, T_true)
        if estimate.covariance is not None:
            nees = consistency(T, T_true, estimate.covariance).nees_per_dof
            found.append(Metric("nees_per_dof", "1", "one", nees))
    found += marker_metrics(dataset.markers(), dataset.ids, aligned)
    cell = CELL_SPACINGS * task.spacing
    points = [p[np.isfinite(p).all(axis=1)] for p in task.clouds]
    found += agreement(points, aligned, map_rotation(dataset, reference), cell).metrics()
    return found
