"""Every block of code of README.md and of the site does what it says."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.docs.pages import KEYS, RUN, SHOWN, blocks, pages
from tests.docs.running import Reader
from tests.docs.stage import laid_out, small, wide

WIDE = ("README.md", "docs/convert.md")
"""Pages that speak of images of 640 x 480 pixels."""


@pytest.fixture(scope="module")
def small_stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small(tmp_path_factory.mktemp("small"))


@pytest.fixture(scope="module")
def wide_stage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return wide(tmp_path_factory.mktemp("wide"))


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


@pytest.mark.parametrize("page", pages())
def test_page(
    page: str,
    small_stage: Path,
    request: pytest.FixtureRequest,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    laid_out(small_stage, tmp_path, without=MADE.get(page, ()))
    if page in WIDE:
        laid_out(request.getfixturevalue("wide_stage"), tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("COLUMNS", "100")
    reader = Reader(tmp_path)
    for block in blocks(page):
        if block.language in RUN and "not run" not in block.notes:
            reader.does(block)
