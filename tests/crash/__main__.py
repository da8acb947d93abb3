"""``python -m tests.crash``: disturbs every verb in every way, and writes the table of trust.md."""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from pathlib import Path

from tests.crash.trials import FAULTS, ROOT, Tally, finish, trial, verbs

PAGE = ROOT / "docs" / "trust.md"
BEGIN, END = "<!-- crash: begin -->", "<!-- crash: end -->"


def small_dataset(path: Path) -> None:
    """Write a dataset that is registered in no time."""
    import sim

    options = sim.GenerateOptions(seed=5, frames=4, size=(80, 60), rgb=False)
    sim.generate("industrial-6", path, options)


def table(rows: list[tuple[str, str, Tally]], before: str = "") -> str:
    """Return the table of trust.md; rows ``before`` that were not run anew stay."""
    found = {}
    for line in before.splitlines():
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        if len(cells) == 6 and cells[1] in FAULTS:
            found[cells[0], cells[1]] = [int(count) for count in cells[2:]]
    for verb, fault, t in rows:
        if t.runs:
            found[verb, fault] = [t.runs, t.committed, t.lost, len(t.broken)]
    lines = ["| verb | what happens | runs | committed before | lost | did not go on |"]
    lines += ["|---|---|---:|---:|---:|---:|"]
    lines += ["| " + " | ".join((*k, *map(str, v))) + " |" for k, v in found.items()]
    total = [sum(counts) for counts in zip(*found.values(), strict=True)]
    lines.append("| all | | " + " | ".join(map(str, total)) + " |")
    return "\n".join(lines)


def main() -> int:
    """Run; 1 where anything was lost."""
    parser = argparse.ArgumentParser(prog="python -m tests.crash", description=__doc__)
    parser.add_argument("--runs", type=int, default=10, help="of each verb and fault")
    parser.add_argument("--verbs", nargs="*", help="all, where none is named")
    parser.add_argument("--faults", nargs="*", help="all, where none is named")
    parser.add_argument("--no-page", action="store_true", help="leave docs/trust.md as it is")
    asked = parser.parse_args()
    # disks are taken down again, and runs ended, also where somebody ends this
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    rows: list[tuple[str, str, Tally]] = []
    with tempfile.TemporaryDirectory(prefix="depthba-crash-") as name:
        home = Path(name)
        small_dataset(home / "set")
        for verb in verbs(home / "set"):
            if asked.verbs and verb.name not in asked.verbs:
                continue
            finish(verb, home / verb.name / "undisturbed" / "out")
            expected = verb.committed(home / verb.name / "undisturbed" / "out")
            for fault in asked.faults or FAULTS:
                row = Tally()
                for k in range(asked.runs):
                    folder = home / verb.name / fault.replace(" ", "-") / str(k)
                    one = trial(verb, fault, folder, k, expected)
                    row.runs += one.runs
                    row.committed += one.committed
                    row.lost += one.lost
                    row.broken += one.broken
                    row.skipped = one.skipped
                rows.append((verb.name, fault, row))
                told = row.skipped or f"{row.runs} runs, {row.committed} committed, {row.lost} lost"
                print(f"{verb.name}, {fault}: {told}", flush=True)
                for line in row.broken:
                    print(f"  {line}", flush=True)
                if not asked.no_page:
                    before, _, rest = PAGE.read_text().partition(BEGIN)
                    old, _, after = rest.partition(END)
                    PAGE.write_text(f"{before}{BEGIN}\n{table(rows, old)}\n{END}{after}")
    print(table(rows))
    return 1 if any(t.lost or t.broken for _, _, t in rows) else 0


if __name__ == "__main__":
    sys.exit(main())
