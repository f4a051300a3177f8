"""Files that are damaged, or made to do harm: each is refused in one line, and nothing that is pickled is loaded."""

import numpy as np
import pytest

from jaxlfi.io import files
from tests.fuzzing.damage import DEEP, Pickled, bomb

ARRAYS = {"a": np.arange(6.0).reshape(2, 3), "b": np.array([True, False]), "c": np.asarray("text")}


def refused(read, path) -> str:
    with pytest.raises(ValueError, match=r"expected ") as error:
        read(path)
    assert "\n" not in str(error.value) and str(path) in str(error.value)
    return str(error.value)


def test_a_few_bytes_that_unpack_to_gigabytes_are_refused_before_they_are_read(tmp_path):
    bomb(tmp_path / "bomb.npz", "a")
    assert (tmp_path / "bomb.npz").stat().st_size < 2**23
    assert "unpack to 6 GiB" in refused(files.read_arrays, tmp_path / "bomb.npz")


def test_a_small_file_of_zeros_is_no_bomb(tmp_path):
    np.savez_compressed(tmp_path / "zeros.npz", zeros=np.zeros(2**20))
    assert files.read_arrays(tmp_path / "zeros.npz")["zeros"].size == 2**20


@pytest.mark.parametrize("array", [np.ones(2) + 1j, np.zeros(2, "M8[s]"), np.zeros(2, "i4,f4")], ids=str)
def test_only_numbers_and_texts_are_read(tmp_path, array):
    np.savez(tmp_path / "x.npz", odd=array)
    assert "expected numbers or texts" in refused(files.read_arrays, tmp_path / "x.npz")


def test_nothing_is_unpickled(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "good").mkdir()
    np.savez(tmp_path / "x.npz", odd=np.array([Pickled()], object))
    refused(files.read_arrays, tmp_path / "x.npz")
    assert not list((tmp_path / "good").iterdir())


def test_sealed_arrays_come_back_as_they_are(tmp_path):
    files.write_sealed(tmp_path / "x.npz", ARRAYS)
    got = files.read_sealed(tmp_path / "x.npz")
    assert list(got) == list(ARRAYS) and all(np.array_equal(got[name], ARRAYS[name]) for name in ARRAYS)


@pytest.mark.parametrize(
    "change",
    [
        {"a": ARRAYS["a"].T}, {"a": ARRAYS["a"].astype(np.float32)}, {"a": ARRAYS["a"] + 1e-9}, {"d": np.zeros(1)},
        {"seal": np.zeros(())}, {"seal": np.asarray("x")},
    ],
    ids=lambda change: str(change).replace("\n", ""),
)  # fmt: skip
def test_sealed_arrays_that_were_changed_are_refused(tmp_path, change):
    files.write_sealed(tmp_path / "x.npz", ARRAYS)
    arrays = files.read_arrays(tmp_path / "x.npz")
    files.write_arrays(tmp_path / "x.npz", arrays | change)
    assert "expected the arrays as they were written" in refused(files.read_sealed, tmp_path / "x.npz")


@pytest.mark.parametrize("text", ["", "{", DEEP, '{"a": ' + DEEP, "9" * 10_000, "\ufeff{}"], ids=range(6))
def test_what_is_no_json_is_refused(tmp_path, text):
    (tmp_path / "x.json").write_text(text, encoding="utf-8")
    refused(files.read_json, tmp_path / "x.json")
    with pytest.raises(ValueError, match="expected JSON"):
        files.read_json(tmp_path / "missing.json")
