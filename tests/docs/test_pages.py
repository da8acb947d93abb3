"""Every block of code of README.md and of the site does what it says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.pages import KEYS, RUN, SHOWN, blocks, pages
from tests.docs.running import Reader
from tests.docs.stage import built, laid_out, wide

SLOW = (
    "README.md",
    "docs/convert.md",
    "docs/index.md",
    "docs/install.md",
    "docs/plots.md",
    "docs/simulation.md",
)
"""Pages that take more than ten seconds as a whole."""

WIDE = ("README.md", "docs/convert.md")
"""Pages that speak of images of 640 x 480 pixels."""


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("stage"), registered=False)


@pytest.fixture(scope="module")
def whole_stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return built(tmp_path_factory.mktemp("stage"), registered=True)


@pytest.mark.parametrize("page", pages())
def test_every_block_is_run_or_says_why_not(page: str) -> None:
    for block in blocks(page):
        where = f"{page}:{block.line}"
        assert block.language in (*RUN, *SHOWN), f"{where}: say its language"
        assert set(block.notes) <= set(KEYS), f"{where}: {block.notes}"


MADE = {
    "README.md": ("my-run",),
    "docs/index.md": ("my-run",),
    "docs/tutorial.md": ("my-run", "my-pngs", "my-dataset", "other-dataset", "other-run"),
}
"""What a page makes itself."""


def read(page: str, whole: bool, stage: Path, folder: Path, patch: pytest.MonkeyPatch) -> None:
    laid_out(stage, folder, MADE.get(page, ()))
    if page in WIDE:
        wide(folder)
    patch.chdir(folder)
    patch.syspath_prepend(str(folder))
    patch.setenv("COLUMNS", "100")
    reader = Reader(folder)
    for block in blocks(page):
        left_out = "not run" in block.notes or ("slow" in block.notes and not whole)
        if block.language in RUN and not left_out:
            reader.does(block)


@pytest.mark.parametrize("page", [page for page in pages() if page not in SLOW])
def test_page(page: str, stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read(page, False, stage, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [p for p in pages() if p in SLOW or any("slow" in block.notes for block in blocks(p))],
)
def test_whole_page(
    page: str, whole_stage: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read(page, True, whole_stage, tmp_path, monkeypatch)
