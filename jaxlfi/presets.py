"""Presets: named settings of a run."""

from jaxlfi.bayessim import Settings
from jaxlfi.estimator import Estimator

PAPER = Settings()
"""The paper's numbers to the letter (section III-C); they are the defaults of `Settings` and `Estimator`."""

QUICK = Settings(
    estimator=Estimator(
        hidden=(64, 64, 64),
        activation="relu",
        learning_rate=1e-3,
        epochs=0,
        steps=2000,
        validation=0.1,
        warm_start=False,
        normaliser="asinh",
    )
)
"""A small network that starts anew every round: minutes on two cores."""

PRESETS: dict[str, Settings] = {"quick": QUICK, "paper": PAPER}
"""Presets by the name the command line gives them."""
