"""Every command of `jaxlfi --help`, end to end with its pictures, on tiny tasks; every page and picture is opened.

The commands are those of the parsers: one without a line in `EXAMPLES` fails.
"""

import argparse
import base64
import contextlib
import csv
import dataclasses
import functools
import importlib
import io
import json
import re
import shutil
import types
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import jax
import numpy as np
import pytest
from PIL import Image

from jaxlfi.cli import parser as cli
from jaxlfi.figures import style
from jaxlfi.io import files
from jaxlfi.registry import COMMANDS
from tests import browser
from tests.small import FLAGS, TASK, command, whole_runs  # noqa: F401 - a fixture

SMALL = " ".join(flag for flag in FLAGS if flag != "--no-figures")
INFER = f"infer {TASK} {SMALL} --rounds 1"


@dataclasses.dataclass(frozen=True)
class Example:
    """A command as it is given here.

    Attributes:
        words: after `jaxlfi`; @NAME is the path of an example's results.
        needs: examples whose results it reads.
        writes: suffixes that are among the files it names.
        before: what else it needs is made in the folder that is given, or patched.
        extra: a package that it cannot do without.
        slow: whether it takes ten seconds or so.
    """

    words: str
    needs: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    before: Callable[[Path, pytest.MonkeyPatch], None] = lambda place, patch: None
    extra: str | None = None
    slow: bool = False


def interrupted(place: Path, patch: pytest.MonkeyPatch) -> None:
    """A run that was stopped after its first round."""
    from jaxlfi.runs import execute

    def stop(*arguments):
        raise KeyboardInterrupt

    with patch.context() as once:
        once.setattr(execute, "finish", stop)
        assert command(*f"{INFER} --out {place / 'resume'}".split()) == 130


def a_whip_policy(place: Path, patch: pytest.MonkeyPatch) -> None:
    """The file of a policy, and in place of the objects' simulation one that moves nothing but the gripper."""
    from envs_whip import Rig, a_policy, found

    from jaxlfi.envs.whip.reference_objects import film, repetitions, robot

    a_policy(place / "policy.npz")
    patch.setattr(film, "SIZE", 64)
    patch.setattr(robot, "ReferenceRig", Rig)
    patch.setattr(robot, "_found", found)
    patch.setattr(repetitions, "processors", lambda: 1)


def a_whip_camera(place: Path, patch: pytest.MonkeyPatch) -> None:
    """In place of the objects' simulation and of its pictures, frames in which only the gripper moves."""
    from envs_whip import EVERYWHERE, Rig

    from jaxlfi.envs.whip.reference_objects import observation
    from jaxlfi.envs.whip.reference_objects.scene import PLACE
    from jaxlfi.envs.whip.vision import commands

    class Camera(Rig):
        def __init__(self, dlo):
            super().__init__(dlo, PLACE)
            self.dlo, self.place = dlo, PLACE

        def rollout(self, actions):
            first = jax.tree.map(lambda leaf: leaf[None], self.reset())
            frames = jax.tree.map(lambda *leaves: np.concatenate(leaves), first, *map(self.step, actions))
            return observation.FRAME_INTERVAL * np.arange(len(frames.gripper)), frames

    def found(function, key, camera, frames, cube_side):
        return np.stack([EVERYWHERE] * len(frames.gripper)), np.ones((len(frames.gripper), 10), bool)

    patch.setattr(commands, "ReferenceRig", Camera)
    patch.setattr(observation, "in_every_frame", found)


def small_whip(place: Path, patch: pytest.MonkeyPatch) -> None:
    """Small films and searches."""
    from jaxlfi.envs.whip import planner, render

    patch.setattr(render, "PIECES", 2)
    patch.setattr(render, "SIZE", 64)
    search = {"population": 4, "elites": 2, "iterations": 1, "stacks": 1}
    patch.setattr(planner, "CrossEntropy", functools.partial(planner.CrossEntropy, **search))


