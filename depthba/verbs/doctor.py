"""The verb ``doctor``: is this machine fit, is this dataset whole?"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from depthba.errors import RunError
from depthba.verbs import DONE, KNOWN_ERROR
from depthba.verbs.output import print_json

if TYPE_CHECKING:
    from depthba.dataset.faults import Fault


@dataclass(frozen=True)
class Arguments:
    """Check this machine, or a dataset.

    Exit status: 0 all is well; 1 a required part is missing, or the dataset has a fault.
    """

    dataset: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="[DATASET]")] = None
    """Folder of a dataset to verify. None: look at this machine."""
    json: bool = False
    """Print one JSON object on stdout in place of text."""


def run(arguments: Arguments) -> int:
    """Check, say what was found, return the exit status."""
    if arguments.dataset is None:
        return _machine(arguments.json)
    return _dataset(arguments.dataset, arguments.json)


def _machine(json: bool) -> int:
    from depthba.verbs.machine import checks

    seen = []
    for check in checks():
        seen.append(check)
        if not json:
            print(f"{'ok' if check.ok else 'missing':<8} {check.name}: {check.text}", flush=True)
    lacking = [check.name for check in seen if check.required and not check.ok]
    if json:
        print_json({"ok": not lacking, "checks": [asdict(check) for check in seen]})
    elif lacking:
        print(f"\nrequired, but missing: {', '.join(lacking)}")
    return KNOWN_ERROR if lacking else DONE


def _dataset(path: Path, json: bool) -> int:
    from depthba.dataset import Dataset, verify

    faults = _no_dataset_but_a_run(path) or verify(path)
    if faults:
        if json:
            print_json({"ok": False, "faults": [asdict(fault) for fault in faults]})
        else:
            for fault in faults:
                frame = "" if fault.frame is None else f", frame {fault.frame}"
                where = f"{fault.file}{frame}"
                print(f"{where}: {fault.text}" if where else fault.text)
            print(f"{path}: {len(faults)} fault{'s' if len(faults) > 1 else ''}")
        return KNOWN_ERROR
    dataset = Dataset.open(path)
    sensor, camera = dataset.sensor, dataset.sensor.camera
    summary = {
        "name": dataset.name,
        "frames": len(dataset),
        "sensor": sensor.model,
        "kind": sensor.kind,
        "size": None if camera is None else [camera.width, camera.height],
        "map_frame": dataset.map_frame,
        "truth": dataset.T_world_camera_true is not None,
        "markers": len(dataset.markers()),
        "warnings": list(dataset.warnings),
    }
    if json:
        print_json({"ok": True, "faults": [], "dataset": summary})
        return DONE
    for warning in dataset.warnings:
        print(f"warning: {warning}")
    size = "" if camera is None else f" of {camera.width} x {camera.height}"
    model = f" from {sensor.model}" if sensor.model else ""
    truth = "with" if summary["truth"] else "without"
    print(
        f"{path}: whole. {dataset.name}: {len(dataset)} {sensor.kind} frames{size}{model}, "
        f"{truth} true poses, {summary['markers']} markers"
    )
    return DONE


def _no_dataset_but_a_run(path: Path) -> list[Fault]:
    """Return the fault of a run's folder, with where its dataset is; of others none."""
    from depthba.convert.exporting import is_run
    from depthba.dataset.faults import Fault
    from depthba.stored_run import Run

    if not is_run(path) or (path / "dataset.json").exists():
        return []
    try:
        where = f"; its own is {Run.open(path).dataset_path}"
    except RunError as error:
        where = f" ({error})"
    return [Fault("", None, f"{path}: a run of depthba, expected a dataset{where}")]
