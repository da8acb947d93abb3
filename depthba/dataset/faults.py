"""Faults of a dataset: raised at the first one when it is opened, gathered when it is verified."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from depthba.errors import DatasetError


@dataclass(frozen=True)
class Fault:
    """One thing that is wrong with a dataset."""

    file: str
    """Relative to the dataset, "" for the folder itself."""
    frame: int | None
    """Frame id, None where no frame is concerned."""
    text: str
    """What was found and what was expected."""

    def __str__(self) -> str:
        """Return the fault in one line, without the dataset's path."""
        frame = f"frame {self.frame}: " if self.frame is not None else ""
        return f"{self.file + ': ' if self.file else ''}{frame}{self.text}"


class MalformedError(Exception):
    """A value is wrong; who reads it knows the file and the frame, and adds them."""


class Faults:
    """Where readers report: raises `DatasetError` at once, or gathers (``strict=False``)."""

    def __init__(self, root: Path, *, strict: bool = True) -> None:
        """Report on the dataset at ``root``."""
        self.root = root
        self.strict = strict
        self.found: list[Fault] = []

    def add(self, file: str, frame: int | None, text: str) -> None:
        """Report one fault."""
        fault = Fault(file, frame, text)
        if self.strict:
            raise DatasetError(f"{self.root / fault.file}{str(fault)[len(fault.file) :]}"[:2000])
        if fault not in self.found:
            self.found.append(fault)

    def within(self, file: str, frame: int | None = None) -> _Within:
        """Report a `MalformedError` from the `with` block as a fault of this file and frame."""
        return _Within(self, file, frame)


@dataclass(frozen=True)
class _Within:
    faults: Faults
    file: str
    frame: int | None

    def __enter__(self) -> None:
        pass

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> bool:
        if not isinstance(error, MalformedError):
            return False
        self.faults.add(self.file, self.frame, str(error))
        return True
