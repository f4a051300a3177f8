"""Files are whole or as they were, and nothing is left of one that could not be written."""

import errno
import os
import resource

import pytest

from jaxlfi.io import files


def test_a_file_that_cannot_be_written_leaves_the_earlier_one_and_nothing_else(tmp_path):
    path = tmp_path / "state.npz"
    files.write_bytes(path, b"before", durable=True)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, hard))  # as of a disk that is full
    try:
        with pytest.raises(OSError, match="File too large") as error:
            files.write_bytes(path, bytes(5000), durable=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert error.value.errno == errno.EFBIG
    assert path.read_bytes() == b"before" and os.listdir(tmp_path) == ["state.npz"]


def test_a_durable_file_and_its_name_are_on_the_disk_before_it_is_told_so(tmp_path, monkeypatch):
    flushed = []
    monkeypatch.setattr(os, "fsync", lambda descriptor: flushed.append(os.readlink(f"/proc/self/fd/{descriptor}")))
    files.write_bytes(tmp_path / "a", b"1", durable=True)
    assert flushed == [str(tmp_path / "a.part"), str(tmp_path)]
    files.flush(tmp_path / "none")  # where it cannot be done, it is not
