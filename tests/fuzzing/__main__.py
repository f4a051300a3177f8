"""Bad input by the thousand: every command ends with status 2 and one line that names what was expected, or works.

    python -m tests.fuzzing --cases 10000 --seed 0 --out runs/fuzzing

Each case is one command with something wrong in it (or, by chance, nothing): its words, a configuration, an array file
or an observation. A case must end within a minute with status 0, or with status 2 and one line on stderr; it must not
let the process grow beyond 4 GiB, nor change a byte outside of its own output. What does not is a finding, written with
the words and the file that made it. A case follows from the seed and its number alone: `--first 123 --cases 1` makes
number 123 again, and `--keep` leaves its files.
"""

import argparse
import collections
import csv
import io
import resource
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.markup import escape
from rich.progress import track
from rich.table import Table

from jaxlfi.io import files
from jaxlfi.io.provenance import environment
from tests.fuzzing.running import Ended, fuzz, prepared_folder

ADDRESSES = 24 * 2**30
"""Bytes of addresses that the process may ask for, so that a case that would fill the machine ends itself."""


def main() -> None:
    """Fuzz, and write what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500, metavar="N", help="how many (default: 500)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first (default: 0)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="of all cases (default: 0)")
    parser.add_argument("--seconds", type=float, default=float("inf"), metavar="S", help="stop after so long")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="a new folder: fuzzing.json, cases.csv")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="a new folder for the files of the last case")
    arguments = parser.parse_args()
    for name, folder in (("out", arguments.out), ("keep", arguments.keep)):
        if folder is not None and folder.exists():
            parser.error(f"{name}: expected a new folder, got {folder}, which exists")
    if arguments.cases < 1 or arguments.first < 0 or arguments.seed < 0:
        parser.error("expected at least one case, and no negative numbers")
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, resource.getrlimit(resource.RLIMIT_AS)[1]))
    console, began, every = Console(stderr=True), time.monotonic(), []
    with prepared_folder(arguments.keep) as root:
        prepared = time.monotonic() - began
        numbers = range(arguments.first, arguments.first + arguments.cases)
        for one in fuzz(root, arguments.seed, track(numbers, "cases", console=console)):
            every.append(one)
            if time.monotonic() - began > arguments.seconds:
                break
            if one.finding:
                words = " ".join(one.case.words)[:300]
                line = f"{one.number} {one.result.outcome}: {one.case.what[:200]}: {words!r}: {one.result.text}"
                console.print(escape(line.encode(errors="backslashreplace").decode()))
    counts = collections.Counter((one.case.kind, one.command, one.result.outcome) for one in every)
    arguments.out.mkdir(parents=True)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["kind", "command", "outcome", "cases"])
    writer.writerows([*names, count] for names, count in sorted(counts.items()))
    files.write_bytes(arguments.out / "cases.csv", text.getvalue().encode())
    slowest, findings = max(every, key=lambda one: one.seconds), [one for one in every if one.finding]
    outcomes = collections.Counter(one.result.outcome for one in every)
    files.write_json(
        arguments.out / "fuzzing.json",
        {
            "seed": arguments.seed,
            "first": arguments.first,
            "cases": len(every),
            "outcomes": dict(outcomes.most_common()),
            "seconds": round(time.monotonic() - began),
            "seconds_of_preparation": round(prepared),
            "slowest": {"number": slowest.number, "seconds": round(slowest.seconds, 1)},
            "most_memory_gib": round(max(one.memory for one in every) / 2**30, 2),
            "findings": [described(one) for one in findings],
            **environment(),
        },
    )
    table = Table("outcome", "cases")
    for outcome, count in outcomes.most_common():
        table.add_row(outcome, str(count))
    console.print(table)
    sys.exit(1 if findings else 0)


def described(one: Ended) -> dict[str, object]:
    """A finding, as JSON values."""
    plain = lambda text: text[:500].encode(errors="backslashreplace").decode()
    return {
        "number": one.number,
        "kind": one.case.kind,
        "words": [plain(word) for word in one.case.words],
        "what": plain(one.case.what),
        "outcome": one.result.outcome,
        "text": plain(one.result.text),
    }


if __name__ == "__main__":
    main()
