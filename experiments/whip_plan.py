"""Which DLOs can hit the top cube, and how long a plan takes to find, over a grid of length and modulus.

    python -m experiments.whip_plan --out experiments/results/whip-plan

For every DLO the cross-entropy method (`jaxlfi.envs.whip.planner`) searches for actions that maximise the mean return
over positions of the stack, and ends early once they hit little besides the top cube. The plan is then tested at
positions in between, which the search did not use.
"""

import argparse
import csv
import functools
import io
import time
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from jaxlfi.envs.whip import planner
from jaxlfi.envs.whip.frames import COLOURS
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.figures import style
from jaxlfi.io import files as atomic

LENGTHS = (0.05, 0.12, 0.20, 0.25, 0.29, 0.35)
"""Lengths of the DLOs, in m."""
MODULI = (5e2, 1e3, 5e3, 2.5e4, 1e5, 5e5)
"""Young's moduli of the DLOs, in Pa."""
QUICK = ((0.12, 0.25, 0.35), (1e3, 2.5e4, 5e5))
GOOD = 1.95
"""Return above which a plan counts as found: it hits the top cube, and at most the one below it."""
PLACES = 9
"""Number of positions of the stack at which a plan is tested."""


def search(length: float, young: float, method: planner.CrossEntropy, engine, seed: int = 0) -> dict:
    """The plan for one DLO, and statistics of its search.

    Returns:
        `actions` [16, 2]; `value`, the mean return over the positions of the search; `elsewhere`, over others;
        `hit` [6] with the stack in the middle; `rollouts` in total, and `first`, until the first plan that was good
        (NaN if none was); `seconds`.
    """
    began = time.monotonic()
    parameters = median(length, young)
    plan = jax.device_get(_plan(method, engine, jax.random.key(seed), parameters))
    elsewhere, outcome = jax.device_get(_judge(method, engine, parameters, plan.actions))
    tried = plan.history[np.isfinite(plan.history)]
    good = np.flatnonzero(tried >= GOOD - 1e-4)
    return {
        "actions": plan.actions,
        "value": float(plan.value),
        "elsewhere": float(elsewhere),
        "hit": outcome.hit,
        "first": float(method.stacks * (good[0] + 1)) if good.size else np.nan,
        "rollouts": method.stacks * tried.size,
        "seconds": time.monotonic() - began,
    }


@functools.partial(jax.jit, static_argnums=(0, 1))
def _plan(method, engine, key, parameters):
    return planner.plan(key, engine, parameters, method)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _judge(method, engine, parameters, actions):
    """The mean return over many positions, and the outcome at the middle one."""
    value = planner.mean_return(engine, parameters, actions, PLACES, method.jitter)
    return value, planner.play(engine, parameters, actions)


def draw(figure: Figure, lengths: Sequence[float], moduli: Sequence[float], found: dict[str, np.ndarray]) -> None:
    """Draw best mean returns (in brackets those elsewhere) with the cubes hit, and rollouts until the first good plan.

    Args:
        figure: an empty figure.
        lengths: lengths of the DLOs, in m, shape [L].
        moduli: their Young's moduli, in Pa, shape [E].
        found: `value`, `elsewhere` and `first`, shape [E, L], and `hit`, shape [E, L, 6].
    """
    left, right = figure.subplots(1, 2, sharey=True, width_ratios=(1.2, 1))
    returns = left.imshow(found["value"], cmap="viridis", vmin=1.8, vmax=2.0, aspect="auto", origin="lower")
    rollouts = right.imshow(
        np.log10(found["first"]), cmap="viridis_r", vmin=0.5, vmax=3.5, aspect="auto", origin="lower"
    )
    for e, l in np.ndindex(found["value"].shape):
        letters = " ".join(name[0].upper() for name, hit in zip(COLOURS, found["hit"][e, l], strict=True) if hit)
        value, elsewhere, first = (found[name][e, l] for name in ("value", "elsewhere", "first"))
        text = f"{value:.2f} {letters or '-'}\n({elsewhere:.2f})"
        left.text(l, e, text, ha="center", va="center", color=_ink(value > 1.9))
        text = "none" if np.isnan(first) else f"{first:.0f}"
        right.text(l, e, text, ha="center", va="center", color=_ink(not first > 60))
    left.set(ylabel="Young's modulus [kPa]", yticks=range(len(moduli)), yticklabels=[f"{e / 1e3:g}" for e in moduli])
    titles = (
        "best mean return and cubes hit, bottom-up (return elsewhere)",
        f"rollouts until the first return of {GOOD}",
    )
    for axes, title in zip((left, right), titles, strict=True):
        axes.set(xlabel="length [mm]", xticks=range(len(lengths)), title=title)
        axes.set_xticklabels([f"{1e3 * l:g}" for l in lengths])
    figure.colorbar(returns, ax=left, extend="min", ticks=[1.8, 1.85, 1.9, 1.95, 2.0])
    bar = figure.colorbar(rollouts, ax=right, ticks=[1, 2, 3])
    bar.ax.set_yticklabels(["10", "100", "1,000"])


def _ink(bright: bool) -> str:
    return "black" if bright else "white"


def table(lengths: Sequence[float], moduli: Sequence[float], found: dict[str, np.ndarray]) -> str:
    """One row per DLO, as csv."""
    out = io.StringIO()
    names = ("value", "elsewhere", "first", "rollouts", "seconds")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["young", "length", *names, *(f"hit {colour}" for colour in COLOURS)])
    for e, l in np.ndindex(found["value"].shape):
        numbers = [f"{found[name][e, l]:.4g}" for name in names]
        writer.writerow([f"{moduli[e]:g}", f"{lengths[l]:g}", *numbers, *found["hit"][e, l].astype(int)])
    return out.getvalue()


def main(arguments: Sequence[str] | None = None) -> None:
    """Write map.csv, map.json, map.png and plans.npz."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("experiments/results/whip-plan"))
    parser.add_argument("--quick", action="store_true", help="nine DLOs only")
    parser.add_argument("--engine", default="auto", help="native, mjx, warp or auto (default)")
    given = parser.parse_args(arguments)
    lengths, moduli = QUICK if given.quick else (LENGTHS, MODULI)
    method, engine, rows = planner.CrossEntropy(), pick(given.engine), []
    for young in moduli:
        rows.append([search(length, young, method, engine) for length in lengths])
        row = ", ".join(f"{1e3 * l:g} mm {one['value']:.2f}" for l, one in zip(lengths, rows[-1], strict=True))
        print(f"{young:g} Pa: {row}", flush=True)
    found = {name: np.array([[one[name] for one in row] for row in rows]) for name in rows[0][0]}
    given.out.mkdir(parents=True, exist_ok=True)
    atomic.write_arrays(given.out / "plans.npz", {"lengths": lengths, "moduli": moduli, **found})
    (given.out / "map.csv").write_text(table(lengths, moduli, found))
    measured = {name: found[name].tolist() for name in ("value", "elsewhere", "first", "rollouts")}
    atomic.write_json(
        given.out / "map.json",
        {
            "command": f"python -m experiments.whip_plan{' --quick' if given.quick else ''}",
            "engine": type(engine).__name__,
            "method": vars(method),
            "lengths": lengths,
            "moduli": moduli,
            "minutes": found["seconds"].sum() / 60,
            **measured,
        },
    )
    with style.context():
        figure = style.new_figure(style.TEXT_WIDTH, 2.8)
        draw(figure, lengths, moduli, found)
        style.save(figure, given.out / "map.png", 200)
    print(f"wrote {given.out}")


if __name__ == "__main__":
    main()
