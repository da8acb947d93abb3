"""The tf tree of a bag: where one frame was in another at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from depthba import se3
from depthba.convert.bags.stores import Store
from depthba.convert.pose_files import Poses
from depthba.errors import DatasetError

Array = NDArray[np.float64]

MOVING, FIXED = ("/tf", "tf"), ("/tf_static", "tf_static")


@dataclass
class _Edge:
    parent: str
    fixed: bool
    stamps: list[float] = field(default_factory=list)
    T_parent_child: list[Array] = field(default_factory=list)


class Tree:
    """Who hangs from whom."""

    def __init__(self, store: Store, path: Path) -> None:
        """Read all transforms of a bag."""
        self._path = path
        edges: dict[str, _Edge] = {}
        for topic, _, message in store.messages([*MOVING, *FIXED]):
            for one in message.transforms:
                child, parent = _plain(one.child_frame_id), _plain(one.header.frame_id)
                edge = edges.setdefault(child, _Edge(parent, topic in FIXED))
                if edge.parent != parent:
                    raise DatasetError(
                        f"{path}: tf: {child} hangs from {edge.parent} and from {parent}, "
                        "expected a tree"
                    )
                edge.stamps.append(seconds(one.header.stamp))
                edge.T_parent_child.append(_transform(one.transform))
        self._edges = edges
        self._poses = {
            child: Poses(path, np.array(edge.T_parent_child), np.array(edge.stamps))
            for child, edge in edges.items()
        }

    def __bool__(self) -> bool:
        """Tell whether there is any transform."""
        return bool(self._edges)

    def chain(self, frame: str, fixed_frame: str | None) -> tuple[str, ...]:
        """Return the frames from one up to below the fixed frame, or to below the root.

        Raises:
            DatasetError: the one is not in the tree, or not below the fixed frame.

        """
        frame = _plain(frame)
        way, up = [], frame
        while up in self._edges and (fixed_frame is None or up != _plain(fixed_frame)):
            if up in way:
                raise DatasetError(f"{self._path}: tf: {up} hangs from itself")
            way.append(up)
            up = self._edges[up].parent
        if not way or (fixed_frame is not None and up != _plain(fixed_frame)):
            known = ", ".join(sorted({*self._edges, *(e.parent for e in self._edges.values())}))
            below = f"below {fixed_frame} " if fixed_frame is not None else ""
            raise DatasetError(f"{self._path}: tf: {frame!r} is not {below}in the tree of {known}")
        return tuple(way)

    def root(self, chain: tuple[str, ...]) -> str:
        """Return the frame that a chain hangs from."""
        return self._edges[chain[-1]].parent

    def moves(self, chain: tuple[str, ...]) -> bool:
        """Tell whether anything of a chain is more than a fixed transform."""
        return any(not self._edges[child].fixed for child in chain)

    def at(self, chain: tuple[str, ...], stamp: float, max_gap: float) -> Array | None:
        """Return T_root_frame (4, 4) of a chain at a stamp, s; None where tf does not reach."""
        T: Array = np.eye(4)
        for child in chain:
            edge = self._edges[child]
            link = edge.T_parent_child[-1] if edge.fixed else self._poses[child].at(stamp, max_gap)
            if link is None:
                return None
            T = link @ T
        return T


def seconds(stamp: Any) -> float:
    """Return the seconds of a message's stamp."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _transform(message: Any) -> Array:
    t, q = message.translation, message.rotation
    return se3.from_quaternion([t.x, t.y, t.z], [q.x, q.y, q.z, q.w])


def _plain(frame: str) -> str:
    return frame.lstrip("/")
