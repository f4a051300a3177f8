"""Data sets of pictures: what is written is read, what is damaged is refused, and what is interrupted goes on."""

import dataclasses
import functools
import json

import jax
import numpy as np
import pytest
from PIL import Image
from scipy import ndimage, stats

pytest.importorskip("mujoco")

from jaxlfi.envs.whip.frames import Frames
from jaxlfi.envs.whip.parameters import HIGHEST, LOWEST
from jaxlfi.envs.whip.physics.engines import pick
from jaxlfi.envs.whip.vision import looks, making, pictures, scenes
from jaxlfi.envs.whip.vision.making import Asked
from jaxlfi.envs.whip.vision.pictures import HEADER, INDEX, LABELS, SIZE, PicturesError
from jaxlfi.envs.whip.vision.raster import DLO
from jaxlfi.envs.whip.vision.renderers import RayCaster

MADE = {"made": {"by": "hand", "numbers": (1, 2)}}
SIX = Asked(count=6, seed=3, renderer="raycast", sharp=False)
"""Of three rollouts in two batches."""
TWO_SHARP = dataclasses.replace(SIX, count=2, sharp=True)


def image_of(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture and labels, no two of whose rows or columns are alike."""
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (SIZE, SIZE, 3), np.uint8), rng.integers(0, len(LABELS), (SIZE, SIZE), np.uint8)


def written(folder, count: int = 2, finished: bool = True):
    """A data set of random pictures."""
    assert pictures.begun(folder, MADE) == 0
    for number in range(count):
        pictures.add(folder, number, *image_of(number), source="noise", grip=[0.5, number / 7])
    assert not finished or pictures.finish(folder) == count
    return folder


def content(folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# ---------------------------------------------------------------------------------------------- written and read


def test_what_is_written_is_read(tmp_path):
    found = pictures.read(written(tmp_path / "a" / "set", 3))
    for i in range(3):
        rgb, labels = image_of(i)
        np.testing.assert_array_equal(found.rgb[i], rgb)
        np.testing.assert_array_equal(found.labels[i], labels)
    files = {"picture": "000001.png", "labels": "000001_labels.png"}
    assert found.entries[1] == {**files, "source": "noise", "grip": [0.5, 1 / 7]}
    assert found.rgb.dtype == found.labels.dtype == np.uint8 and len(found.entries) == 3
    assert found.header["count"] == 3 and found.header["made"] == {"by": "hand", "numbers": [1, 2]}
    assert found.header["labels"] == ["background", "red", "green", "blue", "orange", "purple", "yellow", "dlo"]


def test_other_readers_see_the_same(tmp_path):
    """A picture in RGB, its labels as shades of grey."""
    folder = written(tmp_path / "set", 1)
    with Image.open(folder / "000000.png") as picture, Image.open(folder / "000000_labels.png") as labels:
        assert (picture.format, picture.mode, labels.mode) == ("PNG", "RGB", "L")
        assert picture.getpixel((200, 7)) == tuple(image_of(0)[0][7, 200])
        assert labels.getpixel((200, 7)) == image_of(0)[1][7, 200]


def test_several_together(tmp_path):
    one, other = pictures.read(written(tmp_path / "one", 1)), pictures.read(written(tmp_path / "other", 2))
    both = pictures.together(part for part in (other, one))
    np.testing.assert_array_equal(both.rgb, np.stack([image_of(number)[0] for number in (0, 1, 0)]))
    np.testing.assert_array_equal(both.labels, np.stack([image_of(number)[1] for number in (0, 1, 0)]))
    assert [entry["grip"][1] for entry in both.entries] == [0, 1 / 7, 0]
    assert both.header["count"] == 2


def test_what_was_interrupted_goes_on(tmp_path):
    """A line that was not written to its end is cut off; its picture is written again."""
    folder, whole = written(tmp_path / "part", 2, finished=False), written(tmp_path / "whole", 3)
    with (folder / INDEX).open("a") as index:
        index.write('{"picture": "000002.png", "la')
    (folder / "000002.png").write_bytes(b"\x89PNG")
    assert pictures.begun(folder, MADE) == 2
    pictures.add(folder, 2, *image_of(2), source="noise", grip=[0.5, 2 / 7])
    assert pictures.finish(folder) == 3
    assert content(folder) == content(whole)


def test_an_empty_folder_is_a_new_one(tmp_path):
    assert pictures.begun(tmp_path, MADE) == 0
    assert pictures.begun(tmp_path, MADE) == 0


# --------------------------------------------------------------------------------------------------- what is refused


def header(**changes):
    """Replaces entries of the header."""

    def damage(folder):
        document = {**json.loads((folder / HEADER).read_text()), **changes}
        (folder / HEADER).write_text(json.dumps(document))

    return damage


def index(change):
    """Replaces the second line of the index."""

    def damage(folder):
        first, second = (folder / INDEX).read_text().splitlines()
        (folder / INDEX).write_text("".join(f"{line}\n" for line in (first, *change(second))))

    return damage


def entry(**changes):
    return index(lambda line: [json.dumps({**json.loads(line), **changes})])


def saved(name: str, array):
    return lambda folder: Image.fromarray(array).save(folder / name)


def cut(name: str, share: float):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[: int(share * 70_000)])


def labelled_8():
    labels = image_of(1)[1]
    labels[3, 200] = 8
    return labels


PICTURE, MASK = "000001.png", "000001_labels.png"
DAMAGES = {
    "no folder": (lambda folder: folder.rename(folder.with_name("gone")), "without a readable pictures.json"),
    "no header": (lambda folder: (folder / HEADER).unlink(), "without a readable pictures.json"),
    "half a header": (cut(HEADER, 0.001), "without a readable pictures.json"),
    "a list for a header": (lambda folder: (folder / HEADER).write_text("[1]"), "another kind of file"),
    "another schema": (header(schema="jaxlfi-run"), "expected the schema 'jaxlfi-whip-pictures'"),
    "no count": (lambda folder: (folder / HEADER).write_text('{"schema": "jaxlfi-whip-pictures"}'), "another kind"),
    "another version": (header(version=2), "jaxlfi-whip-pictures of version 1, got version 2, which a newer"),
    "another size": (header(size=128), "size: expected 256, got 128"),
    "other labels": (header(labels=list(LABELS[::-1])), r"labels: expected \['background', 'red'"),
    "no index": (lambda folder: (folder / INDEX).unlink(), "index.jsonl: expected a text file"),
    "a line too few": (index(lambda line: []), "index.jsonl: expected 2 lines, got 1"),
    "a line too many": (index(lambda line: [line, line]), "index.jsonl: expected 2 lines, got 3"),
    "another count": (header(count=7), "index.jsonl: expected 7 lines, got 2"),
    "half a line": (index(lambda line: [line[:30]]), "line 2: expected picture, labels, source, got '{"),
    "a list for a line": (index(lambda line: ["[1, 2]"]), r"line 2: expected picture, labels, source, got '\[1"),
    "a line without a source": (entry(source=None), "line 2: expected picture, labels, source"),
    "a number for a file": (entry(labels=1), "line 2: expected picture, labels, source"),
    "a file elsewhere": (entry(picture="../000001.png"), r"line 2: picture: expected a file's name, got '\.\./"),
    "an absolute path": (entry(labels="/etc/passwd"), "line 2: labels: expected a file's name, got '/etc/passwd'"),
    "a folder for a file": (entry(picture=".."), "expected a complete PNG file"),
    "no picture": (lambda folder: (folder / PICTURE).unlink(), f"{PICTURE}: expected a complete PNG file"),
    "no labels": (lambda folder: (folder / MASK).unlink(), f"{MASK}: expected a complete PNG file"),
    "half a picture": (cut(PICTURE, 0.5), f"{PICTURE}: expected a complete PNG file"),
    "the beginning of a picture": (cut(PICTURE, 0.0005), f"{PICTURE}: expected a complete PNG file"),
    "half of the labels": (cut(MASK, 0.1), f"{MASK}: expected a complete PNG file"),
    "no image": (lambda folder: (folder / PICTURE).write_text("no"), f"{PICTURE}: expected a complete PNG file"),
    "a small picture": (saved(PICTURE, image_of(0)[0][:, :128]), "expected 256 x 256 x 3 bytes, got .256, 128, 3."),
    "a grey picture": (saved(PICTURE, image_of(0)[1]), "expected 256 x 256 x 3 bytes, got .256, 256."),
    "coloured labels": (saved(MASK, image_of(0)[0]), "expected 256 x 256 bytes, got .256, 256, 3."),
    "deep labels": (saved(MASK, image_of(0)[1].astype(np.uint16)), "expected 256 x 256 bytes, got .256, 256. of"),
    "unknown labels": (saved(MASK, labelled_8()), f"{MASK}: expected labels from 0 to 7, got 8"),
    "an index that is no text": (lambda folder: (folder / INDEX).write_bytes(b"\xff\xfe\n\xff\n"), "index.jsonl"),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_damaged_is_refused(tmp_path, name):
    damage, says = DAMAGES[name]
    folder = written(tmp_path / "set")
    pictures.read(folder)
    damage(folder)
    with pytest.raises(PicturesError, match=says):
        pictures.read(folder)


def test_what_was_interrupted_is_not_read(tmp_path):
    with pytest.raises(PicturesError, match="got one that was interrupted: repeat its command"):
        pictures.read(written(tmp_path / "set", finished=False))


def test_a_whole_set_of_nothing_is_not_read(tmp_path):
    with pytest.raises(PicturesError, match="expected 0 lines, got 0"):
        pictures.read(written(tmp_path / "set", 0))


def a_file(path):
    path.write_text("a letter")


def a_folder_of_others(path):
    path.mkdir()
    (path / "letter.txt").write_text("a letter")


@pytest.mark.parametrize(
    ("there", "says"),
    [
        (a_file, "out: expected a new folder, got .*set, which is a file"),
        (a_folder_of_others, "without a readable pictures.json"),
        (written, "out: expected a new folder, got .*set, which contains a complete data set"),
        (lambda path: header(version=0)(written(path, finished=False)), "of version 1, got version 0"),
        (lambda path: pictures.begun(path, {"made": {"by": "another"}}), "or one begun by the same command"),
        (lambda path: pictures.begun(path, {**MADE, "more": 1}), "or one begun by the same command"),
    ],
    ids=["file", "others", "whole", "version", "command", "more"],
)
def test_nothing_that_is_there_is_overwritten(tmp_path, there, says):
    there(tmp_path / "set")
    before = content(tmp_path / "set") if (tmp_path / "set").is_dir() else (tmp_path / "set").read_bytes()
    with pytest.raises(PicturesError, match=says):
        pictures.begun(tmp_path / "set", MADE)
    assert before == (content(tmp_path / "set") if (tmp_path / "set").is_dir() else (tmp_path / "set").read_bytes())


# -------------------------------------------------------------------------------------------------- random scenes


class Interrupted(Exception):
    """In place of what a user interrupts by."""


@functools.cache
def plain():
    line = np.linspace([0.4, 0.0, 0.36], [0.4, 0.0, 0.1], 25)
    return jax.device_get(looks.plain(Frames(line[0, [0, 2]], line, np.zeros((6, 3)), np.eye(6, 4))))


@pytest.fixture(autouse=True, scope="module")
def little():
    """Two pictures of a rollout, two rollouts at a time, and looks that take no compiling: of random colours only."""
    coloured = lambda key, frame: plain().replace(colours=jax.random.uniform(key, (7, 3)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scenes, "BATCH", 2)
        patch.setattr(making, "A_ROLLOUT", 2)
        patch.setattr(making, "_look", coloured)
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A data set made in one go."""
    folder, counts = tmp_path_factory.mktemp("sets") / "whole", []
    assert making.make(SIX, folder, pick("auto"), counts.append) == 6
    assert counts == list(range(7))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("after", [1, 5], ids=["first batch", "second batch"])
def test_a_set_that_was_interrupted_is_that_made_in_one_go(whole, tmp_path, after):
    def interrupt(count):
        if count == after:
            raise Interrupted

    folder, counts = tmp_path / "set", []
    if after == 5:  # the first four are those of the other set
        folder.mkdir()
        for name, bytes_ in content(whole).items():
            if name[:6] not in ("000004", "000005"):
                (folder / name).write_bytes(bytes_)
        header(count=None)(folder)
        (folder / INDEX).write_text("".join((folder / INDEX).read_text().splitlines(keepends=True)[:4]))
    with pytest.raises(Interrupted):
        making.make(SIX, folder, pick("auto"), interrupt)
    assert json.loads((folder / HEADER).read_text())["count"] is None
    with (folder / INDEX).open("a") as lines:
        lines.write('{"picture": "0000')
    assert making.make(SIX, folder, pick("auto"), counts.append) == 6
    assert counts == list(range(after, 7))
    assert content(folder) == content(whole)


@pytest.mark.slow
def test_a_picture_does_not_depend_on_how_many_there_are(whole, tmp_path):
    folder = tmp_path / "set"
    making.make(Asked(3, SIX.seed, "raycast", sharp=False), folder, pick("auto"))
    few, many = content(folder), content(whole)
    assert len(few) == 2 + 3 * 2
    assert few[INDEX].splitlines() == many[INDEX].splitlines()[:3]
    for name in few.keys() - {HEADER, INDEX}:
        assert few[name] == many[name]


@pytest.mark.slow
def test_pictures_differ_and_say_what_they_are_of(whole):
    found = pictures.read(whole)
    assert len({rgb.tobytes() for rgb in found.rgb}) == len({labels.tobytes() for labels in found.labels}) == 6
    scene = [entry["scene"] for entry in found.entries]
    assert [one["rollout"] for one in scene] == [0, 0, 1, 1, 2, 2]
    assert len({(one["rollout"], one["step"]) for one in scene}) == 6
    assert scene[0]["length"] == scene[1]["length"] != scene[2]["length"] != scene[4]["length"]
    for one in scene:
        for name, low in vars(LOWEST).items():
            assert np.all(np.subtract(one[name], low) >= -1e-6)
            assert np.all(np.subtract(getattr(HIGHEST, name), one[name]) >= -1e-6 * np.abs(getattr(HIGHEST, name)))
    assert found.header["made"] == {**vars(SIX), "objects": []}
    assert {entry["source"] for entry in found.entries} == {"raycast"}


def beside_nothing(monkeypatch):
    """Looks without a hand or anything else that could hide the DLO."""
    monkeypatch.setattr(making, "look", lambda asked, number, view: plain())


def on_labels(found):
    """Whether keypoints of the DLO, with the grip, are within two pixels of it, and of cubes on them, or hidden."""
    dlos, cubes = [], []
    for labels, line in zip(found.labels, found.entries, strict=True):
        away = ndimage.distance_transform_edt(labels != DLO)
        for number, (u, v) in enumerate([line["grip"], *line["keypoints"]]):
            if not (0 <= u < 1 and 0 <= v < 1):
                continue
            row, column = int(SIZE * v), int(SIZE * u)
            if number < 5:
                dlos.append(1.0 if away[row, column] <= 2 else 0.0 if 0 < labels[row, column] < DLO else np.nan)
            else:
                cubes.append(1.0 if labels[row, column] == number - 4 else 0.0 if labels[row, column] else np.nan)
    return np.array(dlos), np.array(cubes)


@pytest.mark.slow
def test_keypoints_are_on_labels(tmp_path, monkeypatch):
    """On what they are of, or on what hides it; mirrored, they are not."""
    beside_nothing(monkeypatch)
    asked = Asked(8, 5, "raycast", sharp=True)
    making.make(asked, tmp_path / "set", pick("auto"))
    found = pictures.read(tmp_path / "set")
    dlos, cubes = on_labels(found)
    assert len(dlos) > 30 and len(cubes) > 40
    assert np.mean(dlos) > 0.8 and np.mean(cubes) > 0.8  # neither is ever on what is not there
    number, view = next(making.views(asked, pick("auto"), 6))
    rgb, labels = RayCaster(SIZE).render(view.camera, view.frame, view.cube_side, plain())
    np.testing.assert_array_equal(found.rgb[number], rgb)  # sharp: as the renderer has it
    np.testing.assert_array_equal(found.labels[number], labels)
    assert number == 6


@pytest.mark.slow
def test_reference_objects(tmp_path, monkeypatch):
    beside_nothing(monkeypatch)
    actions = scenes.random_actions
    monkeypatch.setattr(scenes, "random_actions", lambda key: actions(key)[:4])  # a quarter of the time
    made = making.make(Asked(2, 1, "raycast", sharp=True, objects=("dlo-0",)), tmp_path / "set", pick("auto"))
    found = pictures.read(tmp_path / "set")
    assert made == 2 and [entry["scene"]["object"] for entry in found.entries] == ["dlo-0"] * 2
    assert found.entries[0]["scene"]["frame"] != found.entries[1]["scene"]["frame"]
    dlos, cubes = on_labels(found)
    assert len(dlos) >= 8 and np.mean(dlos) > 0.7 and np.mean(cubes) > 0.7


@pytest.mark.slow
def test_sharp_pictures_are_of_the_same_scenes_and_looks(whole, tmp_path):
    """Only the camera's faults are missing."""
    making.make(TWO_SHARP, tmp_path / "set", pick("auto"))
    sharp, blurred = pictures.read(tmp_path / "set"), pictures.read(whole)
    np.testing.assert_array_equal(sharp.labels, blurred.labels[:2])
    likeness = np.corrcoef([*sharp.rgb.reshape(2, -1), *blurred.rgb[:2].reshape(2, -1)])
    assert np.mean(sharp.rgb != blurred.rgb[:2]) > 0.1 and likeness[[0, 1], [2, 3]].min() > 0.7
    view = next(making.views(TWO_SHARP, pick("auto"), 1))[1]
    look = making.look(TWO_SHARP, 1, view)
    rgb, _ = RayCaster(SIZE).render(view.camera, view.frame, view.cube_side, look)
    np.testing.assert_array_equal(sharp.rgb[1], rgb)


def test_strewn_cubes_lie_on_the_table_or_fly():
    """Half of them each; those that lie are upright, and all are within bounds. Nothing else of a frame changes."""
    line = np.linspace([0.4, 0.0, 0.36], [0.4, 0.0, 0.1], 25)
    frame = jax.tree.map(np.float32, Frames(line[0, [0, 2]], line, np.zeros((6, 3)), np.tile(np.eye(4)[0], (6, 1))))
    many = jax.jit(jax.vmap(scenes.strewn, in_axes=(0, None, None)))
    found = jax.device_get(many(jax.random.split(jax.random.key(3), 200), frame, 0.03))
    cubes, turns = found.cubes.reshape(-1, 3), found.orientations.reshape(-1, 4)
    lies = np.isclose(cubes[:, 2], 0.015)
    assert stats.binomtest(int(lies.sum()), 1200, 0.5).pvalue > 1e-3
    low, high = np.array(scenes.STREWN)
    for axis, of in ((0, cubes), (1, cubes), (2, cubes[~lies])):
        assert stats.kstest((of[:, axis] - low[axis]) / (high - low)[axis], "uniform").pvalue > 1e-3
    np.testing.assert_allclose(np.linalg.norm(turns, axis=1), 1, atol=1e-5)
    upright = 1 - 2 * (turns[:, 1] ** 2 + turns[:, 2] ** 2)  # how far the cube's own z points up
    assert np.allclose(upright[lies], 1) and stats.kstest(upright[~lies] / 2 + 0.5, "uniform").pvalue > 1e-3
    np.testing.assert_array_equal(found.dlo, np.broadcast_to(frame.dlo, (200, 25, 3)))


def test_one_in_three_has_its_cubes_strewn(monkeypatch):
    """No other picture has strewn cubes."""
    monkeypatch.setattr(making, "A_ROLLOUT", 4)
    stayed = np.full((6, 3), 7.0)
    monkeypatch.setattr(making, "_strewn", lambda key, frame, side: frame.replace(cubes=stayed))
    views = making.views(Asked(8, 3, "raycast", sharp=True), pick("auto"), 0)
    assert [number for number, view in views if np.array_equal(view.frame.cubes, stayed)] == [0, 3, 6]
