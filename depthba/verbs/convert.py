"""The verb ``convert``: other people's data in, datasets and runs out to other people's tools."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from depthba.convert import Reading
from depthba.errors import DatasetError, OptionError
from depthba.verbs import DONE, WRONG_USAGE
from depthba.verbs.output import note, print_json
from depthba.verbs.register import removed_on_failure

if TYPE_CHECKING:
    from depthba.convert.importing import Imported
    from depthba.convert.recording import Format
    from depthba.convert.results.outcome import ResultFormat
    from depthba.dataset import Dataset


@dataclass(frozen=True)
class Choice:
    """What of the frames is taken along."""

    roi: tuple[float, float, float, float, float, float] | None = None
    """Region of interest xmin xmax ymin ymax zmin zmax in the map frame, m."""
    height_range: tuple[float, float] | None = None
    """Lowest and highest height in the map frame, m."""
    depth_range: tuple[float, float] | None = None
    """Least and greatest depth (z in the sensor frame), m."""
    every: int = 1
    """Take every n-th frame alone, from the first on."""
    mask: str | None = None
    """Image, of which pixels that are 0 are left out of every frame; or a folder of one image a
    frame, named as its depth image."""

    def applied(self, dataset: Dataset) -> Dataset:
        """Return what is taken of a dataset."""
        if self.every != 1:
            dataset = dataset.subsample(self.every)
        if self.roi or self.height_range or self.depth_range:
            dataset = dataset.crop(self.roi, heights=self.height_range, depths=self.depth_range)
        return dataset if self.mask is None else dataset.masked(self.mask)

    @property
    def cuts(self) -> bool:
        """Whether anything but whole frames is left out."""
        return replace(self, every=1) != Choice()


@dataclass(frozen=True)
class Arguments:
    """Convert data of other formats into a dataset, or a dataset or a run into other formats.

    SRC is recognised by its content: a dataset or a run of depthba, TUM RGB-D, 7-Scenes, Redwood,
    nerfstudio, BOP, ScanNet (folders and .sens), KITTI, ROS bags, MCAP, folders of clouds or of
    depth images. DST is a new folder, or a file whose suffix says what of the result is wanted,
    such as poses.g2o, cloud.las, map.tif, map.glb.
    """

    src: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="SRC")] = None
    """What to convert: a folder or a file."""
    dst: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="DST")] = None
    """Where to: a new or empty folder, or a file, which is replaced with --overwrite alone."""
    to: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Format of DST, see --list. None: a dataset, or by DST's suffix."""
    merge: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="SRC ...")] = ()
    """Further sources whose frames come along, in the same world and of the same sensor."""
    list: bool = False
    """List the formats, and end."""
    overwrite: bool = False
    """Replace DST where it is a file."""
    json: bool = False
    """Print one JSON object on stdout in place of text."""
    choice: Annotated[Choice, tyro.conf.arg(name="selection")] = field(default_factory=Choice)
    reading: Annotated[Reading, tyro.conf.arg(name="source")] = field(default_factory=Reading)


def run(arguments: Arguments) -> int:
    """Convert, say what was done, return the exit status."""
    if arguments.list:
        _list(arguments.json)
        return DONE
    if arguments.src is None or arguments.dst is None:
        note("depthba convert: expected SRC and DST, or --list; `depthba convert --help` says more")
        return WRONG_USAGE
    from depthba.convert import exporting

    src, dst = arguments.src, arguments.dst
    kind = exporting.target(dst, arguments.to)
    _check_free(dst, kind, arguments.overwrite)
    with contextlib.ExitStack() as stack:
        if not dst.exists() or dst.is_dir():
            stack.enter_context(removed_on_failure(dst, overwrite=False))
        if kind is None:
            told = _to_dataset(src, dst, arguments)
        else:
            told = _to_other(src, dst, kind, arguments)
    for text in told.pop("notes"):
        note(f"note: {text}")
    if arguments.json:
        print_json(told)
    else:
        print(f"{src} ({told['from']}) -> {dst} ({told['to']}): {told['frames']} frames")
    return DONE


def import_into(path: Path, src: Path, reading: Reading, every: int = 1) -> Imported:
    """Convert a source into a dataset, with progress on stderr.

    Args:
        path: where the dataset goes, a new folder.
        src: a source of another format.
        reading: how to read it.
        every: take every n-th frame alone.

    Raises:
        DepthbaError: the source or an option does not do.

    """
    from depthba.convert import importing
    from depthba.verbs.progress import Counter

    recording = importing.read(src, reading)
    if every != 1:
        if every < 1:
            raise OptionError(f"--every {every}: expected 1 or more")
        recording = replace(recording, frames=recording.frames[::every])
    with Counter(src.name, "frame") as count:
        return importing.into_dataset(recording, path, reading, count)


