"""The command line of the whipping task, the films it takes and the pictures it draws."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

pytest.importorskip("mujoco")

from matplotlib.figure import Figure
from PIL import Image

from jaxlfi.envs.whip import cli, commands, figures, planner, real2sim, render
from jaxlfi.envs.whip import recording as recordings
from jaxlfi.envs.whip.episode import Whip
from jaxlfi.envs.whip.parameters import median
from jaxlfi.envs.whip.physics import engine as physics
from jaxlfi.envs.whip.physics.kinematics import frames
from jaxlfi.envs.whip.physics.native import NativeEngine
from jaxlfi.envs.whip.physics.scene import Scene
from jaxlfi.envs.whip.rig import START
from jaxlfi.envs.whip.vision.keypoints import DETECTORS, Detector

ENGINE, FINE = NativeEngine(threads=1), NativeEngine(Scene(control_interval=0.08), threads=1)
WHIP = np.array([[-0.06, 0.0]] * 2 + [[0.06, 0.0]] * 4 + [[0.0, 0.0]] * 10, np.float32)
"""Back and forth: a DLO of 250 mm and 25 kPa hits the top cube only, with the seventh."""


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Small films and searches, by engines that are compiled for once."""
    engines = {0.16: ENGINE, 0.08: FINE}
    monkeypatch.setattr(commands, "pick", lambda name, scene=Scene(): engines[round(scene.control_interval, 3)])
    monkeypatch.setattr(render, "PIECES", 2)
    monkeypatch.setattr(render, "SIZE", 64)
    method = functools.partial(planner.CrossEntropy, population=16, elites=4, iterations=3, stacks=1, target_return=1.8)
    monkeypatch.setattr(planner, "CrossEntropy", method)


def run(*words):
    return cli.main([str(word) for word in words])


@pytest.fixture
def whip_file(tmp_path):
    np.savez(tmp_path / "whip.npz", actions=WHIP, anything=np.zeros(3))
    return tmp_path / "whip.npz"


@pytest.mark.slow
def test_a_rollout_is_drawn_and_saved(tmp_path, whip_file, capsys):
    out = tmp_path / "new" / "folder"
    assert run("render", "--policy", whip_file, "--detector", "transporter", "--seed", 3, "--out", out) == 0
    printed = capsys.readouterr().out
    assert "return 2.00 in 7 steps, hit yellow\n" in printed and f"{out / 'film.gif'}" in printed
    assert {path.name for path in out.iterdir()} == {"sheet.png", "film.gif", "rollout.npz", "rollout.json"}
    with Image.open(out / "film.gif") as film:
        assert film.n_frames == 33 and film.info["duration"] == 160  # of 0.08 s, at half the speed
        assert film.width == 64 + 12
    with Image.open(out / "sheet.png") as sheet:
        assert sheet.width == 1432
    with np.load(out / "rollout.npz") as arrays:
        assert arrays["keypoints"].shape == (17, 10, 2) and arrays["hits"].shape == (17, 6)
        np.testing.assert_array_equal(arrays["actions"], WHIP)
        np.testing.assert_allclose(arrays["rewards"][:7], [0, 0, 0, 0, 0, 0, 2])
        np.testing.assert_array_equal(arrays["hits"][7], [0, 0, 0, 0, 0, 1])
        assert arrays["length"] == 7 and arrays["return"] == 2.0 and arrays["frames/orientations"].shape == (17, 6, 4)
        np.testing.assert_allclose(arrays["frames/gripper"], arrays["gripper"])
        assert arrays["parameters/young"] == pytest.approx(2.5e4)


@pytest.mark.slow
def test_a_plan_is_found_saved_and_can_be_drawn(tmp_path, capsys, monkeypatch):
    """350 mm and 100 kPa are easy."""
    words = ("--length", 350, "--young", 1e5, "--out")
    assert run("plan", *words, tmp_path / "plan.npz") == 0
    printed = capsys.readouterr()
    assert printed.out.startswith("mean return") and printed.err == ""  # a bar is for terminals
    with np.load(tmp_path / "plan.npz") as arrays:
        assert arrays["value"] >= 1.8 == pytest.approx(np.max(arrays["history"]), abs=0.2)
        assert arrays["actions"].shape == (16, 2) and arrays["parameters/length"] == pytest.approx(0.35)
    monkeypatch.setattr(render, "save_pictures", lambda *arguments: [])
    assert (
        run("render", "--policy", tmp_path / "plan.npz", "--detector", "transporter", *words, tmp_path / "drawn") == 0
    )
    with np.load(tmp_path / "drawn" / "rollout.npz") as rollout, np.load(tmp_path / "plan.npz") as arrays:
        assert rollout["return"] == pytest.approx(arrays["value"])


