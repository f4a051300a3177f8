"""The FEM reference objects: calibrated, whipped once each, and recorded.

    python -m experiments.reference_objects --out experiments/results/reference-objects --data envs/whip/data
    python -m experiments.reference_objects --seeds 1 2 3 --data experiments/results/real2sim/rollouts

The first command writes objects.json and a recording of each object to the data folder, which must not contain them,
and a table of the calibration and a sheet of pictures of each rollout to the results folder. It takes some minutes. The
second records the calibrated objects again, under the exploratory actions of other seeds: dlo-0-1.npz is dlo-0 under
those of seed 1. The stack is at the same position, as inference assumes.
"""

import argparse
import dataclasses
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.exploration import exploratory_actions
from jaxlfi.envs.whip.reference_objects.calibration import Calibration, calibrated
from jaxlfi.envs.whip.reference_objects.objects import TABLE, ReferenceObject, load
from jaxlfi.envs.whip.reference_objects.observation import in_every_frame, look, record
from jaxlfi.envs.whip.reference_objects.scene import SIMULATOR
from jaxlfi.envs.whip.reference_objects.simulation import ReferenceRig
from jaxlfi.envs.whip.vision.keypoints import ON_DLO
from jaxlfi.figures import style
from jaxlfi.io import files as atomic

HOW = (
    "young is such that the soft body, clamped horizontally at an elasto-gravity number of about 5, sags as much as "
    "the heavy elastica of effective_young and 15 x 15 mm. light_young is that of a beam of 75 kg/m^3 that moves "
    "alike; hanging_length is at 9.81 m/s^2. Units: m, kg, s, Pa; sag and reach are fractions of length."
)
COLUMNS = {
    "object": lambda dlo, _: dlo.name,
    "Shore": lambda dlo, _: dlo.hardness,
    "length (mm)": lambda dlo, _: f"{1e3 * dlo.length:.0f}",
    "mass (g)": lambda dlo, _: f"{1e3 * dlo.mass:.2f}",
    "modulus of the material (Pa)": lambda dlo, _: f"{dlo.young:.4g}",
    "effective modulus (Pa)": lambda _, found: f"{found.effective_young:.4g}",
    "the same at 75 kg/m^3 (Pa)": lambda dlo, _: f"{dlo.light_young:.4g}",
    "sag / length": lambda _, found: f"{found.sag:.4f}",
    "reach / length": lambda _, found: f"{found.reach:.4f}",
    "beam's reach / length": lambda _, found: f"{found.beam_reach:.4f}",
    "hanging length (mm)": lambda _, found: f"{1e3 * found.hanging_length:.1f}",
}
"""Columns of the table of the calibration."""


def described(dlo: ReferenceObject, found: Calibration) -> dict:
    """The entry of one object in objects.json."""
    return {
        **dataclasses.asdict(dlo),
        "light_young": round(dlo.light_young),
        "measured": {name: float(f"{value:.6g}") for name, value in dataclasses.asdict(found).items()},
    }


def table(calibrations: list[tuple[ReferenceObject, Calibration]]) -> str:
    """The calibration in Markdown."""
    rows = [list(COLUMNS), ["---"] * len(COLUMNS)]
    rows += [[column(*pair) for column in COLUMNS.values()] for pair in calibrations]
    return "\n".join(f"| {' | '.join(row)} |" for row in rows) + "\n"


def draw(figure: Figure, recording: recordings.Recording, labels: np.ndarray) -> None:
    """Draw the segmentation image at each control step, with the keypoints found in it.

    Args:
        figure: an empty figure.
        recording: recording of the rollout.
        labels: labels of all its frames, shape [F, size, size].
    """
    names = [*recordings.ORDER[ON_DLO:], "dlo"]
    palette = ["#F4F4F4", *(recording.colours[name] for name in names)]
    colours = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in palette], np.uint8)
    every = round(recording.control_interval * recording.frame_rate)
    panels = figure.subplots(3, 6)
    for axes in panels.flat:
        axes.set_axis_off()
    for k, axes in zip(range(0, len(labels), every), panels.flat, strict=False):
        axes.imshow(colours[labels[k]], extent=(0, 1, 1, 0), interpolation="nearest")
        u, v = recording.keypoints[k].T
        dot = {"marker": "o", "linestyle": "none", "color": "white", "markeredgecolor": "black"}
        axes.plot(u[ON_DLO:], v[ON_DLO:], **dot, markersize=2, markeredgewidth=0.5)
        axes.plot(u[:ON_DLO], v[:ON_DLO], **dot, markersize=4.5, markeredgewidth=0.6)
        for i in range(ON_DLO):
            axes.text(u[i], v[i], f"{i + 1}", fontsize=4, ha="center", va="center_baseline")
        axes.set_title(f"{recording.times[k]:.2f} s")
    figure.suptitle(recording.description.split(":")[0])


def record_again(data: Path, seeds: list[int]) -> None:
    """Record the calibrated objects under the exploratory actions of other seeds."""
    for number, dlo in enumerate(load(one.name) for one in TABLE):
        rig = ReferenceRig(dlo)
        for seed in seeds:
            key = jax.random.fold_in(jax.random.key(number), seed)  # for the camera's noise
            recording, _ = record(key, rig, exploratory_actions(seed))
            recordings.write(data / f"{dlo.name}-{seed}.npz", recording)
            print(f"wrote {data / dlo.name}-{seed}.npz")


def main(arguments: list[str] | None = None) -> None:
    """Calibrate, record and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path("experiments/results/reference-objects"), help="folder of results"
    )
    parser.add_argument("--data", type=Path, required=True, help="folder of the recordings and objects.json")
    parser.add_argument("--seeds", type=int, nargs="+", help="record again, under the exploratory actions of these")
    given = parser.parse_args(arguments)
    if given.seeds:
        given.data.mkdir(parents=True, exist_ok=True)
        record_again(given.data, given.seeds)
        return
    objects = given.data / "objects.json"
    for path in (objects, *(given.data / f"{dlo.name}.npz" for dlo in TABLE)):
        if path.exists():
            parser.error(f"--data: expected a folder without {path.name}, got {given.data}")
    for folder in (given.out, given.data):
        folder.mkdir(parents=True, exist_ok=True)
    calibrations = [calibrated(dlo) for dlo in TABLE]
    (given.out / "table.md").write_text(table(calibrations))
    atomic.write_json(
        objects,
        {
            "how": HOW,
            "simulator": SIMULATOR,
            "objects": {dlo.name: described(dlo, found) for dlo, found in calibrations},
        },
    )
    for i, (dlo, _) in enumerate(calibrations):
        key = jax.random.key(i)
        rig = ReferenceRig(dlo)
        recording, frames = record(key, rig, exploratory_actions())
        recordings.write(given.data / f"{dlo.name}.npz", recording)
        labels = in_every_frame(look, key, recording.camera, frames, rig.place.cube_side)
        with style.context():
            figure = style.new_figure(style.TEXT_WIDTH, 4.0)
            draw(figure, recording, labels)
            style.save(figure, given.out / f"{dlo.name}.png", 200)
        print(f"wrote {given.data / dlo.name}.npz")


if __name__ == "__main__":
    main()
