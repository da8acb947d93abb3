"""Shell completion, as the shells themselves do it."""

from __future__ import annotations

import shutil
import subprocess
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
    }.items():
        quoted = " ".join(f"'{word}'" for word in words.split(" "))
        asked = ASK.format(script=script, words=quoted)
        done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, timeout=60)
        assert sorted(done.stdout.split()) == sorted(expected), f"{words}: {done.stderr}"