def _to_dataset(src: Path, dst: Path, arguments: Arguments) -> dict[str, Any]:
    """Write a dataset of depthba: a source of another format, or one of ours cut anew."""
    from depthba.convert import importing

    choice, reading = arguments.choice, arguments.reading
    sources = [src, *arguments.merge]
    if all(map(importing.is_dataset, sources)) and reading.poses is not None:
        raise OptionError(f"{src}: --poses of a dataset goes with --to another format alone")
    if importing.is_dataset(src) or arguments.merge or choice.cuts or _is_run(src):
        with _datasets(sources, dst, reading) as (datasets, kinds, notes):
            datasets = [choice.applied(dataset) for dataset in datasets]
            merged = datasets[0] if len(datasets) == 1 else type(datasets[0]).merge(datasets)
            saved = merged.save(dst)
        return _told(", ".join(dict.fromkeys(kinds)), "depthba", len(saved), notes)
    imported = import_into(dst, src, reading, choice.every)
    return _told(imported.format, "depthba", len(imported.dataset), imported.notes)


def _to_other(
    src: Path, dst: Path, kind: Format | ResultFormat, arguments: Arguments
) -> dict[str, Any]:
    """Write a dataset, a run or another format's source in another format."""
    from depthba.convert import exporting
    from depthba.convert.results.outcome import Outcome

    choice, reading = arguments.choice, arguments.reading
    if _is_run(src):
        if arguments.merge or choice != Choice() or reading.poses is not None:
            raise OptionError(
                f"{src}: a run is converted as it is: register with --roi, --every, …, or convert "
                "its dataset"
            )
        outcome = Outcome.of_run(src)
        exporting.write(outcome, kind, dst)
        return _told("run", kind.name, len(outcome.stamps), [])
    with _datasets([src, *arguments.merge], dst, reading) as (datasets, kinds, notes):
        poses = reading.poses if set(kinds) == {"depthba"} else None
        datasets = [choice.applied(dataset) for dataset in datasets]
        merged = datasets[0] if len(datasets) == 1 else type(datasets[0]).merge(datasets)
        outcome = Outcome.of_dataset(merged, exporting.poses_of(merged, poses, reading.max_gap))
        exporting.write(outcome, kind, dst)
    return _told(", ".join(dict.fromkeys(kinds)), kind.name, len(merged), notes)


@contextlib.contextmanager
def _datasets(
    sources: list[Path], dst: Path, reading: Reading
) -> Iterator[tuple[list[Dataset], list[str], list[str]]]:
    """Open sources as datasets, those of other formats through a folder that goes again."""
    from depthba.convert import importing
    from depthba.dataset import Dataset

    ours = all(map(importing.is_dataset, sources))
    if ours and replace(reading, poses=None, max_gap=Reading().max_gap) != Reading():
        raise OptionError(
            f"{sources[0]}: a dataset says by itself how it is meant, expected no options of how "
            "to read a source"
        )
    datasets: list[Dataset] = []
    kinds: list[str] = []
    notes: list[str] = []
    parent = dst.parent if dst.parent.is_dir() else None
    with tempfile.TemporaryDirectory(prefix=".convert-", dir=parent) as folder:
        for k, src in enumerate(sources):
            if _is_run(src):
                raise DatasetError(
                    f"{src}: a run, expected a dataset; or say what of it is wanted, by DST such "
                    "as cloud.ply or by --to such as --to colmap; --list has all"
                )
            if importing.is_dataset(src):
                datasets.append(Dataset.open(src))
                kinds.append("depthba")
                notes += datasets[-1].warnings
                continue
            imported = import_into(Path(folder) / f"{k}", src, reading)
            datasets.append(imported.dataset)
            kinds.append(imported.format)
            notes += imported.notes
        yield datasets, kinds, notes


def _is_run(path: Path) -> bool:
    from depthba.convert import exporting

    return exporting.is_run(path)


def _check_free(dst: Path, kind: Any, overwrite: bool) -> None:
    from depthba.convert.results.outcome import ResultFormat

    if isinstance(kind, ResultFormat):
        if dst.is_dir():
            raise OptionError(f"{dst}: is a folder, expected a file for {kind.name}")
        if dst.exists() and not overwrite:
            raise OptionError(f"{dst}: is there already, expected a new file, or --overwrite")
        dst.parent.mkdir(parents=True, exist_ok=True)
    elif dst.exists() and (not dst.is_dir() or any(dst.iterdir())):
        raise OptionError(f"{dst}: is in the way, expected a new or empty folder")


def _told(source: str, to: str, frames: int, notes: Any) -> dict[str, Any]:
    return {"from": source, "to": to, "frames": frames, "notes": list(notes)}


def _list(json: bool) -> None:
    from depthba.convert import exporting, registry

    rows = [("depthba", "in, out", "the dataset format of depthba")]
    for one in registry.formats():
        ways = ["in"] * (one.read is not None) + ["out"] * (one.write is not None)
        rows.append((one.name, ", ".join(ways), one.title))
    rows += [(r.name, "result", f"{r.title}: {' '.join(r.suffixes)}") for r in exporting.RESULTS]
    if json:
        keys = ("name", "ways", "title")
        print_json({"formats": [dict(zip(keys, row, strict=True)) for row in rows]})
        return
    for name, way, title in rows:
        print(f"{name:<13} {way:<8} {title}")
