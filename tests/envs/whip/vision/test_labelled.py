"""Photographs with labels of COCO and YOLO, against masks by hand and run lengths by another encoder."""

import functools
import json

import numpy as np
import pytest
from PIL import Image

from jaxlfi.envs.whip.vision import labelled, pictures
from jaxlfi.envs.whip.vision.pictures import LABELS

RED, GREEN, BLUE, DLO = (LABELS.index(name) for name in ("red", "green", "blue", "dlo"))
CLASSES = ("red", "green cube", "Blue_Cube", "dlo", "apple")
CORNER = ("#...", "##..", "###.", "....")
"""Turned, mirrored or transposed, it is another."""
CORNER_POINTS = [0, 0, 1, 0, 1, 1, 2, 1, 2, 2, 3, 2, 3, 3, 0, 3]
SQUARE = [0, 0, 2, 0, 2, 2, 0, 2]


def pattern(rows):
    return np.array([[character == "#" for character in row] for row in rows])


def enlarged(mask, label=RED):
    """Labels of a square picture whose side divides 256."""
    return np.kron(mask, np.ones((256 // len(mask),) * 2)).astype(np.uint8) * label


def counts_of(mask):
    """Run lengths down the columns; the first is outside."""
    flat = np.ravel(mask, order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    counts = np.diff([0, *changes, flat.size]).tolist()
    return [0, *counts] if flat[0] else counts


def compressed(counts):
    """Run lengths from the fourth on as differences, in two's complement of as many groups of five bits as it takes."""
    text = ""
    for place, count in enumerate(counts):
        number = count - counts[place - 2] if place > 2 else count
        groups = next(n for n in range(1, 20) if -(2 ** (5 * n - 1)) <= number < 2 ** (5 * n - 1))
        bits = format(number % 2 ** (5 * groups), f"0{5 * groups}b")
        fives = [int(bits[start : start + 5], 2) for start in range(0, len(bits), 5)][::-1]
        text += "".join(chr(48 + five + 32) for five in fives[:-1]) + chr(48 + fives[-1])
    return text


def rle(mask, compress=False):
    counts = counts_of(mask)
    return {"counts": compressed(counts) if compress else counts, "size": list(np.shape(mask))}


def saved(path, rgb, **options):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.asarray(rgb, np.uint8)).save(path, **options)


def grey(width, height):
    return np.full((height, width, 3), 100)


def annotation(segmentation, category=0, image=1, **more):
    return {"id": 7, "image_id": image, "category_id": category, "segmentation": segmentation, "iscrowd": 0, **more}


def coco(annotations, files=(("a.png", 4, 4),), classes=CLASSES, **changes):
    """A COCO document; images are numbered from 1, categories from 0."""
    return {
        "images": [
            {"id": number, "file_name": name, "width": width, "height": height}
            for number, (name, width, height) in enumerate(files, start=1)
        ],
        "annotations": list(annotations),
        "categories": [{"id": number, "name": name} for number, name in enumerate(classes)],
        **changes,
    }


def from_coco(folder, document, out="out", **options):
    """The data set of a document and the pictures in FOLDER/images."""
    (folder / "coco.json").write_text(json.dumps(document))
    count = labelled.from_coco(folder / "coco.json", folder / "images", folder / out, **options)
    data = pictures.read(folder / out)
    assert count == len(data.rgb) == data.header["count"]
    return data


def from_yolo(folder, texts, out="out", classes=CLASSES, **options):
    """The data set of texts by their files' names and the pictures in FOLDER/images."""
    (folder / "labels").mkdir(exist_ok=True)
    for name, text in texts.items():
        path = folder / "labels" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    count = labelled.from_yolo(folder / "labels", folder / "images", folder / out, classes, **options)
    data = pictures.read(folder / out)
    assert count == len(data.rgb) == data.header["count"]
    return data


@pytest.fixture
def four(tmp_path):
    """A folder with one picture of 4 x 4 pixels."""
    saved(tmp_path / "images/a.png", grey(4, 4))
    return tmp_path


class TestPolygons:
    @pytest.mark.parametrize(
        ("outlines", "rows"),
        [
            ([CORNER_POINTS], CORNER),
            ([[1, 1, 4, 1, 4, 2, 1, 2]], ("....", ".###", "....", "....")),
            ([[0.4, 0.4, 0.6, 0.4, 0.6, 2.6, 0.4, 2.6]], ("#...", "#...", "#...", "....")),
            ([[0.6, 0, 1.4, 0, 1.4, 4, 0.6, 4]], ("....",) * 4),
            ([[0, 0, 4, 0, 0, 3.9]], ("###.", "##..", "#...", "....")),
            ([[-3, 2, 7, 2, 7, 3, -3, 3]], ("....", "....", "####", "....")),
            ([SQUARE, [1, 1, 3, 1, 3, 3, 1, 3]], ("##..", "###.", ".##.", "....")),
        ],
    )
    @pytest.mark.parametrize("backwards", [False, True])
    def test_pixels_are_inside_where_their_centre_is(self, four, outlines, rows, backwards):
        if backwards:
            outlines = [np.reshape(one, (-1, 2))[::-1].ravel().tolist() for one in outlines]
        data = from_coco(four, coco([annotation(outlines)]))
        np.testing.assert_array_equal(data.labels[0], enlarged(pattern(rows)))

    def test_triangles_are_the_intersection_of_three_half_planes(self, tmp_path):
        width, height = 256, 256
        saved(tmp_path / "images/a.png", grey(width, height))
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        corners = np.random.default_rng(0).uniform(-20, 276, (8, 3, 2))
        inside = np.zeros((height, width), bool)
        for triangle in corners:
            sides = []
            for (x0, y0), (x1, y1) in zip(triangle, np.roll(triangle, 1, axis=0), strict=True):
                sides.append((x1 - x0) * (y - y0) - (y1 - y0) * (x - x0) > 0)
            inside |= np.all(sides, axis=0) | ~np.any(sides, axis=0)
        data = from_coco(tmp_path, coco([annotation(corners.reshape(8, 6).tolist())], [("a.png", width, height)]))
        np.testing.assert_array_equal(data.labels[0], RED * inside)
        assert 0.1 < inside.mean() < 0.9


class TestRunLengths:
    PUBLISHED = ([6, 1, 40, 4, 5, 4, 5, 4, 21], "61X13mN000`0", [9, 10])

    def test_the_encoder_of_these_tests_gives_a_published_string(self):
        counts, text, _ = self.PUBLISHED
        assert compressed(counts) == text
        assert compressed([0, 6, 1]) == "061"
        assert counts_of([[False, True], [True, True]]) == [1, 3]

    def test_a_published_example(self, tmp_path):
        counts, text, size = self.PUBLISHED
        for name in ("a.png", "b.png"):
            saved(tmp_path / "images" / name, grey(10, 9))
        both = [annotation({"counts": one, "size": size}, image=n) for n, one in enumerate((counts, text), start=1)]
        data = from_coco(tmp_path, coco(both, [("a.png", 10, 9), ("b.png", 10, 9)]))
        # Runs end after 6, 7, 47, 51, 56, 60, 65, 69 and 90 pixels, of 9 a column: row 6 of the first column, and the
        # rows 2 to 5 of the columns 5, 6 and 7. The square is of the columns 0 to 8.
        mask = np.zeros((9, 9), bool)
        mask[6, 0] = mask[2:6, 5:8] = True
        places = (np.arange(256) * 9 + 4) // 256
        np.testing.assert_array_equal(data.labels[0], RED * mask[np.ix_(places, places)])
        np.testing.assert_array_equal(data.labels[1], data.labels[0])

    @pytest.mark.parametrize("compress", [False, True])
    def test_masks_of_one_pixel_to_long_runs(self, tmp_path, compress):
        rng = np.random.default_rng(1)
        masks = [rng.random((256, 256)) < 0.5, np.ones((256, 256), bool), np.zeros((256, 256), bool)]
        masks.append(np.add.outer(np.arange(256), 256 * np.arange(256)) % 30_000 < 7_000)
        masks.append(np.kron(pattern(CORNER), np.ones((64, 64))) > 0)
        files = [(f"{number}.png", 256, 256) for number in range(len(masks))]
        for name, *_ in files:
            saved(tmp_path / "images" / name, grey(256, 256))
        crowd = [
            annotation(rle(mask, compress), CLASSES.index("dlo"), n, iscrowd=1) for n, mask in enumerate(masks, start=1)
        ]
        data = from_coco(tmp_path, coco(crowd, files))
        np.testing.assert_array_equal(data.labels, DLO * np.array(masks))


class TestYolo:
    def test_is_the_data_set_of_coco(self, tmp_path):
        rng = np.random.default_rng(2)
        sizes = {"a.png": (400, 300), "b.JPG": (300, 517), "c/d.png": (64, 64), "e.png": (20, 30)}
        annotations, texts = [], {"a.txt": "", "b.txt": "\n", "c/d.txt": ""}
        for number, (name, (width, height)) in enumerate(sizes.items(), start=1):
            saved(tmp_path / "images" / name, rng.integers(0, 256, (height, width, 3)))
            for category in range(4) if name != "e.png" else ():
                points = rng.uniform(0, 1, (4, 2))
                outline = (points * [width, height]).ravel().tolist()
                annotations.append(annotation([outline], category, number))
                label = name.rsplit(".", 1)[0] + ".txt"
                texts[label] += f"{category} {' '.join(map(repr, points.ravel().tolist()))}\n\n"
        of_coco = from_coco(tmp_path, coco(annotations, [(name, *size) for name, size in sizes.items()]), "coco")
        of_yolo = from_yolo(tmp_path, texts, "yolo")
        np.testing.assert_array_equal(of_yolo.rgb, of_coco.rgb)
        np.testing.assert_array_equal(of_yolo.labels, of_coco.labels)
        assert of_yolo.entries == of_coco.entries
        assert [entry["file"] for entry in of_yolo.entries] == list(sizes)
        assert {entry["source"] for entry in of_yolo.entries} == {"photograph"}
        assert set(np.unique(of_yolo.labels[:3])) == {0, RED, GREEN, BLUE, DLO}
        assert not of_yolo.labels[3].any()

    def test_a_shape_by_hand(self, four):
        data = from_yolo(four, {"a.txt": "1 " + " ".join(str(x / 4) for x in CORNER_POINTS)})
        np.testing.assert_array_equal(data.labels[0], enlarged(pattern(CORNER), GREEN))

    def test_other_files_are_left_alone(self, four):
        for name in ("images/notes.md", "images/.DS_Store", "images/._a.png", "labels/classes.txt"):
            (four / name).parent.mkdir(exist_ok=True)
            (four / name).write_text("other")
        assert from_yolo(four, {}).labels.max() == 0


class TestOverlap:
    SMALL, LARGE = annotation([[0, 0, 1, 0, 1, 2, 0, 2]], 1), annotation([[0, 0, 4, 0, 4, 3, 0, 3]], 0)
    EXPECTED = pattern(("####", "####", "####", "....")) * RED

    @pytest.mark.parametrize("order", [1, -1])
    def test_small_shapes_are_over_large_ones(self, four, order):
        data = from_coco(four, coco([self.SMALL, self.LARGE][::order]))
        expected = self.EXPECTED.copy()
        expected[:2, 0] = GREEN
        np.testing.assert_array_equal(data.labels[0], enlarged(expected, 1))

    @pytest.mark.parametrize("order", [1, -1])
    def test_of_equal_ones_the_later_is_over_the_earlier(self, four, order):
        shapes = [annotation([[0, 0, 2, 0, 2, 1, 0, 1]], 1), annotation([[1, 0, 3, 0, 3, 1, 1, 1]], 2)]
        data = from_coco(four, coco(shapes[::order]))
        assert data.labels[0, 0, ::64].tolist() == [GREEN, BLUE if order > 0 else GREEN, BLUE, 0]


class TestPictures:
    @pytest.mark.parametrize(("width", "height"), [(775, 768), (768, 775)])
    def test_the_square_in_the_middle_shrinks_to_means(self, tmp_path, width, height):
        rgb = np.random.default_rng(3).integers(0, 256, (height, width, 3))
        mask = np.add.outer(5 * np.arange(height), np.arange(width) ** 2) % 997 < 400
        saved(tmp_path / "images/a.bmp", rgb)
        data = from_coco(tmp_path, coco([annotation(rle(mask, True))], [("a.bmp", width, height)]))
        middle = np.s_[:, 3:771] if width > height else np.s_[3:771]
        means = rgb[middle].reshape(256, 3, 256, 3, 3).mean((1, 3))
        assert np.abs(data.rgb[0] - means).max() < 1  # columns and rows are rounded in turn
        np.testing.assert_array_equal(data.labels[0], RED * mask[middle][1::3, 1::3])

    def test_small_ones_grow_linearly(self, tmp_path):
        ramp = np.array([[0, 200, 90], [0, 200, 90]])
        saved(tmp_path / "images/a.png", np.repeat(ramp[..., None], 3, axis=2))
        data = from_coco(tmp_path, coco([], [("a.png", 3, 2)]))
        expected = np.interp((np.arange(256) + 0.5) / 128, [0.5, 1.5], [0, 200])
        assert np.abs(data.rgb[0] - expected[:, None]).max() < 1

    def test_those_of_256_pixels_stay(self, tmp_path):
        rgb = np.random.default_rng(4).integers(0, 256, (256, 256, 3))
        saved(tmp_path / "images/a.png", rgb)
        np.testing.assert_array_equal(from_coco(tmp_path, coco([], [("a.png", 256, 256)])).rgb[0], rgb)

    def test_are_turned_upright(self, tmp_path):
        upright = np.random.default_rng(5).integers(0, 256, (300, 256, 3))
        exif = Image.Exif()
        exif[0x0112] = 6  # the camera was turned: the picture is to be turned to the right
        saved(tmp_path / "images/a.png", np.rot90(upright), exif=exif)
        outline = [0, 22, 100, 22, 100, 40, 0, 40]
        data = from_coco(tmp_path, coco([annotation([outline])], [("a.png", 256, 300)]))
        np.testing.assert_array_equal(data.rgb[0], upright[22:278])
        expected = np.zeros((256, 256))
        expected[:18, :100] = RED
        np.testing.assert_array_equal(data.labels[0], expected)
        with pytest.raises(ValueError, match=r"a\.png: width: expected 256, as the picture has upright, got 300"):
            from_coco(tmp_path, coco([], [("a.png", 300, 256)]), "other")

    @pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGBA"])
    def test_of_other_modes_become_red_green_and_blue(self, tmp_path, mode):
        (tmp_path / "images").mkdir()
        image = Image.new("RGBA", (4, 4), (255, 255, 255, 7)).convert(mode)
        image.save(tmp_path / "images/a.png", **({"transparency": b"\x07" * 256} if mode == "P" else {}))
        np.testing.assert_array_equal(from_coco(tmp_path, coco([])).rgb, np.full((1, 256, 256, 3), 255))

    def test_sizes_may_be_left_out(self, four):
        assert len(from_coco(four, coco([], images=[{"id": "x", "file_name": "a.png"}])).rgb) == 1


class TestNames:
    @pytest.mark.parametrize(
        ("name", "label"),
        [
            ("RED", "red"),
            (" Green Cube", "green"),
            ("blue_cube", "blue"),
            ("orange-cube", "orange"),
            ("purple", "purple"),
            ("Yellow CUBE", "yellow"),
            ("DLO", "dlo"),
            ("background", "background"),
        ],
    )
    def test_our_own_are_known(self, four, name, label):
        data = from_coco(four, coco([annotation([[0, 0, 4, 0, 4, 4, 0, 4]])], classes=[name]))
        assert np.unique(data.labels).tolist() == [LABELS.index(label)]

    @pytest.mark.parametrize("reader", ["coco", "yolo"])
    def test_others_are_mapped(self, four, reader):
        names = {"Apple": "green cube", "red": "background"}
        shapes = {4: SQUARE, 0: [2, 2, 4, 2, 4, 4, 2, 4]}
        if reader == "coco":
            document = coco([annotation([points], category) for category, points in shapes.items()])
            data = from_coco(four, document, names=names)
        else:
            lines = [f"{category} {' '.join(str(x / 4) for x in points)}" for category, points in shapes.items()]
            data = from_yolo(four, {"a.txt": "\n".join(lines)}, names=names)
        np.testing.assert_array_equal(data.labels[0], enlarged(pattern(("##..", "##..", "....", "....")), GREEN))
        assert data.header["made"]["names"] == names

    def test_those_of_no_shape_need_not_be_known(self, four):
        assert from_coco(four, coco([annotation([SQUARE])], classes=["red", "unused"])).labels.max() == RED


def test_an_interrupted_data_set_goes_on(tmp_path, monkeypatch):
    names = [f"{number}.png" for number in range(4)]
    for number, name in enumerate(names):
        saved(tmp_path / "images" / name, grey(4, 4) + number)
    texts = {f"{number}.txt": f"{number} 0 0 1 0 1 1" for number in range(4)}
    whole = from_yolo(tmp_path, texts, "whole")
    add = pictures.add

    def interrupted(folder, number, *rest, **entry):
        if number == 2:
            raise KeyboardInterrupt
        add(folder, number, *rest, **entry)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(pictures, "add", interrupted)
        from_yolo(tmp_path, texts, "out")
    with pytest.raises(ValueError, match="interrupted"):
        pictures.read(tmp_path / "out")
    progress = []
    data = from_yolo(tmp_path, texts, "out", on_picture=lambda *so_far: progress.append(so_far))
    assert progress == [(3, 4), (4, 4)]
    np.testing.assert_array_equal(data.rgb, whole.rgb)
    np.testing.assert_array_equal(data.labels, whole.labels)
    assert data.entries == whole.entries
    with pytest.raises(ValueError, match="complete data set"):
        from_yolo(tmp_path, texts, "out")


def refused(folder, match, call):
    """The call is refused in one line, and leaves nothing behind."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(ValueError, match=match) as caught:
        call(folder, folder / "out")
    assert "\n" not in str(caught.value)
    assert sorted(folder.rglob("*")) == before


def bad(segmentation, **more):
    """A document of a shape that is good and one that is to be refused."""
    return coco([annotation([SQUARE], id=1), annotation(segmentation, **more)])


class TestRefusedOfCoco:
    @pytest.mark.parametrize(
        ("document", "match"),
        [
            (bad([[0, 0, 1, 0, 1, 1, 2]]), r"annotation 7: segmentation: .*at least 3 points.* got 7 numbers"),
            (bad([[0, 0, 1, 1]]), r"annotation 7: .*at least 3 points.* got 4 numbers"),
            (bad([SQUARE, []]), r"annotation 7: .*at least 3 points.* got 0 numbers"),
            (bad([[0, 0, float("nan"), 0, 1, 1]]), r"annotation 7: .*expected a number from 0 to about 4, got nan"),
            (bad([[0, 0, 1, float("-inf"), 1, 1]]), r"annotation 7: .*got -inf"),
            (bad([[0, 0, 1, 1e9, 1, 1]]), r"annotation 7: .*got 1000000000\.0"),
            (bad([[0, 0, 1, 10**400, 1, 1]]), r"annotation 7: .*got 10000"),
            (bad([[0, 0, "1", 0, 1, 1]]), r"annotation 7: .*got '1'"),
            (bad(SQUARE), r"annotation 7: segmentation: expected polygons or run lengths, got \[0, 0"),
            (bad([]), r"annotation 7: segmentation: expected polygons or run lengths, got \[\]"),
            (bad(None), r"annotation 7: segmentation: .*got None"),
            (bad({"counts": [3, 4], "size": [4, 4]}), r"annotation 7: counts: expected 16 pixels in all, got 7"),
            (bad({"counts": "34", "size": [4, 4]}), r"annotation 7: counts: expected 16 pixels in all, got 7"),
            (bad({"counts": [20, -4], "size": [4, 4]}), r"annotation 7: counts: expected lengths of runs"),
            (bad({"counts": [8.0, 8], "size": [4, 4]}), r"annotation 7: counts: expected lengths of runs"),
            (bad({"counts": "d0L", "size": [4, 4]}), r"annotation 7: counts: expected lengths of runs, got \[20, -4\]"),
            (bad({"counts": "8!", "size": [4, 4]}), r"annotation 7: counts: expected compressed run lengths, got '8!'"),
            (bad({"counts": "8X", "size": [4, 4]}), r"annotation 7: counts: .*got '8X', which is cut off"),
            (bad({"counts": "o" * 1000, "size": [4, 4]}), r"annotation 7: counts: expected compressed run lengths"),
            (bad({"size": [4, 4]}), r"annotation 7: counts: expected lengths of runs, got None"),
            (
                bad({"counts": [32], "size": [4, 8]}),
                r"annotation 7: size: expected the picture's, \[4, 4\], got \[4, 8\]",
            ),
            (bad([SQUARE], image_id=2), r"annotation 7: image_id: expected one of the images, got 2"),
            (bad([SQUARE], image_id=[1]), r"annotation 7: image_id: expected one of the images, got \[1\]"),
            (bad([SQUARE], category_id=9), r"annotation 7: category_id: expected one of the categories, got 9"),
            (
                bad([SQUARE], category_id=4),
                r"classes: expected one of background, red, .*dlo, .*--name 'apple'=dlo",
            ),
            (coco([], files=[]), r"coco\.json: expected pictures, got none"),
            (coco([], [("b.png", 4, 4)]), r"b\.png: expected a picture, got no file"),
            (coco([], [("damaged.png", 4, 4)]), r"damaged\.png: expected a picture, got a file that is damaged"),
            (coco([], [("text.png", 4, 4)]), r"text\.png: expected a picture, got a file that is damaged"),
            (coco([], [("deep.png", 4, 4)]), r"deep\.png: expected a picture of 8 bits a channel, got .*I;16"),
            (coco([], [("a.png", 5, 4)]), r"a\.png: width: expected 4, .* got 5"),
            (coco([], [("a.png", 4, 3)]), r"a\.png: height: expected 4, .* got 3"),
            (
                coco([], [("../secret.png", 4, 4)]),
                r"image 1: file_name: .*in the folder of the images, got '\.\./secret",
            ),
            (coco([], [("b/../../secret.png", 4, 4)]), r"image 1: file_name: .*in the folder of the images"),
            (coco([], [("/secret.png", 4, 4)]), r"image 1: file_name: .*in the folder of the images"),
            (coco([], [("", 4, 4)]), r"image 1: file_name: .*in the folder of the images, got ''"),
            (coco([], images=[{"id": 1}]), r"image 1: file_name: .*got None"),
            (coco([], images=[{"file_name": "a.png"}]), r"images: expected an id of its own for each, got None"),
            (
                coco([], images=2 * [{"id": 1, "file_name": "a.png"}]),
                r"images: expected an id of its own for each, got 1",
            ),
            (coco([], categories=2 * [{"id": 1, "name": "red"}]), r"categories: expected an id of its own for each"),
            (coco([annotation([SQUARE])], categories=[{"id": 0}]), r"category 0: name: expected a string, got None"),
            ({**coco([]), "annotations": {}}, r"coco\.json: expected a COCO file, got no list 'annotations'"),
            (coco([], categories=["red"]), r"coco\.json: expected a COCO file, got no list 'categories'"),
            ([], r"coco\.json: expected a COCO file, got no list 'images'"),
        ],
    )
    def test_what_does_not_fit(self, four, document, match):
        saved(four / "secret.png", grey(4, 4))
        (four / "images/damaged.png").write_bytes((four / "images/a.png").read_bytes()[:-30])
        (four / "images/text.png").write_text("text")
        Image.fromarray(np.zeros((4, 4), np.uint16)).save(four / "images/deep.png")
        path = four / "coco.json"
        path.write_text(json.dumps(document))
        refused(four, match, lambda folder, out: labelled.from_coco(path, folder / "images", out))

    @pytest.mark.parametrize("content", [None, b"{", b"\xff\xfe\xfa", b"[" * 100_000])
    def test_files_that_are_no_json(self, four, content):
        path = four / "coco.json"
        if content is not None:
            path.write_bytes(content)
        refused(
            four,
            r"coco\.json: expected a COCO file, got",
            lambda folder, out: labelled.from_coco(path, folder / "images", out),
        )

    def test_mappings_to_what_is_no_label(self, four):
        (four / "coco.json").write_text(json.dumps(coco([])))
        call = functools.partial(labelled.from_coco, four / "coco.json", names={"apple": "fruit"})
        refused(
            four,
            "names: expected one of background, .* for 'apple', got 'fruit'",
            lambda f, out: call(f / "images", out),
        )

    def test_bad_input_after_good_leaves_nothing_behind(self, four):
        saved(four / "images/b.png", grey(4, 4))
        document = coco([annotation([SQUARE]), annotation([[1]], image=2)], [("a.png", 4, 4), ("b.png", 4, 4)])
        (four / "coco.json").write_text(json.dumps(document))
        refused(four, "annotation 7", lambda f, out: labelled.from_coco(f / "coco.json", f / "images", out))

    def test_folders_of_something_else(self, four):
        (four / "out").mkdir()
        (four / "out/mine.txt").write_text("mine")
        (four / "coco.json").write_text(json.dumps(coco([])))
        refused(four, "folder of pictures", lambda f, out: labelled.from_coco(f / "coco.json", f / "images", out))


class TestRefusedOfYolo:
    @pytest.mark.parametrize(
        ("text", "match"),
        [
            ("0 0 0 1 0 1 1\n0 0 0 1 0 1", r"a\.txt, line 2: .*at least 3 points.* got 5 numbers"),
            ("\n0 0.5 0.5 0.1 0.1", r"a\.txt, line 2: .*at least 3 points \(boxes are not masks\), got 4 numbers"),
            ("0 0 0 1 0 nan 1", r"a\.txt, line 1: expected a number from 0 to about 1, got nan"),
            ("0 0 0 1 0 inf 1", r"a\.txt, line 1: .*got inf"),
            ("0 0 0 300 0 300 300", r"a\.txt, line 1: expected a number from 0 to about 1, got 300\.0"),
            ("0 0 0 1 0 one 1", r"a\.txt, line 1: expected numbers, got '0 0 0 1 0 one 1'"),
            ("5 0 0 1 0 1 1", r"a\.txt, line 1: expected a class from 0 to 4, got '5'"),
            ("-1 0 0 1 0 1 1", r"a\.txt, line 1: expected a class from 0 to 4, got '-1'"),
            ("red 0 0 1 0 1 1", r"a\.txt, line 1: expected a class from 0 to 4, got 'red'"),
            ("4 0 0 1 0 1 1", r"classes: expected one of background, red, .*got 'apple'"),
            (b"\xff\xfe\xfa", r"a\.txt: expected labels, got a file that is missing or no text"),
        ],
    )
    def test_lines_that_are_no_shapes(self, four, text, match):
        (four / "labels").mkdir()
        (four / "labels/a.txt").write_bytes(text if isinstance(text, bytes) else text.encode())
        self.refused(four, match)

    def test_no_pictures(self, four):
        (four / "labels").mkdir()
        (four / "images/a.png").unlink()
        self.refused(four, r"images: expected pictures \(.*\.jpg.*\), got none")

    def test_damaged_pictures(self, four):
        (four / "labels").mkdir()
        (four / "images/b.jpg").write_bytes(b"damaged")
        self.refused(four, r"b\.jpg: expected a picture, got a file that is damaged")

    def test_two_pictures_of_one_name(self, four):
        (four / "labels").mkdir()
        saved(four / "images/a.jpg", grey(4, 4))
        self.refused(four, r"a\.txt: expected one picture of this name .*, got several")

    def test_labels_of_other_pictures(self, four):
        (four / "labels").mkdir()
        (four / "labels/b.txt").write_text("")
        self.refused(four, r"labels: expected NAME\.txt for pictures in .*, got .*b\.txt and others of no picture")

    @pytest.mark.parametrize("name", ["labels", "images"])
    def test_folders_that_are_not_there(self, four, name):
        (four / "labels").mkdir()
        (four / name).rename(four / "moved")
        self.refused(four, f"{name}: expected a folder, got")

    @staticmethod
    def refused(folder, match):
        refused(folder, match, lambda f, out: labelled.from_yolo(f / "labels", f / "images", out, CLASSES))


class TestClasses:
    @pytest.mark.parametrize(
        ("name", "text"),
        [
            ("classes.txt", "red\ngreen cube\ndlo\n"),
            ("classes.txt", "\ufeffred \r\ngreen cube\r\ndlo\r\n\r\n"),
            ("obj.names", "red\ngreen cube\ndlo"),
            ("data.yaml", "train: ../images  # names: [no]\nnc: 3\nnames: [red, 'green cube', \"dlo\"]\n"),
            ("data.yaml", "names: [  # in order\n  red,\n  green cube,\n  dlo,\n]\nnc: 3\n"),
            ("data.yml", "names:\n- red\n- green cube  # the second\n- dlo\nnc: 3\n"),
            ("data.yaml", "path: x\nnames:\n  - 'red'\n\n  # more\n  - green cube\n  - dlo"),
            ("data.yaml", 'names:\n  0: red\n  2: dlo\n  1: "green cube"\nroboflow:\n  names: 3\n'),
            ("data.yaml", "names: {0: red, 1: green cube, 2: dlo}\n"),
        ],
    )
    def test_are_read(self, tmp_path, name, text):
        (tmp_path / name).write_bytes(text.encode())
        assert labelled.read_classes(tmp_path / name) == ["red", "green cube", "dlo"]

    @pytest.mark.parametrize(
        ("name", "text", "match"),
        [
            ("classes.txt", "", "expected the name of a class in each line, got no line"),
            ("classes.txt", "red\n\ndlo\n", "expected the name of a class in each line, got an empty line"),
            ("classes.json", '["red"]', r"expected a text file \(\.txt\) or a data\.yaml, got another"),
            ("data.yaml", "nc: 3\n", "expected `names:` once, got it 0 times"),
            ("data.yaml", "names: [red]\nnames: [dlo]\n", "expected `names:` once, got it 2 times"),
            ("data.yaml", "names:\nnc: 3\n", "expected the name of a class in each line, got no line"),
            ("data.yaml", "names: []\n", "names: expected .*, got ''"),
            ("data.yaml", "names: [red, , dlo]\n", "names: expected .*, got ' '"),
            ("data.yaml", "names: [red, dlo\nnc: 3\n", r"names: expected .*, got '\[red, dlo'"),
            ("data.yaml", "names: red\n", "names: expected .*, got 'red'"),
            ("data.yaml", "names: *classes\n", r"names: expected .*, got '\*classes'"),
            ("data.yaml", 'names: ["r\\u0065d"]\n', "names: expected .*, got"),
            ("data.yaml", "names: [[red]]\n", "names: expected .*, got"),
            ("data.yaml", "names:\n  - red\n  1: dlo\n", "names: expected .*, got '  1: dlo'"),
            ("data.yaml", "names:\n  - name: red\n", "names: expected .*, got"),
            ("data.yaml", "names:\n  0: red\n  2: dlo\n", "names: expected the numbers 0 to 1, got others"),
            ("data.yaml", "names:\n  0:\n    name: red\n", "names: expected .*, got '0:'"),
            ("data.yaml", None, "expected a file of names of classes, got a file that is missing or no text"),
        ],
    )
    def test_other_files_are_refused(self, tmp_path, name, text, match):
        if text is not None:
            (tmp_path / name).write_text(text)
        refused(tmp_path, rf"{name}: {match}", lambda folder, _: labelled.read_classes(folder / name))
