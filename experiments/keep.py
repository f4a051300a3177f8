"""Keep a finished run in the project: its table, pictures and configuration, without the bulky arrays.

    python -m experiments.keep runs/demo experiments/results/demo

For a single run, the ledger and posterior are kept too. Diagnostics of a run are kept likewise, from their own folder.
"""

import argparse
import shutil
from pathlib import Path

KEPT = ("config.json", "table.csv", "grid.npz", "ledger.jsonl", "posterior.npz", "plan.json", "diagnostics.json")
"""Files that are kept if they exist, in addition to the pictures."""


def keep(source: Path, target: Path) -> list[Path]:
    """Copy `KEPT` and the pictures; returns the copies."""
    target.mkdir(parents=True, exist_ok=True)
    files = [source / name for name in KEPT if (source / name).exists()]
    files += sorted((source / "figures").glob("*.png"))
    return [Path(shutil.copy2(file, target / file.name)) for file in files]


def main() -> None:
    """Copy, and print what was copied."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", type=Path)
    parser.add_argument("target", type=Path)
    arguments = parser.parse_args()
    if not any((arguments.source / name).exists() for name in ("config.json", "diagnostics.json")):
        parser.error(f"expected a run folder or one of diagnostics, got {arguments.source}")
    for path in keep(arguments.source, arguments.target):
        print(path)


if __name__ == "__main__":
    main()
