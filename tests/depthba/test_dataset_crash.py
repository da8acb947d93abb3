"""A crash at any instant: what was committed stays, and the capture goes on as if without it."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from depthba.dataset import Dataset, DatasetWriter, verify
from depthba.errors import DatasetError

FRAMES = 30


def tree(path: Path) -> dict[str, bytes]:
    """Return all files of a folder."""
    return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}


def go_on(small: Any, frames: int) -> list[str]:
    """Resume, write the frames that are missing, and return the warnings."""
    writer = DatasetWriter.resume(small.path)
    for i in range(len(writer), frames):
        writer.add_frame(**small.frame(i))
    return list(writer.warnings)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_killed_at_random_moments_nothing_is_lost(pristine: Any, tmp_path: Path) -> None:
    """A child writes frames and is killed, again and again, until all are there."""
    small = type(pristine)(tmp_path / "new")
    moments = random.Random(4)
    committed, kills = 0, 0
    while True:
        reader, writer_end = os.pipe()
        child = os.fork()
        if child == 0:
            status = 1
            try:
                if (small.path / "dataset.json").exists():
                    writer = DatasetWriter.resume(small.path)
                else:
                    writer = DatasetWriter.create(small.path, small.header())
                for i in range(len(writer), FRAMES):
                    writer.add_frame(**small.frame(i))
                    os.write(writer_end, b".")  # told to the outside: must never be lost
                status = 0
            finally:
                os._exit(status)
        os.close(writer_end)
        with os.fdopen(reader, "rb", buffering=0) as pipe:
            told = committed
            for _ in range(moments.randrange(4)):  # paced by commits, so that every machine gets on
                told += len(pipe.read(1))
            time.sleep(moments.uniform(0, 0.01))
            os.kill(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
            told += len(pipe.read())
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0, "the child failed by itself"
        kills += 1
        if not (small.path / "dataset.json").exists():
            continue
        dataset = Dataset.open(small.path)
        committed = len(dataset)
        # the last commit may have been killed before it could be told
        assert told <= committed <= told + 1
        assert verify(small.path) == []
        if committed == FRAMES:
            break
    assert kills > 1
    DatasetWriter.resume(small.path)
    untouched = type(pristine)(tmp_path / "untouched")
    DatasetWriter.create(untouched.path, small.header())
    go_on(untouched, FRAMES)
    assert tree(small.path) == tree(untouched.path)


def test_whatever_the_last_write_left_behind_is_made_good(small: Any, tmp_path: Path) -> None:
    """Cut the files back to the states that a crash in frame 2 can leave, at random bytes."""
    small.content("markers.json", None)
    whole = tree(small.path)
    order = ["depth/000002.png", "rgb/000002.png", "poses_measured.txt", "poses_true.txt"]
    order.append("frames.jsonl")
    rng = random.Random(0)
    for done in range(len(order)):
        file = order[done]
        lines = whole[file].splitlines(keepends=True) if "." in file and "/" not in file else []
        before = len(b"".join(lines[:-1]))
        for end in {before, *(rng.randrange(before, len(whole[file])) for _ in range(4))}:
            for later in order[done + 1 :]:
                if "/" in later:
                    small.content(later, b"")
                    (small.path / later).unlink()
                else:
                    kept = whole[later].splitlines(keepends=True)[:-1]
                    small.content(later, b"".join(kept))
            # files are renamed into place, so a half file has another name
            name = file.replace("/", "/.") + ".77.part" if "/" in file else file
            small.content(name, whole[file][:end])
            if "/" in file:
                (small.path / file).unlink(missing_ok=True)
            frames = len(Dataset.open(small.path))
            assert frames == 2 and verify(small.path) == []
            go_on(small, 3)
            assert tree(small.path) == whole


def test_resume_of_a_sound_dataset_changes_nothing(small: Any) -> None:
    before = tree(small.path)
    writer = DatasetWriter.resume(small.path)
    assert writer.warnings == () and tree(small.path) == before and len(writer) == 3


def test_resume_keeps_the_longest_whole_prefix_and_says_what_it_dropped(small: Any) -> None:
    before = tree(small.path)
    (small.path / "depth/000001.png").write_bytes(b"damaged")
    small.append("frames.jsonl", b'{"id": 3, "st')
    small.append("poses_measured.txt", b"11.5 0 0 0 0 0 0 1\n12 0 0")
    writer = DatasetWriter.resume(small.path)
    truncated_frame, truncated_pose, dropped, orphan = writer.warnings
    assert "frames.jsonl: line 4: dropped the truncated last line" in truncated_frame
    assert "poses_measured.txt: line 6: dropped the truncated last line" in truncated_pose
    assert "dropped 2 frames from 1 to 2 (depth/000001.png: frame 1: sha256 is" in dropped
    assert "set aside in dropped-1" in dropped
    assert "poses_measured.txt: dropped 1 poses without a frame" in orphan
    assert writer.ids == (0,) and len(Dataset.open(small.path)) == 1
    # frame 2 was whole: all of it is still there
    aside = tree(small.path / "dropped-1")
    for file in ("depth/000002.png", "rgb/000002.png", "markers.json"):
        assert aside[file] == before[file]
    assert [json.loads(line)["id"] for line in aside["frames.jsonl"].splitlines()] == [1, 2]
    assert len(aside["poses_true.txt"].splitlines()) == 2
    # and the capture goes on as if it had just come so far
    go_on(small, 3)
    after = tree(small.path)
    assert {k: v for k, v in after.items() if not k.startswith("dropped-")} == {
        k: v for k, v in before.items() if k != "markers.json"
    }
    assert verify(small.path) == []


@pytest.mark.parametrize("file", ["poses_measured.txt", "poses_true.txt"])
def test_a_frame_whose_pose_was_lost_is_dropped(small: Any, file: str) -> None:
    small.line(file, 3, "")
    (warning,) = DatasetWriter.resume(small.path).warnings
    assert f"dropped frame 2 ({file}: frame 2 has no pose of its own)" in warning
    assert len(Dataset.open(small.path)) == 2 and verify(small.path) == []


def test_all_frames_lost_leaves_an_empty_dataset_without_a_say_on_truth(small: Any) -> None:
    shutil.rmtree(small.path / "depth")
    writer = DatasetWriter.resume(small.path)
    assert len(writer) == 0 and verify(small.path) == []
    frame = small.frame(0) | {"T_world_camera_true": None}
    assert writer.add_frame(**frame) == 0
    assert Dataset.open(small.path).T_world_camera_true is None and verify(small.path) == []


def test_resume_does_not_guess_where_no_crash_explains_it(small: Any) -> None:
    (small.path / "frames.jsonl").unlink()
    with pytest.raises(DatasetError, match="no such file, though there are files in depth"):
        DatasetWriter.resume(small.path)
    small.content("frames.jsonl", '{"id": 0,\n{"id": 1}\n')
    with pytest.raises(DatasetError, match=r"frames\.jsonl: line 1: not JSON"):
        DatasetWriter.resume(small.path)
    with pytest.raises(DatasetError, match="no such folder"):
        DatasetWriter.resume(small.path / "nowhere")


def test_a_new_frame_never_takes_the_file_of_a_committed_one(small: Any) -> None:
    (small.path / "depth/000002.png").rename(small.path / "depth/000003.png")
    small.record(2, depth="depth/000003.png")
    committed = (small.path / "depth/000003.png").read_bytes()
    writer = DatasetWriter.resume(small.path)
    assert writer.add_frame(**small.frame(7)) == 4
    assert (small.path / "depth/000003.png").read_bytes() == committed
    assert np.all(np.diff(Dataset.open(small.path).ids) > 0) and verify(small.path) == []
