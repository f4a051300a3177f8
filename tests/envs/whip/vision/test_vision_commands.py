"""The commands of vision, from making pictures to a recording, as a user gives them."""

import json

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("mujoco")

from jaxlfi.envs.whip import cli
from jaxlfi.envs.whip.vision import pictures, scenes, training, weights
from jaxlfi.envs.whip.vision.learning import Training
from jaxlfi.envs.whip.vision.segmenter import Segmenter
from jaxlfi.envs.whip.vision.training import Preset
from jaxlfi.envs.whip.vision.transporter import Transporter


def run(*words) -> int:
    try:
        return cli.main([str(word) for word in words])
    except SystemExit as stop:
        return stop.code


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Few rollouts at a time, and a short preset."""
    monkeypatch.setattr(scenes, "BATCH", 2)
    tiny = Preset((Segmenter((8, 8, 8)), Transporter(16)), 4, Training(3, 1e-3), 2, 32, 4, Training(3, 1e-3), 4)
    monkeypatch.setattr(training, "PRESETS", {"quick": tiny, "paper": tiny})
    from jaxlfi.envs.whip.vision import commands

    monkeypatch.setattr(commands, "HELD_OUT_PICTURES", 3)
    monkeypatch.setattr(commands, "HELD_OUT_ROLLOUTS", 2)


@pytest.mark.slow
def test_training_makes_what_it_needs_and_weights_that_can_be_used(tmp_path, capsys):
    out = tmp_path / "vision"
    assert run("train-vision", "--out", out) == 0
    shown = capsys.readouterr().out
    assert "DLO overlap" in shown and "drift within a rollout" in shown
    for name in ("segmenter", "transporter"):
        about = weights.load(out / f"{name}.npz", name).about
        assert about["seed"] == 0 and about["figures"] and about["versions"]["jax"]
        assert np.load(out / f"{name}_losses.npz")["losses"].shape == (3,)
    assert pictures.read(out / "pictures").header["made"]["sharp"]
    assert not list(out.glob("*.part.npz"))

    # Given again, it is there already; another command is refused, and nothing is lost.
    before = (out / "segmenter.npz").read_bytes()
    assert run("train-vision", "--out", out) == 0
    assert run("train-vision", "--out", out, "--seed", "1") == 2
    assert "expected the command that" in capsys.readouterr().err
    assert (out / "segmenter.npz").read_bytes() == before

    # One's own pictures, too.
    assert run("train-vision", "--only", "segmenter", "--pictures", out / "pictures", "--out", tmp_path / "own") == 0
    assert not (tmp_path / "own" / "pictures").exists()

    assert run("export-vision", "--weights", out, "--out", tmp_path / "segmenter.onnx") == 0
    assert (tmp_path / "segmenter.onnx").stat().st_size > 1e4
    assert run("export-vision", "--weights", out, "--out", tmp_path / "segmenter.onnx") == 2


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("pictures", "--count", "0", "--out", "new"), "count: expected at least 1"),
        (("pictures", "--object", "dlo-9", "--out", "new"), "dlo-9"),
        (("pictures", "--out", "full"), "expected a folder of pictures"),
        (("train-vision", "--out", "full"), "out: expected a new or empty folder"),
        (
            ("train-vision", "--only", "segmenter", "--pictures", "full", "--out", "new"),
            "expected a folder of pictures",
        ),
        (("train-vision", "--steps", "0", "--out", "new"), "steps: expected at least 1"),
        (("record", "--object", "dlo-9", "--out", "new.npz"), "dlo-9"),
        (("record", "--object", "dlo-1", "--out", "new"), "out: expected a new .npz file"),
        (("record", "--object", "dlo-1", "--detector", "learnt", "--weights", "full", "--out", "new.npz"), "segmenter"),
        (("import-pictures", "--yolo", "full", "--images", "full", "--out", "new"), "classes: expected"),
        (("import-pictures", "--coco", "no.json", "--images", "full", "--out", "new"), "no.json"),
        (
            ("import-pictures", "--coco", "no.json", "--images", "full", "--name", "rope", "--out", "new"),
            "name: expected THEIRS=OURS",
        ),
        (("export-vision", "--out", "new.txt"), "out: expected a new .onnx file"),
        (("export-vision", "--weights", "full", "--out", "new.onnx"), "expected the weights of a segmenter"),
    ],
)
def test_bad_input_gets_one_line_and_leaves_nothing(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "other.txt").write_text("something else")
    assert run(*words) == 2
    error = capsys.readouterr().err.strip()
    assert message in error and len([line for line in error.splitlines() if "error" in line]) == 1
    assert sorted(path.name for path in tmp_path.iterdir() if not path.is_dir() or any(path.iterdir())) == ["full"]


def test_a_labs_own_pictures_are_imported(tmp_path):
    (tmp_path / "images").mkdir()
    Image.fromarray(np.full((300, 300, 3), 90, np.uint8)).save(tmp_path / "images" / "one.png")
    coco = {
        "images": [{"id": 1, "file_name": "one.png", "width": 300, "height": 300}],
        "categories": [{"id": 4, "name": "rope"}],
        "annotations": [
            {"id": 1, "image_id": 1, "category_id": 4, "segmentation": [[30, 60, 90, 60, 90, 240, 30, 240]]}
        ],
    }
    (tmp_path / "coco.json").write_text(json.dumps(coco))
    words = ("--coco", tmp_path / "coco.json", "--images", tmp_path / "images", "--name", "rope=dlo")
    assert run("import-pictures", *words, "--out", tmp_path / "own") == 0
    (labels,) = pictures.read(tmp_path / "own").labels
    assert labels[128, 50] == 7 and labels[128, 200] == 0
    assert np.sum(labels == 7) == pytest.approx(60 * 180 * (256 / 300) ** 2, rel=0.02)
