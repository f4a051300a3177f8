"""The animation in the README: the box and the simulations of each round of the example printed there.

    python docs/moving_picture.py

Runs the example (a minute or two), prints its summary, and writes docs/images/spring.gif.
"""

import io
import re
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image

ROOT = Path(__file__).parent.parent
SECONDS = 0.9
BLUE, GREY, BLACK = "#0072B2", "#999999", "#222222"


def example() -> dict:
    """The example's namespace after it has run."""
    code = re.search(r"^```python\n(.*?)^```$", (ROOT / "README.md").read_text(), re.MULTILINE | re.DOTALL)[1]
    namespace: dict = {}
    exec(compile(code, "README.md", "exec"), namespace)
    return namespace


def frame(run, simulate, observed, i: int) -> Image.Image:
    """The frame of one round: its proposals in the box from which they were drawn, and some of their simulations."""
    history, rounds = run.history, len(run.history["theta"])
    theta = history["theta"][i][history["kept"][i]]
    guess = [history["proposal_low"][0], history["proposal_high"][0]]
    low, high = history["proposal_low"][i], history["proposal_high"][i]
    figure = Figure(figsize=(7.2, 3.0), dpi=100, layout="constrained")
    figure.suptitle(f"round {i + 1} of {rounds}", fontsize=10)
    left, right = figure.subplots(1, 2)
    left.plot(*theta.T, ".", color=BLUE, markersize=3)
    for box, line, colour in ((guess, "--", GREY), ((low, high), "-", BLACK)):
        left.add_patch(Rectangle(box[0], *(box[1] - box[0]), fill=False, linestyle=line, edgecolor=colour))
    left.plot(6.0, 0.5, "+", color="#D55E00", markersize=10, markeredgewidth=2)
    left.set(xlim=(0.5, 8.0), ylim=(0.0, 1.8), xlabel="stiffness [N/m]", ylabel="damping [N s/m]")
    times = np.linspace(0, 6, observed.shape[0])
    shown = theta[:: max(len(theta) // 12, 1)]
    right.plot(
        times, jax.vmap(simulate)(jax.random.split(jax.random.key(i), len(shown)), shown).T, color=BLUE, alpha=0.3
    )
    right.plot(times, observed, ".", color=BLACK, markersize=4)
    right.set(ylim=(-110, 110), xlabel="time [s]", ylabel="position [mm]")
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return Image.open(content).convert("RGB")


def main() -> None:
    """Run the example and animate its rounds."""
    made = example()
    run, observed = made["run"], np.asarray(made["x_real"])
    frames = [frame(run, made["simulate"], observed, i) for i in range(len(run.history["theta"]))]
    palette = frames[-1].quantize(64)
    first, *others = (
        one.quantize(palette=palette, dither=Image.Dither.NONE) for one in [*frames, frames[-1], frames[-1]]
    )
    duration = round(1000 * SECONDS)
    first.save(ROOT / "docs/images/spring.gif", save_all=True, append_images=others, duration=duration, loop=0)


if __name__ == "__main__":
    main()
