"""Command lines that are printed can be pasted into a shell."""

import subprocess
from pathlib import Path

import pytest

from jaxlfi.cli.exit_status import one_line, resuming
from jaxlfi.io.shell import quoted
from jaxlfi.io.workfolder import StoreError, refuse_occupied

NAMES = ["plain", "my rope", "a,b;c=d", "größe", "don't", "$(touch x)", "two  spaces", "-n", "a*", "new\nline"]


@pytest.mark.parametrize("name", NAMES)
def test_a_shell_reads_the_words_as_they_are(name):
    shown = quoted("printf", "%s", Path(name))
    done = subprocess.run(["sh", "-c", shown], capture_output=True, text=True, check=True)
    assert done.stdout in (name, f"./{name}")


@pytest.mark.parametrize("name", [name for name in NAMES if "\n" not in name])
def test_hints_to_resume_are_quoted(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = Path(name)
    folder.mkdir()
    (folder / "something").touch()
    with pytest.raises(StoreError) as error:
        refuse_occupied(folder)
    assert one_line(error.value).endswith(quoted("jaxlfi", "resume", folder))
    assert resuming(folder) == f"; continue with: {quoted('jaxlfi', 'resume', folder)}"
