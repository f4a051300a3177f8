"""Resuming: a folder is whole at any moment, and goes on to the same bits."""

import json
import shutil

import numpy as np
import pytest

import jaxlfi
from jaxlfi.io import files as atomic
from jaxlfi.runs import execute as executing
from jaxlfi.runs import folder as folders
from jaxlfi.runs.checkpoint import Checkpoint, CheckpointError
from jaxlfi.runs.execute import changed_machine
from tests.killed import Killed, kill_at
from tests.small import FLAGS, SETTINGS, TASK, command, gaussian, read_ledger, whole_runs  # noqa: F401 - a fixture

ONE = ("infer", TASK, "--support", "misspecified", *FLAGS, "--out")
"""By the program that most tests share."""
ARGUMENTS = (*ONE[:-1], "--seeds", "2", "--out")
"""Two runs, and so two of some files."""
MORE = SETTINGS.rounds + 2
"""Rounds that finished runs are given: for all of them, as each number is a program."""


@pytest.mark.slow
def test_a_run_killed_at_any_write_resumes_to_the_same_bits(tmp_path, monkeypatch):
    assert command(*ARGUMENTS, tmp_path / "whole") == 0
    created, killed = 0, 0
    for nth in range(1, 100):
        out = tmp_path / f"killed_{nth}"
        with monkeypatch.context() as patch:
            kill_at(patch, nth, midway=nth % 3 == 0)
            try:
                assert command(*ARGUMENTS, out) == 0
                break
            except Killed:
                killed += 1
        if not out.exists():  # not yet created: nothing was begun, and nothing is in the way
            continue
        created += 1
        assert command("resume", out, "--no-figures") == 0
        for seed in ("seed_000", "seed_001"):
            for name in ("posterior.npz", "dataset.npz"):
                assert_same_arrays(tmp_path / "whole" / seed / name, out / seed / name)
            assert [line["round"] for line in read_ledger(out / seed)] == [0, 1]  # each once, and in order
            assert not list((out / seed).glob("*.part"))
        assert not (out / "checkpoint").exists()
    assert killed >= 20 and created >= 15