def small_vision(place: Path, patch: pytest.MonkeyPatch) -> None:
    """Small networks, trained for three steps, and a labelled picture."""
    from jaxlfi.envs.whip.vision import commands, scenes, training
    from jaxlfi.envs.whip.vision.learning import Training
    from jaxlfi.envs.whip.vision.segmenter import Segmenter
    from jaxlfi.envs.whip.vision.training import Preset
    from jaxlfi.envs.whip.vision.transporter import Transporter

    patch.setattr(scenes, "BATCH", 2)
    tiny = Preset((Segmenter((8, 8, 8)), Transporter(16)), 4, Training(3, 1e-3), 2, 32, 4, Training(3, 1e-3), 4)
    patch.setattr(training, "PRESETS", {"quick": tiny})
    patch.setattr(commands, "HELD_OUT_PICTURES", 2)
    patch.setattr(commands, "HELD_OUT_ROLLOUTS", 2)
    (place / "images").mkdir(exist_ok=True)
    Image.fromarray(np.full((300, 300, 3), 90, np.uint8)).save(place / "images" / "one.png")
    square = {"id": 1, "image_id": 1, "category_id": 4, "segmentation": [[30, 60, 90, 60, 90, 240, 30, 240]]}
    coco = {
        "images": [{"id": 1, "file_name": "one.png", "width": 300, "height": 300}],
        "categories": [{"id": 4, "name": "dlo"}],
        "annotations": [square],
    }
    (place / "coco.json").write_text(json.dumps(coco))


def stages(place: Path, patch: pytest.MonkeyPatch) -> None:
    """In place of the stages of the loop that compute for long, what they would leave."""
    a_whip_policy(place, patch)
    from jaxlfi.envs.whip import r2s2r, r2s2r_page
    from jaxlfi.figures import learning

    def train(words):
        out = Path(words[words.index("--out") + 1])
        files.write_json(out.with_name(f"{out.name}.json"), {})  # the folder above is there
        (out / "uniform/seed_000").mkdir(parents=True)
        shutil.copy(place / "policy.npz", out / "uniform/seed_000")
        learning.save_curves(out / "curves.png", (("uniform", 0),), np.ones((20, 1)), 10)
        return 0

    def infer(words):
        shutil.copytree(place / "infer", words[words.index("--out") + 1])
        return 0

    patch.setattr(r2s2r.train, "main", train)
    patch.setattr(r2s2r, "command_line", types.SimpleNamespace(main=infer))
    patch.setattr(r2s2r_page, "REPETITIONS", 2)
    patch.setattr(r2s2r_page, "predicted", lambda out, runs: [])  # the run is of another task, which has no keypoints


def an_arm(place: Path, patch: pytest.MonkeyPatch) -> None:
    """A run of a model of two joints."""
    from envs_mujoco import ARM, recorded

    if (place / "arm").exists():
        return
    log = recorded()
    table = np.column_stack([log.times, log.signals["motor"], log.signals["angle"]])
    heading = "time [s],motor [N m],angle [rad]"
    np.savetxt(place / "swing.csv", table, delimiter=",", header=heading, comments="")
    (place / "arm.xml").write_text(ARM)
    damping = '[parameters."joint/shoulder/damping"]\nsupport = [0.02, 0.5]\nunit = "N m s/rad"'
    gear = '[parameters."actuator/motor/gear[0]"]\nsupport = [0.5, 3.0]'
    noise = "[noise]\nangle = 0.002"
    (place / "arm.toml").write_text("\n".join(['model = "arm.xml"', 'log = ["swing.csv"]', damping, gear, noise]))
    words = f"infer mujoco,config={place}/arm.toml {SMALL} --rounds 1 --no-polish --out {place}/arm"
    assert command(*words.split()) == 0


def a_machine(place: Path, patch: pytest.MonkeyPatch) -> None:
    """The task of a model of two joints; nobody connects to it."""
    from jaxlfi.robots import server

    an_arm(place, patch)
    patch.setattr(server, "serve_driver", lambda *words: None)


def a_wheel(place: Path, patch: pytest.MonkeyPatch) -> None:
    """A policy for a wheel."""
    from robots.machines import a_policy

    a_policy().save(place / "wheel.npz")


def a_queue(place: Path, patch: pytest.MonkeyPatch) -> None:
    """A run of a task with a design."""
    if not (place / "queue").exists():
        words = f"infer jaxlfi.envs.mg1_repetitions:task {SMALL} --rounds 1 --no-figures --out {place}/queue"
        assert command(*words.split()) == 0


