"""The verb ``calibrate``: where the camera sits on the flange."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from depthba.errors import DatasetError, OptionError
from depthba.verbs import DONE, NOT_TO_BE_TRUSTED
from depthba.verbs.output import angle, length, note, print_json
from depthba.verbs.progress import Bar
from rig.hand_eye.depth.calibration import Options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from depthba.dataset import Dataset
    from rig.hand_eye.depth.descent import Iteration


@dataclass(frozen=True)
class Arguments:
    """Hand-eye calibration: T_flange_camera, with what is known of it.

    The verdict comes before the numbers. Exit status: 0 motions and data fix the transform; 3 they
    do not, or it did not settle.
    """

    dataset: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")]
    """Folder of the dataset; its frames need flange poses."""
    from_depth: bool = False
    """Without a board: from the depth frames of any scene that is not flat and bare."""
    start: Path | None = None
    """JSON file with the T_flange_camera to start from. None: the dataset's."""
    out: Path | None = None
    """Folder for the run, new or empty. None: logs/<name>-<yyyymmdd-hhmmss>."""
    overwrite: bool = False
    """Write into the folder even where it holds an earlier run."""
    json: bool = False
    """Print one JSON object on stdout in place of text."""
    options: Options = field(default_factory=Options)


def run(arguments: Arguments) -> int:
    """Calibrate, write the run folder, say how it went; return the exit status."""
    from depthba import durable
    from depthba.dataset import Dataset
    from depthba.run_folder import RunFolder, default_path, link_latest
    from depthba.verbs.register import removed_on_failure
    from rig.hand_eye.depth.calibration import calibrate
    from rig.hand_eye.depth.report import FILE, content, text

    if not arguments.from_depth:
        raise OptionError(
            "calibrate with a board is not there yet, expected --from-depth: "
            "calibration from the depth frames alone"
        )
    dataset = Dataset.open(arguments.dataset)
    for warning in dataset.warnings:
        note(f"warning: {warning}")
    start = _start(dataset, arguments.start)
    path = default_path(f"{dataset.name}-hand-eye") if arguments.out is None else arguments.out
    with removed_on_failure(path, arguments.overwrite):
        folder = RunFolder.create(path, overwrite=arguments.overwrite)
        with Bar(dataset.name, "reading frames") as bar:
            result = calibrate(dataset, start, arguments.options, lambda i: _show(bar, i))
        found = content(result, dataset)
        durable.write_json(folder.path / FILE, found)
        link_latest(folder.path)
    if arguments.json:
        print_json({**found, "run": str(path)})
    else:
        print("\n".join(text(result, dataset, path)))
    return DONE if result.trusted else NOT_TO_BE_TRUSTED


def _start(dataset: Dataset, path: Path | None) -> NDArray[np.float64]:
    from rig.hand_eye.depth.report import read_transform

    if path is not None:
        return read_transform(path)
    if dataset.T_flange_camera is None:
        raise DatasetError(
            f"{dataset.path}: dataset.json has no T_flange_camera to start from, expected it there "
            "or in the file that --start names"
        )
    return dataset.T_flange_camera


def _show(bar: Bar, iteration: Iteration) -> None:
    import numpy as np

    t, r = (float(np.linalg.norm(iteration.step[k])) for k in (slice(3), slice(3, 6)))
    step = f"step {length(t)}, {angle(r)}" if iteration.accepted else "step refused"
    bar.show(
        f"map of {length(iteration.spacing)}: cost {iteration.cost:.6g}, {step}, "
        f"sigma {length(iteration.sigma)}",
        0.0,
        None,
    )
