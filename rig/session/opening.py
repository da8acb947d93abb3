"""Everything that is looked at before anything moves."""

from __future__ import annotations

import concurrent.futures
import contextlib
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from depthba.dataset import is_dataset
from depthba.errors import DatasetError
from rig.cameras.apart import CameraApart
from rig.cameras.camera import CameraInfo
from rig.session.carriers import Carrier, make_carrier
from rig.session.options import Session, plain
from rig.session.planning import Plan, plan
from rig.session.record import stored_plan
from rig.session.workspace import Workspace

SPARE = 16_000_000
"""What the disk must have beyond the frames themselves, bytes."""


@dataclass(frozen=True, eq=False)
class Opened:
    """A rig that is connected and a camera that is open, with what is to be done with them."""

    carrier: Carrier
    camera: CameraApart
    info: CameraInfo
    space: Workspace
    plan: Plan
    begun: bool
    """Whether the dataset is there already."""


@contextlib.contextmanager
def opened(
    session: Session, stored: Session, out: Path, *, rehearsed: bool, move: bool
) -> Iterator[Opened]:
    """Connect the rig, open the camera, plan or take up the plan, look at the disk.

    Args:
        session: as it runs.
        stored: as its file has it, which a rehearsal does not run.
        out: the dataset's folder.
        rehearsed: whether the rig is simulated.
        move: whether the rig may make itself ready, as a gantry that looks for its switches does.

    Raises whatever is in the way: RigError, OptionError, OutOfReach, DatasetError.
    """
    carrier = make_carrier(session.rig, session.motion)
    space = Workspace.of(session, carrier.body)
    begun = is_dataset(out)
    taken_up = stored_plan(out, stored, space, rehearsed) if begun else None
    if not begun:
        _refuse_others(out)
    choice = session.camera
    camera = CameraApart(
        choice.kind,
        plain(choice.options),
        open_timeout=choice.open_timeout,
        hang=choice.hang,
    )
    with contextlib.ExitStack() as stack:
        pool = concurrent.futures.ThreadPoolExecutor(1)
        stack.callback(pool.shutdown, wait=False)
        # Where something is in the way nobody waits for a camera that is still starting.
        stack.callback(camera.end)
        stack.callback(carrier.disconnect)
        opening = pool.submit(camera.open)
        carrier.connect()
        if move:
            carrier.make_ready()
        standing = carrier.state()
        if taken_up is None:
            # A gantry that does not know where it is will stand at 0 once it was homed.
            here = standing.joints if standing.known else np.zeros_like(standing.joints)
            start = here if space.rest is None else space.rest
            taken_up = plan(stored, space, start, lambda: opening.result().camera)
        info = opening.result()
        stack.callback(camera.close)
        _refuse_full_disk(out, info, len(taken_up.joints), session.colour)
        yield Opened(carrier, camera, info, space, taken_up, begun)


def _refuse_others(out: Path) -> None:
    """A folder with something else in it is not written to; found out before anything is begun."""
    try:
        if out.exists() and not out.is_dir():
            raise DatasetError(f"{out}: not a folder, expected none or an empty one")
        mine = ("depth", "cloud", "frames.jsonl", "poses_measured.txt")
        others = [e.name for e in out.iterdir() if e.name not in mine] if out.is_dir() else []
        others = [name for name in others if not name.endswith(".part")]
    except OSError as error:
        raise DatasetError(f"{out}: {error.strerror}, expected a folder to write to") from None
    if others:
        raise DatasetError(
            f"{out}: not empty ({others[0]}), expected no folder, an empty one, or one of this"
            " session"
        )


def _refuse_full_disk(out: Path, info: CameraInfo, frames: int, colour: bool) -> None:
    """Frames are counted as they are before they are compressed."""
    pixels = info.camera.width * info.camera.height
    need = frames * pixels * (5 if colour else 2) + SPARE
    there = next(folder for folder in (out.resolve(), *out.resolve().parents) if folder.exists())
    free = shutil.disk_usage(there).free
    if free < need:
        raise DatasetError(
            f"{there}: {free / 1e6:.0f} MB free, expected {need / 1e6:.0f} MB for {frames} frames"
        )