LINE = (
    "train rl.toy:Line --domain uniform --environments 4 --unroll 5 --segments 2 --minibatches 4 --epochs 1 "
    "--total-steps 80 --hidden 8"
)
WHIP = {"extra": "mujoco", "slow": True}
FURUTA = Path(__file__).parents[2] / "examples/mujoco/furuta"
EXAMPLES = {
    "tasks": Example("tasks"),
    "infer": Example(f"{INFER} --keep-network --out @infer", writes=(".html", ".png")),
    "compare": Example(
        f"compare {TASK} {SMALL} --configurations ok misspecified+edge --seeds 2 --out @compare",
        writes=(".html", ".png", ".csv"), slow=True,
    ),
    "grid": Example(
        f"grid {TASK} {SMALL} --rounds 1 --vary expansion=0.1,0.3 --seeds 2 --out @grid",
        writes=(".html", ".png", ".csv"), slow=True,
    ),
    "resume": Example("resume @resume", writes=(".html", ".png"), before=interrupted),
    "sample": Example("sample @infer -n 50 --out @sample.csv", needs=("infer",), writes=(".csv",)),
    "diagnose": Example(
        "diagnose @infer --truths 20 --draws 20", needs=("infer",), writes=(".html", ".png"), slow=True
    ),
    "design": Example(
        "design @queue --rated 16 --simulations 64 --out @design", writes=(".json", ".csv", ".png"), before=a_queue,
        slow=True,
    ),
    "report": Example("report @infer", needs=("infer",), writes=(".html", ".png")),
    "train": Example(f"{LINE} --out @train", writes=(".png",), extra="brax", slow=True),
    "evaluate": Example(
        "evaluate rl.toy:Line @train/uniform/seed_000/policy.npz --domain median --episodes 4 --out @evaluate.csv",
        needs=("train",), extra="brax", slow=True,
    ),
    "export": Example("export @train --out @export.npz", needs=("train",), writes=(".npz",), extra="brax", slow=True),
    "control": Example(
        "control @wheel.npz --robot robots.machines:Wheel --out @real.csv", writes=(".csv",), before=a_wheel
    ),
    "mujoco serve": Example(
        "mujoco serve @arm.toml --truth joint/shoulder/damping=0.1 --truth actuator/motor/gear[0]=1.5",
        before=a_machine, **WHIP,
    ),
    "mujoco inspect": Example(
        f"mujoco inspect {FURUTA}.csv --model {FURUTA}.xml --out @furuta.toml", writes=(".toml",), extra="mujoco"
    ),
    "mujoco fit": Example(
        "mujoco fit @arm --starts 4 --keep 1 --out @fit", writes=(".png", ".json"), before=an_arm, **WHIP
    ),
    "mujoco film": Example(
        "mujoco film @arm --draws 2 --size 160x160 --out @film.gif", writes=(".gif", ".png"), before=an_arm, **WHIP
    ),
    "whip render": Example("whip render --out @render", writes=(".png", ".gif", ".npz"), before=small_whip, **WHIP),
    "whip plan": Example("whip plan --out @plan.npz", writes=(".npz",), before=small_whip, **WHIP),
    "whip deploy": Example(
        "whip deploy @policy.npz constant:0.03,-0.03 --object dlo-0 --repetitions 2 --out @deploy",
        writes=(".csv",), before=a_whip_policy, **WHIP,
    ),
    "whip control": Example(
        "whip control @policy.npz --robot dlo-0 --out @control.npz", writes=(".npz",), before=a_whip_policy, **WHIP
    ),
    "whip convert": Example(
        "whip convert @control.npz @converted.mcap", needs=("whip control",), writes=(".mcap",), **WHIP
    ),
    "whip record": Example(
        "whip record --object dlo-0 --out @recorded.npz", writes=(".npz",), before=a_whip_camera, **WHIP
    ),
    "whip pictures": Example("whip pictures --count 2 --out @pictures", before=small_vision, **WHIP),
    "whip import-pictures": Example(
        "whip import-pictures --coco @coco.json --images @images --out @imported", before=small_vision, **WHIP
    ),
    "whip train-vision": Example(
        "whip train-vision --only segmenter --pictures @pictures --out @vision",
        needs=("whip pictures",), writes=(".npz",), before=small_vision, **WHIP,
    ),
    "whip export-vision": Example(
        "whip export-vision --weights @vision --out @segmenter.onnx", needs=("whip train-vision",), writes=(".onnx",),
        **WHIP,
    ),
    "r2s2r": Example("r2s2r --object dlo-0 --out @loop", needs=("infer",), writes=(".html",), before=stages, **WHIP),
}  # fmt: skip


