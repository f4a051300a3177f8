"""The chunk store: what is there is not computed again, and what is not its own is refused and left alone."""

from unittest import mock

import numpy as np
import pytest

from jaxlfi.io import files as atomic
from jaxlfi.io.workfolder import StoreError
from jaxlfi.studies.chunk_store import ChunkStore

NAMES = ("place", "square")


def store(folder, size: int = 10, length: int = 4, fingerprint: str = "this", names=NAMES) -> ChunkStore:
    return ChunkStore(folder / "chunks", size, length, fingerprint, names)


def squares(items: range, length: int = 4):
    """Results of a chunk, filled up to its length as a compiled program's are, and its seconds."""
    places = np.minimum(np.arange(items.start, items.start + length), items.stop - 1)
    return {"place": places, "square": np.stack([places**2, -places], axis=1), "ignored": places}, 0.5


@pytest.fixture
def complete(tmp_path):
    one = store(tmp_path)
    one.compute(squares)
    return one


def contents(one: ChunkStore) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in one.folder.iterdir()}


@pytest.mark.parametrize(("size", "length"), [(1, 1), (1, 5), (10, 4), (12, 4), (7, 1)])
def test_chunks_hold_every_item_once_and_are_joined_in_order(size, length, tmp_path):
    one = store(tmp_path, size, length)
    assert [place for chunk in one.chunks for place in chunk] == list(range(size))
    assert all(len(chunk) <= length for chunk in one.chunks)
    assert one.done() == []
    one.compute(lambda items: squares(items, length))
    results, seconds = one.results()
    np.testing.assert_array_equal(results["place"], np.arange(size))
    np.testing.assert_array_equal(results["square"][:, 0], np.arange(size) ** 2)
    assert set(results) == set(NAMES) and seconds == 0.5 * len(one.chunks)
    assert sorted(contents(one)) == [f"{index:03d}.npz" for index in range(len(one.chunks))]


def test_only_what_is_missing_is_computed_and_to_the_same_bytes(complete):
    before = contents(complete)
    complete.path(1).unlink()
    assert complete.done() == [0, 2]
    asked = []
    complete.compute(lambda items: asked.append(items) or squares(items))
    assert asked == [range(4, 8)] and contents(complete) == before


def test_a_computation_that_stops_leaves_what_it_had_done(tmp_path):
    def stopped(items):
        if items.start == 4:
            raise KeyboardInterrupt
        return squares(items)

    one = store(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        one.compute(stopped)
    assert one.done() == [0] and sorted(contents(one)) == ["000.npz"]


def test_where_another_process_writes_the_same_chunks_are_computed(tmp_path):
    """The one that writes says which are there."""
    other = mock.Mock(writes=False, broadcast=lambda done: np.array([1]))
    one, asked = store(tmp_path), []
    one.compute(lambda items: asked.append(items.start) or squares(items), other)
    assert asked == [0, 8] and one.done() == []


def cut(one):
    one.path(1).write_bytes(one.path(1).read_bytes()[:-30])


def flipped(one):
    """One bit of an array's data is another."""
    content = bytearray(one.path(1).read_bytes())
    content[60] ^= 1
    one.path(1).write_bytes(content)


def changed(**arrays):
    def change(one):
        atomic.write_arrays(one.path(1), atomic.read_arrays(one.path(1)) | arrays)

    return change


def without(name):
    def change(one):
        arrays = atomic.read_arrays(one.path(1))
        atomic.write_arrays(one.path(1), {other: value for other, value in arrays.items() if other != name})

    return change


SPOILED = {
    "cut off": (cut, "001.npz: expected a complete .npz file.*: delete it, and resuming computes it again"),
    "damaged": (flipped, "001.npz: "),
    "empty": (lambda one: one.path(1).write_bytes(b""), "001.npz: expected a complete .npz file"),
    "no archive": (lambda one: one.path(1).write_text("text"), "001.npz: expected a complete .npz file"),
    "of another study": (changed(fingerprint=np.asarray("that")), "001.npz: expected a chunk of this study"),
    "of none": (without("fingerprint"), "001.npz: expected a chunk of this study"),
    "without an array": (without("square"), "001.npz: expected place, square of 4 runs"),
    "of fewer items": (changed(place=np.arange(3)), "001.npz: expected place, square of 4 runs"),
    "of more items": (changed(place=np.arange(5)), "001.npz: expected place, square of 4 runs"),
    "the last one's": (lambda one: one.path(1).write_bytes(one.path(2).read_bytes()), "of 4 runs"),
}


@pytest.mark.parametrize("case", SPOILED)
def test_a_spoiled_chunk_is_refused_before_anything_is_computed(case, complete):
    spoil, message = SPOILED[case]
    complete.path(0).unlink()
    spoil(complete)
    before, asked = contents(complete), []
    for attempt in (complete.done, lambda: complete.compute(asked.append), lambda: complete.read(1)):
        with pytest.raises(StoreError, match=message) as caught:
            attempt()
        assert "\n" not in str(caught.value)
    assert asked == [] and contents(complete) == before


def test_a_spoiled_chunk_that_is_deleted_is_computed_again(complete):
    before = contents(complete)
    cut(complete)
    complete.path(1).unlink()
    complete.compute(squares)
    assert contents(complete) == before


def test_results_of_an_incomplete_study_are_refused(complete):
    complete.path(2).unlink()
    with pytest.raises(StoreError, match=r"002\.npz: expected a complete"):
        complete.results()


def test_other_files_of_the_folder_are_left_alone(complete):
    (complete.folder / "001.npz.part").write_bytes(b"killed while writing")
    (complete.folder / "notes.txt").write_text("mine")
    complete.path(1).unlink()
    complete.compute(squares)
    assert (complete.folder / "notes.txt").read_text() == "mine"
    np.testing.assert_array_equal(complete.results()[0]["place"], np.arange(10))


def test_a_study_whose_folder_was_moved_away_is_not_begun_anew(tmp_path):
    (tmp_path / "here").mkdir()
    one = store(tmp_path / "here")
    one.write(0, *squares(one.chunks[0]))
    (tmp_path / "here").rename(tmp_path / "there")
    with pytest.raises(FileNotFoundError):
        one.write(1, *squares(one.chunks[1]))
    assert not (tmp_path / "here").exists() and store(tmp_path / "there").done() == [0]