def test_a_rollout_can_be_inferred_from(tmp_path, whip_file, monkeypatch):
    """What `render` writes is a recording: its states are those of the rollout, and its actions are simulated."""
    monkeypatch.setattr(render, "save_pictures", lambda *arguments: [])
    assert run("render", "--policy", whip_file, "--out", tmp_path / "seen") == 0
    recording = real2sim.recorded(str(tmp_path / "seen" / "rollout.npz"))
    assert recording.source == "simulated" and recording.frame_rate == 6.25
    observed = recordings.trajectory(recording)
    np.testing.assert_allclose(observed[:, -2:], WHIP)
    with np.load(tmp_path / "seen" / "rollout.npz") as arrays:
        np.testing.assert_allclose(observed[:, :2], arrays["frames/gripper"][:16], rtol=1e-6)
        np.testing.assert_array_equal(observed[:, 22:28], arrays["hits"][:16])
        where = np.broadcast_to(recording.seen[:16, :, None], (16, 10, 2)).reshape(16, 20)
        np.testing.assert_allclose(observed[:, 2:22][where], arrays["keypoints"][:16].reshape(16, 20)[where], rtol=1e-5)


def test_a_rollout_that_no_camera_saw_is_saved_all_the_same(tmp_path, whip_file, capsys, monkeypatch):
    monkeypatch.setattr(render, "save_pictures", lambda *arguments: [])
    monkeypatch.setattr(commands, "DETECTORS", {"clean": Detector(bias=100.0)})
    assert run("render", "--policy", whip_file, "--out", tmp_path / "lost") == 0
    assert "rollout.npz cannot be inferred from" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "lost").iterdir()] == ["rollout.npz"]


def test_without_mujoco_it_says_what_to_install(tmp_path):
    script = (
        "import sys; sys.modules['mujoco'] = None; from jaxlfi.envs.whip import cli; "
        f"sys.exit(cli.main(['render', '--out', {str(tmp_path / 'out')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr == ("jaxlfi whip: error: the whipping task needs MuJoCo and MJX: pip install 'jaxlfi[whip]'\n")


def test_policies_are_drawn_from_the_seed(monkeypatch):
    draw = lambda policy, seed: np.asarray(commands._actions(policy, jax.random.key(seed), ENGINE, median()))
    np.testing.assert_array_equal(draw("explore", 0), draw("explore", 1))
    np.testing.assert_array_equal(draw("random", 0), draw("random", 0))
    assert (draw("random", 0) != draw("random", 1)).any() and np.abs(draw("random", 0)).max() <= 0.06 + 1e-6


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--length", 400], "length: expected numbers between 0.05 and 0.35, got 0.4 (m, Pa; --length is in mm)"),
        (["--young", "nan"], "young: expected numbers between 500.0 and 500000.0, got nan"),
        (["--detector", "perfect"], "detector: expected one of clean"),
        (["--policy", "nowhere.npz"], "policy: expected explore, random, plan or an .npz file, got 'nowhere.npz'"),
        (["--policy", "{folder}/short.npz"], "policy: expected an array actions of shape [16, 2]"),
        (["--policy", "{folder}/empty.npz"], "got none"),
        (["--policy", "{folder}/nan.npz"], "policy: expected finite actions"),
        (["--policy", "{folder}/text.npz"], "expected a complete .npz file"),
    ],
)
def test_bad_input_is_an_error_of_one_line(tmp_path, capsys, words, message):
    np.savez(tmp_path / "short.npz", actions=np.zeros((15, 2)))
    np.savez(tmp_path / "empty.npz", other=np.zeros((16, 2)))
    np.savez(tmp_path / "nan.npz", actions=np.full((16, 2), np.nan))
    (tmp_path / "text.npz").write_text("actions")
    words = [str(word).format(folder=tmp_path) for word in words]
    assert run("render", *words, "--out", tmp_path / "out") == 2
    error = capsys.readouterr().err
    assert error.startswith("jaxlfi whip: error: ") and message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_nothing_is_overwritten(tmp_path, whip_file, capsys):
    assert run("render", "--out", tmp_path) == 2 and "expected a new or empty folder" in capsys.readouterr().err
    assert run("plan", "--out", whip_file) == 2 and "expected a new .npz file" in capsys.readouterr().err
    assert run("plan", "--out", tmp_path / "plan.txt") == 2 and "got" in capsys.readouterr().err
    with pytest.raises(SystemExit) as stop:
        run("render", "--speed", 3)
    assert stop.value.code == 2 and capsys.readouterr().err.count("\n") == 1