def commands() -> set[str]:
    """All commands, those of commands of their own among them: "infer", "whip render"."""

    def names(parser: argparse.ArgumentParser) -> list[str]:
        subparsers = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        return [name for action in subparsers for name in action.choices]

    found = set(names(cli.parser()))
    for name, (point,) in COMMANDS.points().items():
        if below := names(importlib.import_module(point.module).parser()):
            found = found - {name} | {f"{name} {one}" for one in below}
    return found


def test_every_command_has_an_example():
    assert commands() == set(EXAMPLES)


@pytest.fixture(scope="module")
def run(tmp_path_factory, whole_runs):  # noqa: F811 - the fixture
    """A function that runs an example once, after those it needs: what it printed, and where its results are."""
    place, printed = tmp_path_factory.mktemp("commands"), {}
    save = style.save

    def once(name: str) -> tuple[str, Path]:
        example = EXAMPLES[name]
        if example.extra:
            pytest.importorskip(example.extra)
        for other in example.needs:
            once(other)
        if name not in printed:
            with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as output:
                patch.setattr(style, "save", lambda figure, path, dpi: save(figure, path, 50))
                patch.setattr(importlib.import_module("jaxlfi.diagnostics.c2st"), "MAX_EPOCHS", 30)
                example.before(place, patch)
                output.seek(output.truncate(0))
                words = [word.replace("@", f"{place}/") for word in example.words.split()]
                assert command(*words) == 0, output.getvalue()
            printed[name] = output.getvalue()
        return printed[name], place

    return once


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * one.slow) for name, one in EXAMPLES.items()]
)
def test_a_command_names_what_it_wrote_and_all_of_it_can_be_opened(name, run):
    output, place = run(name)
    lines = [line for line in output.splitlines() if not line.startswith("│")]  # a table cuts long names
    found = re.findall(rf"{re.escape(str(place))}[^\s,;:`]*", "\n".join(lines))
    patterns = {"DOMAIN", "*"}  # which stand for all of a folder's
    named = [path for path in map(Path, found) if not patterns & set(path.parts)]
    assert all(path.exists() for path in named), output
    written = {file for path in named for file in (path, *path.rglob("*")) if file.is_file()}
    assert {path.suffix for path in written} >= set(EXAMPLES[name].writes), output
    for file in written:
        OPENED.get(file.suffix, lambda file: None)(file)


@pytest.mark.skipif(browser.CHROMIUM is None, reason=browser.MISSING)
@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_browser_finds_nothing_wrong_with_any_page(slow, run):
    """Those of runs, of a run's diagnostics, and slowly of many runs, of the loop, and of a MuJoCo model."""
    names = [name for name, one in EXAMPLES.items() if one.slow == slow and ".html" in one.writes]
    for name in [*names, *["mujoco fit"] * slow]:
        _, place = run(name)
    pages = sorted(place.rglob("*.html"))
    assert pages and browser.faults(pages) == []


class Page(HTMLParser):
    """Names of the places of a page, and what it refers to."""

    def __init__(self, text: str):
        super().__init__()
        self.ids, self.references, self.tags = set(), [], set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.add(value)
            elif name in ("src", "href"):
                self.references.append(value)


def page(path: Path) -> None:
    """All that the page refers to is there; pictures inside of it are pictures."""
    found = Page(path.read_text())
    assert {"h1", "img"} <= found.tags, path
    for reference in found.references:
        if reference.startswith("data:"):
            head, _, content = reference.partition(",")
            assert head == "data:image/png;base64"
            picture(io.BytesIO(base64.b64decode(content, validate=True)))
        elif reference.startswith("#"):
            assert reference[1:] in found.ids, (path, reference)
        else:
            assert (path.parent / reference).is_file(), (path, reference)


def picture(file) -> None:
    """All of it can be decoded, and something is drawn on it."""
    with Image.open(file) as image:
        image.load()
        assert min(image.size) > 20
        assert any(low < high for low, high in image.convert("RGB").getextrema()), file


def table(path: Path) -> None:
    with path.open(newline="") as file:
        heading, *rows = csv.reader(file)
    assert rows and all(len(row) == len(heading) for row in rows), path


OPENED = {
    ".html": page,
    ".png": picture,
    ".gif": picture,
    ".csv": table,
    ".npz": files.read_arrays,
    ".json": lambda path: json.loads(path.read_text()),
}
"""How files are opened, by suffix."""
