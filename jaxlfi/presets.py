"""Presets: named settings of a run."""

from jaxlfi.bayessim import Settings
from jaxlfi.estimator import Estimator

PAPER = Settings()
"""The paper's numbers to the letter (section III-C); they are the defaults of `Settings` and `Estimator`."""

QUICK = Settings(
    estimator=Estimator(
        hidden=(64, 64),
        activation="tanh",
        members=4,
        prune=0.1,
        learning_rate=1e-3,
        epochs=0,
        steps=1000,
        validation=0.1,
        warm_start=False,
        normaliser="asinh",
    )
)
"""An ensemble of four small networks that start anew every round: minutes on two cores.

Chosen by the ablation in experiments/README.md. Where an observation is unlike everything simulated, as it
is on a wrong support, one network extrapolates confidently to one place, and the next round learns nothing
there. Four disagree, and explore.
"""

PRESETS: dict[str, Settings] = {"quick": QUICK, "paper": PAPER}
"""Presets by the name the command line gives them."""