def assert_same_arrays(a, b):
    """Equal to the last bit."""
    first, second = atomic.read_arrays(a), atomic.read_arrays(b)
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), (a, name)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A run that was killed after its first round."""
    out = tmp_path_factory.mktemp("stopped") / "run"
    with pytest.MonkeyPatch.context() as patch:
        kill_at(patch, 6, midway=False)
        with pytest.raises(Killed):
            command(*ONE, out)
    assert Checkpoint(out).rounds_done() == 1
    return out


@pytest.mark.parametrize(
    ("damage", "file"),
    [
        (damage, file)
        for damage in ("truncated", "flipped", "missing", "foreign")
        for file in ("state.npz", "round_000.npz", "start.npz")
        if (damage, file) != ("missing", "state.npz")  # without a state a run begins with its first round
    ],
)
def test_a_damaged_checkpoint_is_refused_and_left_alone(stopped, tmp_path, capsys, file, damage):
    out = tmp_path / "run"
    shutil.copytree(stopped, out)
    path = out / "checkpoint" / file
    content = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        middle = len(content) // 2
        path.write_bytes(content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :])
    elif damage == "missing":
        path.unlink()
    else:
        np.savez(path, something=np.zeros(3))
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    capsys.readouterr()
    assert command("resume", out, "--no-figures") == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and file in message and "expected" in message
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before


def test_a_state_of_another_shape_is_refused(tmp_path):
    checkpoint = Checkpoint(tmp_path)
    checkpoint.write_start(np.zeros((1, 2)), np.zeros((1, 2)))
    checkpoint.write_round(0, {"a": np.zeros(3)}, {"b": np.ones(2), "final_x": np.zeros((1, 20, 2))}, 0.1)
    rows, seconds, final = checkpoint.read_rounds(1)
    assert [list(row) for row in rows] == [["b"]] and seconds == [0.1] and list(final) == ["final_x"]
    assert checkpoint.read_state({"a": np.ones(3)})["a"].tolist() == [0, 0, 0]
    with pytest.raises(CheckpointError, match=r"expected .* of shape"):
        checkpoint.read_state({"a": np.zeros(4)})


@pytest.mark.parametrize("estimator", [10**30, None, "mdn"])
def test_an_estimator_that_is_none_is_refused(stopped, tmp_path, capsys, estimator):
    shutil.copytree(stopped, tmp_path / "out")
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    config["settings"]["estimator"] = estimator
    (tmp_path / "out" / "config.json").write_text(json.dumps(config))
    assert command("resume", tmp_path / "out") == 2
    assert "estimator: expected one such as" in capsys.readouterr().err


@pytest.mark.parametrize(("package", "warned"), [("jax", True), ("jaxlfi", True), ("numpy", False), (None, False)])
def test_resuming_by_other_versions_warns(stopped, tmp_path, capsys, package, warned):
    out = tmp_path / "run"
    shutil.copytree(stopped, out)
    config = json.loads((out / "config.json").read_text())
    if package is not None:
        config["versions"][package] = "0.0.1"
        (out / "config.json").write_text(json.dumps(config))
    assert command("resume", out, "--no-figures") == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert (f"warning: begun with {package} 0.0.1, now" in printed) == warned
    assert ("warning: begun with" in printed) == warned


def test_resuming_on_another_number_of_devices_is_told_apart(stopped):
    """As many as runs are used at most."""
    config = json.loads((stopped / "config.json").read_text())
    assert config["devices"] == 1 and changed_machine(config) == []
    assert changed_machine(config | {"devices": 7}) == ["7 devices, now 1"]
    assert changed_machine({"runs": 12, "devices": None}) == []  # not recorded


def test_a_finished_run_goes_on_for_more_rounds_on_the_command_line(tmp_path, capsys):
    """Those it has made stay as they are."""
    out, made = tmp_path / "run", SETTINGS.rounds
    assert command(*ONE, out) == 0
    before, lines = atomic.read_arrays(out / "history.npz"), (out / "ledger.jsonl").read_text()
    assert command("resume", out, "--rounds", MORE, "--no-figures") == 0
    after = atomic.read_arrays(out / "history.npz")
    assert len(after["theta"]) == MORE and (after["attempted"] > 0).all()
    for name in before.keys() - {"names", "reasons"}:
        if not name.startswith("final_"):
            assert after[name][:made].tobytes() == before[name].tobytes(), name
    assert (out / "ledger.jsonl").read_text().startswith(lines)
    config = json.loads((out / "config.json").read_text())
    assert config["status"] == "finished" and config["settings"]["rounds"] == MORE
    assert config["extended"] == [{"rounds": made, "min_rounds": 0, "made": made}]
    for rounds in (MORE, 0):
        assert command("resume", out, "--rounds", rounds) == 2
        assert f"error: rounds: expected more than the {MORE} of" in capsys.readouterr().err
    shutil.rmtree(out / "checkpoint")  # as earlier versions and run.save leave it
    assert command("resume", out, "--rounds", MORE + 1) == 2
    assert "error: rounds: expected a run with" in capsys.readouterr().err


@pytest.mark.slow
def test_a_settled_run_goes_on_for_more_rounds(tmp_path, monkeypatch, capsys):
    """Those it has made stay as they are, whatever ended it, and a kill on the way changes nothing."""
    flags = (*FLAGS[: FLAGS.index("--rounds")], "--rounds", 9, "--min-rounds", 4, "--simulations-per-round", 20)
    flags = (*flags, "--simulation-budget", 25, "--learning-rate", 1e-9, "--no-figures")  # it settles at once
    out = tmp_path / "run"
    assert command("infer", TASK, *flags, "--out", out) == 0
    before, made = atomic.read_arrays(out / "history.npz"), atomic.read_arrays(out / "dataset.npz")
    assert len(before["theta"]) == 4 and before["settled"][-1]
    lines = (out / "ledger.jsonl").read_text()
    shutil.copytree(out, tmp_path / "killed")
    assert command("resume", out, "--rounds", 6, "--no-figures") == 0
    after = atomic.read_arrays(out / "history.npz")
    assert len(after["theta"]) == 6 and (after["attempted"] > 0).all() and not after["settled"].any()
    for name in before.keys() - {"settled", "names", "reasons"}:
        if not name.startswith("final_"):
            assert after[name][:4].tobytes() == before[name].tobytes(), name
    for name, rows in atomic.read_arrays(out / "dataset.npz").items():
        assert rows[: len(made[name])].tobytes() == made[name].tobytes(), name
    assert len(rows) > 0 and (out / "ledger.jsonl").read_text().startswith(lines)
    config = json.loads((out / "config.json").read_text())
    assert config["status"] == "finished" and config["settings"]["rounds"] == 6
    assert config["extended"] == [{"rounds": 9, "min_rounds": 4, "made": 4}]
    with monkeypatch.context() as patch:
        kill_at(patch, 4, midway=False)
        with pytest.raises(Killed):
            command("resume", tmp_path / "killed", "--rounds", 6, "--no-figures")
    assert command("resume", tmp_path / "killed", "--no-figures") == 0
    for name in ("posterior.npz", "dataset.npz"):
        assert_same_arrays(out / name, tmp_path / "killed" / name)
    capsys.readouterr()
    assert command("resume", out, "--simulations", 20 * 6) == 2
    assert "error: simulations: expected more than the 120 of" in capsys.readouterr().err
    for rounds in (6, 0):
        assert command("resume", out, "--rounds", rounds) == 2
        assert "error: rounds: expected more than the 6 of" in capsys.readouterr().err
    shutil.rmtree(out / "checkpoint")  # as earlier versions and run.save leave it
    assert command("resume", out, "--rounds", 8) == 2
    assert "error: rounds: expected a run with" in capsys.readouterr().err


@pytest.mark.slow
def test_a_total_of_simulations_becomes_the_rounds_it_takes(tmp_path, capsys):
    """After 2 rounds of 20, a total of 61 takes two more rounds, as four rounds do."""
    for name in ("rounds", "simulations", "python"):
        jaxlfi.infer(0, gaussian(), settings=SETTINGS, out=tmp_path / name)
    made = int(atomic.read_arrays(tmp_path / "rounds" / "history.npz")["succeeded"].sum())
    per_round = SETTINGS.simulations_per_round
    wanted = made + per_round + 1
    executing.extend(tmp_path / "rounds", rounds=MORE)
    executing.extend(tmp_path / "simulations", simulations=wanted)
    configs = [folders.read_config(tmp_path / name)["settings"] for name in ("rounds", "simulations")]
    assert configs[0] == configs[1]
    run = jaxlfi.resume(tmp_path / "python", gaussian(), simulations=wanted)
    assert int(run.dataset.size) >= wanted > made and run.settings.rounds == MORE
    np.testing.assert_array_equal(jaxlfi.resume(tmp_path / "rounds", gaussian()).draws(), run.draws())
    np.testing.assert_array_equal(jaxlfi.resume(tmp_path / "python", gaussian()).draws(), run.draws())  # it is complete
    size = int(run.dataset.size)
    for simulations in (size, 1):
        with pytest.raises(ValueError, match=f"simulations: expected more than the {size} of"):
            jaxlfi.resume(tmp_path / "python", gaussian(), simulations=simulations)
    with pytest.raises(ValueError, match="expected rounds or simulations, got both"):
        jaxlfi.resume(tmp_path / "python", gaussian(), simulations=10 * size, rounds=9)
    # Of one that was stopped, what it was begun with counts as there.
    with pytest.raises(ValueError, match=f"expected more than the {wanted - 1 + per_round} of"):
        executing.extend(tmp_path / "simulations", simulations=made + 1)
    assert command("resume", tmp_path / "python", "--rounds", 9, "--simulations", 1000) == 2
    assert "not allowed with argument --rounds" in capsys.readouterr().err


@pytest.mark.slow  # either way is compared with an uninterrupted run
def test_more_rounds_in_python_are_those_of_the_command_line(tmp_path):
    for name in ("python", "cli"):
        jaxlfi.infer(0, gaussian(), settings=SETTINGS, out=tmp_path / name)
    more = lambda: jaxlfi.infer(0, gaussian(), settings=SETTINGS.replace(rounds=MORE), out=tmp_path / "python")
    run = more()
    assert run.history["theta"].shape[0] == MORE == run.settings.rounds
    np.testing.assert_array_equal(more().draws(), run.draws())  # it is complete, and is read
    executing.extend(tmp_path / "cli", MORE)
    plan, observed = executing.reopen(tmp_path / "cli", gaussian())
    (same,) = executing.execute(plan, observed, tmp_path / "cli")
    np.testing.assert_array_equal(same.draws(), run.draws())
    with pytest.raises(ValueError, match="of a run with another settings"):
        jaxlfi.infer(0, gaussian(), settings=SETTINGS, out=tmp_path / "python")