def test_help_needs_no_jax():
    script = (
        "import sys; from jaxlfi.envs.whip import cli\n"
        "try: cli.main(['render', '--help'])\n"
        "except SystemExit as stop: assert stop.code == 0\n"
        "assert not {'jax', 'numpy', 'mujoco', 'matplotlib'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and "--policy" in done.stdout, done.stderr


# -------------------------------------------------------------------------------------------------------- films


def test_a_film_goes_through_the_rollout(monkeypatch):
    """Without contact it is what a simulation of all its pieces in one go gives."""
    parameters, actions = median(length=0.3, young=4e3), np.concatenate([0.5 * WHIP[:4], 0 * WHIP[4:]])
    whip = Whip(ENGINE, DETECTORS["transporter"])
    rollout = jax.jit(render.perform, static_argnums=1)(jax.random.key(0), whip, parameters, actions)
    shot = jax.jit(render.film, static_argnums=(0, 3))(FINE, rollout.parameters, rollout.states, 2)
    assert shot.dlo.shape == (33, 14, 3)
    see = jax.jit(jax.vmap(lambda qpos: frames(ENGINE.scene, parameters, qpos)))
    np.testing.assert_array_equal(shot.dlo[::2], see(rollout.states.qpos).dlo)
    corners = np.concatenate([[START], rollout.states.target[1:]])
    targets = np.stack([np.interp(np.arange(1, 33) / 2, np.arange(17), corners[:, i]) for i in range(2)], axis=-1)
    straight = jax.jit(lambda targets: physics.rollout(FINE, parameters, targets).qpos)(
        jnp.asarray(targets, jnp.float32)
    )
    np.testing.assert_allclose(shot.dlo, see(straight).dlo, atol=2e-4)
    assert np.abs(np.diff(shot.dlo[:, -1, 0])).max() > 0.04  # it moves


# ----------------------------------------------------------------------------------------------------- pictures


def made_up_film(count=9, size=12):
    random = np.random.default_rng(0)
    return figures.Film(
        labels=random.integers(0, 3, (count, size, size)),
        dlo=random.uniform(0.2, 0.8, (count, 4, 2)),
        cubes=random.uniform(0.2, 0.8, (count, 6, 2)),
        seen=np.arange(4 * count).reshape(count, 4) % 5 > 0,
        gripper=random.uniform(0.2, 0.8, (count, 2)),
        captions=[f"caption {t}" for t in range(count)],
        over=np.arange(count) > 4,
        palette=np.array([[1, 1, 1], [1, 0, 0], [0, 0, 1]], np.float32),
        lines={"table": np.array([[0.0, 0.9], [1.0, 0.9]])},
    )


def test_a_sheet_shows_every_frame_and_explains_itself():
    shown, figure = made_up_film(), Figure()
    figures.draw_sheet(figure, shown, "title")
    pictures = figure.axes[:9]
    assert [axes.get_title() for axes in pictures] == shown.captions and len(figure.axes) == 12
    for t, axes in enumerate(pictures):
        np.testing.assert_allclose(axes.collections[0].get_offsets(), shown.dlo[t])
        colours = axes.collections[0].get_facecolor()[:, :3]
        np.testing.assert_array_equal(colours[:, 2] == 1.0, shown.seen[t])
        image = axes.images[0].get_array()
        np.testing.assert_allclose(image[..., :3], shown.palette[shown.labels[t]], atol=0.01)
        np.testing.assert_allclose(image[..., 3], (shown.labels[t] > 0) * (figures.OVER if t > 4 else 1), atol=0.01)
        assert axes.get_ylim() == (1.0, 0.0)  # v is down
    (explained,) = [axes.get_legend() for axes in figure.axes if axes.get_legend()]
    labels = [text.get_text() for text in explained.get_texts()]
    assert labels == ["keypoint on the DLO", "not found: the last", "keypoint of a cube", "gripper", "table"]
    assert figures.sheet_height(17) > figures.sheet_height(11) == figures.sheet_height(6)


def test_an_animation_is_there_as_a_whole_or_not_at_all(tmp_path, monkeypatch):
    def killed(path, content):
        raise KeyboardInterrupt

    monkeypatch.setattr(figures.files, "write_bytes", killed)
    with pytest.raises(KeyboardInterrupt):
        figures.save_animation(tmp_path / "film.gif", made_up_film(2, 20), "title", 0.05, np.ones(2))
    assert not list(tmp_path.iterdir())


def test_an_animation_has_all_frames(tmp_path):
    shown = made_up_film(5, 40)
    path = figures.save_animation(tmp_path / "a" / "film.gif", shown, "title", 0.05, np.ones(5))
    with Image.open(path) as film:
        assert (film.n_frames, film.info["duration"], film.info["loop"]) == (5, 50, 0)
        film.seek(2)
        picture = np.asarray(film.convert("RGB")).astype(float)
    labels = shown.labels[2]
    inside = picture[52 : 52 + 40, 6 : 6 + 40]
    red = (inside[..., 0] > 200) & (inside[..., 1] < 60)
    assert (red & (labels == 1)).sum() > 0.4 * (labels == 1).sum() and (red & (labels != 1)).mean() < 0.02
    assert len(shown.every(2).captions) == 3 and shown.every(2).captions[1] == "caption 2"
