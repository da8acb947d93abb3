"""Several schedules, of which the one counts that leaves the most points on planes.

Which voxels take frames in depends on the scene's relief and on the start's error, and neither is
known. But where frames fit, flat pieces stay flat with all frames in them, and where they do not,
planes are lost: the share of points on planes tells without truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.errors import OptionError
from eval.methods.balm2.clusters import Floats
from eval.methods.balm2.schedule import Registered, Schedule, plane_share, register, thinned_clouds
from eval.methods.method import MethodError, Stopwatch


def register_best(
    clouds: Sequence[NDArray[np.floating]],
    T_world_camera: Floats,
    schedules: Sequence[Schedule],
    voxel: float,
    enough: float,
    watch: Stopwatch,
    say: Callable[[str], None] = lambda _: None,
) -> Registered:
    """Register frames by one schedule after the other, each from the start.

    Args:
        clouds: per frame (n, 3), sensor frame, m.
        T_world_camera: (N, 4, 4), the start.
        schedules: to try, in this order.
        voxel: edge of the root voxels in which all are judged, m.
        enough: share of points on planes with which no other schedule is tried.
        watch: is charged with the stages "thin", "planes" and "solve".
        say: told where it is.

    Raises:
        MethodError: no schedule led anywhere.

    """
    best, best_share, failures = None, -1.0, []
    with watch("thin"):
        judged = thinned_clouds(clouds, max(schedules[0].thinned, voxel / 40.0))
    search = replace(schedules[0].search, size=voxel)
    for schedule in schedules:
        try:
            found = register(clouds, T_world_camera, schedule, watch, say)
        except (MethodError, OptionError) as error:  # frames that flew off leave too many voxels
            failures.append(str(error))
            continue
        with watch("planes"):
            T = np.asarray(se3.inverse(found.T_world_camera[0]) @ found.T_world_camera)
            share = plane_share(judged, T, search)
        if share > best_share:
            best, best_share = found, share
        if share >= enough:
            break
    if best is None:
        raise MethodError(failures[0])
    return best
