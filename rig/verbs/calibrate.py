"""The verb ``calibrate``: where the camera sits on the flange."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from depthba.errors import DatasetError, OptionError
from depthba.verbs import DONE, NOT_TO_BE_TRUSTED
from depthba.verbs.output import angle, length, note, print_json
from depthba.verbs.progress import Bar
from rig.hand_eye.board.calibration import BoardOptions
from rig.hand_eye.depth.calibration import Options

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from depthba.dataset import Dataset
    from depthba.result import Iteration
    from rig.hand_eye.record import HandEyeRecord


@dataclass(frozen=True)
class Arguments:
    """Hand-eye calibration: T_flange_camera, with what is known of it.

    From images of a board, or with --from-depth from the depth frames of any scene. The verdict
    comes before the numbers. Exit status: 0 motions and data fix the transform; 3 they do not, or
    it did not settle.
    """

    dataset: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="DATASET")] = None
    """Folder of the dataset; its frames need flange poses. Needed but for --print-board."""
    board: str | None = None
    """Inner corners along x and y and the side of a square, m: 10x7x0.03, charuco:10x7x0.03. None:
    as calibration.json says."""
    from_depth: bool = False
    """Without a board: from the depth frames of any scene that is not flat and bare."""
    start: Path | None = None
    """With --from-depth: JSON file with the T_flange_camera to start from. None: the dataset's."""
    combine: Path | None = None
    """A hand_eye.json of the same mounting by the other road: the result is of both together, each
    weighed by what it knows. Two that disagree far beyond their sigmas are refused."""
    apply: bool = False
    """Write poses_arm.txt, the camera poses by the arm, into the dataset."""
    from_: Annotated[Path | None, tyro.conf.arg(name="from", metavar="FILE")] = None
    """With --apply: take this hand_eye.json and calibrate nothing."""
    print_board: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Calibrate nothing: draw the board of --board, to be printed in its true size, into a .pdf or
    .png."""
    page: str = "A4"
    """With --print-board: the sheet, A0 to A5, letter, legal or tabloid, or its width and height in
    mm, as 400x300."""
    out: Path | None = None
    """Folder for the run, new or empty. None: logs/<name>-<yyyymmdd-hhmmss>."""
    overwrite: bool = False
    """Write into the folder even where it holds an earlier run."""
    json: bool = False
    """Print one JSON object on stdout in place of text."""
    with_board: BoardOptions = field(default_factory=BoardOptions)
    without_board: Options = field(default_factory=Options)


@dataclass(frozen=True)
class Found:
    """What a road found, before it is written."""

    record: HandEyeRecord
    content: dict[str, Any]
    """Of hand_eye.json."""
    lines: list[str]
    """For people."""


def run(arguments: Arguments) -> int:
    """Calibrate, write the run folder, say how it went; return the exit status."""
    from depthba.dataset import Dataset
    from depthba.run_folder import RunFolder, default_path, link_latest
    from depthba.verbs.register import removed_on_failure
    from rig.hand_eye.record import read_record, write_content

    if arguments.print_board is not None:
        return _print_board(arguments, arguments.print_board)
    if arguments.dataset is None:
        raise OptionError("no dataset, expected the folder of one (or --print-board FILE)")
    if arguments.from_ is not None and not arguments.apply:
        raise OptionError(f"--from {arguments.from_}: expected --apply beside it")
    if arguments.from_depth and arguments.board is not None:
        raise OptionError(f"--board {arguments.board}: expected no --from-depth beside it")
    dataset = Dataset.open(arguments.dataset)
    for warning in dataset.warnings:
        note(f"warning: {warning}")
    if arguments.from_ is not None:
        return _apply(dataset, read_record(arguments.from_, "--from"), arguments.json)
    other = None if arguments.combine is None else read_record(arguments.combine, "--combine")
    start = _start(dataset, arguments.start) if arguments.from_depth else None
    path = default_path(f"{dataset.name}-hand-eye") if arguments.out is None else arguments.out
    with removed_on_failure(path, arguments.overwrite):
        folder = RunFolder.create(path, overwrite=arguments.overwrite)
        if start is not None:
            found = _from_depth(arguments, dataset, start, folder.path)
        else:
            found = _with_board(arguments, dataset, folder.path)
        if other is not None and arguments.combine is not None:
            found = _combined(found, other, arguments.combine)
        write_content(found.content, folder.path)
        link_latest(folder.path)
    if arguments.apply and found.record.trusted:
        found.content["applied"] = str(_write_poses(dataset, found.record))
    if arguments.json:
        print_json({**found.content, "run": str(path)})
    else:
        print("\n".join(found.lines))
    return DONE if found.record.trusted else NOT_TO_BE_TRUSTED


def _print_board(arguments: Arguments, path: Path) -> int:
    from depthba.board_print import layout, write
    from depthba.boards import Board

    if arguments.board is None:
        raise OptionError(f"--print-board {path}: expected --board beside it, as 10x7x0.03")
    if arguments.dataset is not None:
        raise OptionError(f"--print-board {path}: expected no dataset beside it")
    sheet = layout(Board.parse(arguments.board), arguments.page)
    write(sheet, path, overwrite=arguments.overwrite)
    if arguments.json:
        width, height = sheet.page
        print_json({"file": str(path), "page_mm": [width, height], "board": sheet.board.json()})
    else:
        print(f"{path}: print it at 100 %, not fitted to the page; measure the bar of 100 mm")
    return DONE


def _from_depth(
    arguments: Arguments, dataset: Dataset, start: NDArray[np.float64], run: Path
) -> Found:
    from rig.hand_eye.depth.calibration import calibrate
    from rig.hand_eye.depth.report import content, record_of, text

    with Bar(dataset.name, "reading frames") as bar:
        result = calibrate(dataset, start, arguments.without_board, lambda i: _show(bar, i))
    return Found(record_of(result), content(result, dataset), text(result, dataset, run))


def _with_board(arguments: Arguments, dataset: Dataset, run: Path) -> Found:
    from rig.hand_eye.board import report
    from rig.hand_eye.board.calibration import calibrate
    from rig.hand_eye.board.detection import board_of, detect

    board = board_of(dataset, arguments.board)
    options = arguments.with_board
    with Bar(dataset.name, "reading frames") as bar:

        def looking(done: int, count: int) -> None:
            if bar.drawn or done == 0:
                bar.show(f"looking for the board, {done} of {count} frames", done, count)

        detected = detect(dataset, board, options.mount, looking)
        bar.show("estimating", 0.0, None)
        alike = board.kind == "checkerboard" and (board.columns + board.rows) % 2 == 0
        result = calibrate(detected.observations, options, board.square_m, alike)
        lines = report.text(result, dataset, run, detected.without)
        bar.show("drawing", 0.0, None)
        report.write(result, dataset, lines, run)
    content = report.content(result, dataset, board, detected.without)
    return Found(report.record_of(result), content, lines)


def _combined(found: Found, other: HandEyeRecord, path: Path) -> Found:
    from rig.hand_eye.combine import combine, combined_content, combined_line, combined_record

    combined = combine(found.record, other)
    record = combined_record(found.record, other, combined)
    content = combined_content(found.content, record, combined, path)
    return Found(record, content, [*found.lines, combined_line(record, combined)])


def _apply(dataset: Dataset, record: HandEyeRecord, as_json: bool) -> int:
    path = _write_poses(dataset, record)
    if as_json:
        print_json({"applied": str(path), "frames": len(dataset), "method": record.method})
    return DONE


def _write_poses(dataset: Dataset, record: HandEyeRecord) -> Path:
    from rig.hand_eye.apply import apply

    applied = apply(dataset, record)
    note(f"{dataset.name}: {applied.path} holds T_{applied.world}_camera of {len(dataset)} frames")
    return applied.path


def _start(dataset: Dataset, path: Path | None) -> NDArray[np.float64]:
    from rig.hand_eye.record import read_transform

    if path is not None:
        return read_transform(path)
    if dataset.T_flange_camera is None:
        raise DatasetError(
            f"{dataset.path}: dataset.json has no T_flange_camera to start from, expected it there "
            "or in the file that --start names"
        )
    return dataset.T_flange_camera


def _show(bar: Bar, iteration: Iteration) -> None:
    moved = f"step {length(iteration.step_t)}, {angle(iteration.step_r)}"
    step = moved if iteration.accepted else "step refused"
    bar.show(
        f"map of {length(iteration.spacing)}: cost {iteration.cost:.6g}, {step}, "
        f"sigma {length(iteration.sigma)}",
        0.0,
        None,
    )
