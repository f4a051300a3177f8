"""Size of an installation and time of its import: `python -m experiments.footprint`.

pip installs each package into its own virtual environment, with nothing else. The size is that of all files there
except pip's; the import is timed in new processes, after one that compiles the modules.
"""

import argparse
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = {
    "jaxlfi": (str(ROOT), "import jaxlfi; jaxlfi.infer"),
    "jaxlfi[mujoco]": (f"{ROOT}[mujoco]", "import jaxlfi; jaxlfi.infer"),
    "jaxlfi[whip,policy]": (f"{ROOT}[whip,policy]", "import jaxlfi; jaxlfi.infer"),
    "sbi": ("sbi", "from sbi.inference import NPE"),
}
"""pip's requirement and a user's first import, by name."""
REPETITIONS = 7
TIMED = "import time; began = time.perf_counter(); {}; print(time.perf_counter() - began)"


def measured(requirement: str, statement: str, folder: Path) -> dict[str, object]:
    """Size in MB (1e6 bytes), versions, and seconds of an import."""
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    python = folder / "bin" / "python"
    before = size(folder)
    subprocess.run([python, "-m", "pip", "install", "--quiet", "--no-compile", requirement], check=True)
    megabytes = (size(folder) - before) / 1e6
    timed = [python, "-c", TIMED.format(statement)]
    # With PYTHONDONTWRITEBYTECODE set, each process would compile the modules, and the time would include that.
    keeping = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    runs = [subprocess.run(timed, check=True, capture_output=True, env=keeping) for _ in range(REPETITIONS + 1)]
    seconds = [float(run.stdout) for run in runs[1:]]
    listed = subprocess.run([python, "-m", "pip", "list", "--format", "json"], check=True, capture_output=True).stdout
    versions = {one["name"]: one["version"] for one in json.loads(listed)}
    return {"megabytes": round(megabytes), "packages": len(versions) - 1, "seconds": seconds, "versions": versions}


def size(folder: Path) -> int:
    """Bytes of all files in a folder; links are not followed."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and not path.is_symlink())


def main() -> None:
    """Measure, print a table, and write footprint.json."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--packages", nargs="+", choices=PACKAGES, default=list(PACKAGES))
    parser.add_argument("--out", type=Path, default=Path("experiments/results/footprint"))
    arguments = parser.parse_args()
    found = {}
    print("| installed | MB | packages | import, s (fastest of seven) | median |\n|---|---|---|---|---|")
    for name in arguments.packages:
        folder = Path(tempfile.mkdtemp(prefix="jaxlfi-footprint-"))
        try:
            found[name] = one = measured(*PACKAGES[name], folder)
        finally:
            shutil.rmtree(folder)
        fastest, median = min(one["seconds"]), statistics.median(one["seconds"])
        print(f"| {name} | {one['megabytes']} | {one['packages']} | {fastest:.2f} | {median:.2f} |", flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"python": sys.version.split()[0], "installed": found}, indent=1)
    (arguments.out / "footprint.json").write_text(f"{text}\n")


if __name__ == "__main__":
    main()
