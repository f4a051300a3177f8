"""The commands under test, each at its smallest, and how each is gone on with."""

import dataclasses

FAST = (
    "--estimator mdn --hidden 16 --activation tanh --normaliser zscore --learning-rate 1e-3 --steps 100 "
    "--batch-size 20 --validation 0 --patience 0 --ensemble-size 1 --components 2 --prune 0 --weight-decay 0 "
    "--clip-norm inf --schedule constant --no-warm-start --correction none --restriction clip --inflation 1 "
    "--rounds 2 --min-rounds 0 --simulations-per-round 20 --simulation-budget 25 --no-figures"
).split()
"""Two rounds of 20 simulations."""
CART = (
    "tests.reliability.tasks:Cart --environments 4 --unroll 5 --segments 1 --minibatches 4 --epochs 1 "
    "--total-steps 960 --hidden 4 --no-figures --domain uniform"
).split()
"""48 updates, in three checkpoints."""
OUT = ("--out", "run")


@dataclasses.dataclass(frozen=True)
class Command:
    """A command and how it is gone on with, in the working folder of a trial.

    Attributes:
        name: of the command.
        start: its words.
        resume: the words that go on in the folder `run`.
        program: the module that has the command.
    """

    name: str
    start: tuple[str, ...]
    resume: tuple[str, ...] = ("resume", "run", "--no-figures")
    program: str = "jaxlfi"


def commands(scheduler: str) -> dict[str, Command]:
    """All of them, by name.

    Args:
        scheduler: address of a Dask cluster.
    """
    dask, loop = ("--scheduler", scheduler), ("--object", "dlo-0", *OUT)
    all_of_them = (
        Command("infer", ("infer", "gaussian_linear", *FAST, *OUT)),
        Command(
            "compare",
            ("compare", "gaussian_linear", "--configurations", "ok", "misspecified+edge", *FAST, "--seeds", "1", *OUT),
        ),
        Command(
            "grid",
            (
                *("grid", "gaussian_linear", "--heuristic", "edge", "--vary", "expansion=0.1,0.2", *FAST),
                *("--seeds", "1", "--runs-per-chunk", "1", *OUT),
            ),
        ),
        Command("train", ("train", *CART, *OUT)),
        Command("r2s2r", loop, loop, "tests.reliability.loop"),
        Command(
            "dask",
            ("infer", "tests.reliability.tasks:one_by_one", *FAST, *dask, *OUT),
            ("resume", "run", "--no-figures", *dask),
        ),
    )
    return {one.name: one for one in all_of_them}
