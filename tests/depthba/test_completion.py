"""Shell completion, as the shells themselves do it."""

from __future__ import annotations

import os
import select
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from depthba.cli import VERBS, main

ASK = """
source {script}
COMP_WORDS=({words})
COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1))
COMPREPLY=()
$(complete -p depthba | sed 's/.*-F \\([^ ]*\\) .*/\\1/')
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


def script_for(shell: str, folder: Path) -> Path:
    path = folder / f"depthba.{shell}"
    with pytest.MonkeyPatch.context() as patch, path.open("w") as file:
        patch.setattr("sys.stdout", file)
        assert main(["completion", shell]) == 0
    return path


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_script_names_every_verb_and_is_valid(shell: str, tmp_path: Path) -> None:
    path = script_for(shell, tmp_path)
    text = path.read_text()
    assert all(f"'{verb}'" in text for verb in VERBS)
    assert "'--preset'" in text and "'--against'" in text
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed, which would read its script")
    subprocess.run([shell, "-n", path], check=True, timeout=60)


def test_bash_completes(tmp_path: Path) -> None:
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    script = script_for("bash", tmp_path)
    for words, expected in {
        "depthba reg": ["register"],
        "depthba register my-dataset --pre": ["--preset"],
        "depthba register my-dataset --prior": ["--prior-t", "--prior-r"],
        "depthba register my-dataset --preset ": ["default", "paper"],
        "depthba plot my-run --kind resi": ["residuals"],
        "depthba completion ": ["bash", "fish", "zsh"],
        "depthba completion f": ["fish"],
        "depthba convert my-run out --to tum": ["tum", "tum-rgbd"],
        "depthba convert --kind nerf": ["nerfstudio"],
        "depthba register --kind 7": ["7-scenes"],
        # left to readline, which knows best how files are named
        "depthba register my-run": [],
        "depthba register ": [],
        "depthba register --out ": [],
        "depthba evaluate my-run --truth t": [],
    }.items():
        quoted = " ".join(f"'{word}'" for word in words.split(" "))
        asked = ASK.format(script=script, words=quoted)
        done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0 and not done.stderr, words
        assert sorted(done.stdout.split()) == sorted(expected), f"{words}: {done.stderr}"


def test_bash_at_a_terminal_completes_folders_as_it_does_without_us(tmp_path: Path) -> None:
    if shutil.which("bash") is None:
        pytest.skip("bash is not installed")
    pty = pytest.importorskip("pty")
    script = script_for("bash", tmp_path)
    (tmp_path / "run-roi two").mkdir()
    (tmp_path / "run-b").mkdir()
    (tmp_path / "true.txt").touch()
    for typed, seen in {
        "depthba register run-r\t": "run-roi\\ two/",
        "depthba evaluate run-b --truth tr\t": "--truth true.txt ",
        "depthba plot run-b --ag\trun-b\t": "--against run-b/",
        "depthba completion z\t": "completion zsh ",
        "depthba convert run-b x --to tum-\t": "--to tum-rgbd ",
    }.items():
        pid, terminal = pty.fork()
        if pid == 0:
            os.chdir(tmp_path)
            os.environ |= {"PS1": "ready> ", "TERM": "dumb"}
            os.execvp("bash", ["bash", "--norc", "--noprofile", "-i"])
        try:
            assert "ready>" in shown(terminal, "ready>")
            os.write(terminal, f"source {script}; echo 'lo''aded'\n".encode())
            assert "loaded" in shown(terminal, "loaded\r\n")
            os.write(terminal, typed.encode())
            assert seen in shown(terminal, seen), typed
        finally:
            os.kill(pid, 9)
            os.waitpid(pid, 0)
            os.close(terminal)


def shown(terminal: int, until: str) -> str:
    """Return what a terminal shows up to some text, or within half a minute."""
    told = ""
    end = time.monotonic() + 30
    while until not in told and time.monotonic() < end:
        if select.select([terminal], [], [], 0.2)[0]:
            told += os.read(terminal, 4096).decode(errors="replace")
    return told


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_every_script_knows_more_than_the_types_tell(shell: str, tmp_path: Path) -> None:
    text = script_for(shell, tmp_path).read_text()
    assert "KNOWN, get_completions)" in text and "'--to': ['depthba', " in text
    assert text.index("def offered(") < text.index("def main(")
    if shell == "bash":
        assert "compgen" not in text and "complete -o default -F" in text
    if shell == "fish":
        assert "$words (commandline -ct) $current)" in text
