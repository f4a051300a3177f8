"""The loop from an object to a policy: its stages, that they are gone on with, replaced, and refused.

The stages are commands with tests of their own; here they leave what they would leave.
"""

import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_whip import Rig, a_policy, found

import jaxlfi
from jaxlfi.design import played
from jaxlfi.distributions.space import Space
from jaxlfi.envs.whip import r2s2r, r2s2r_page, recording
from jaxlfi.io import files


@pytest.fixture
def stages(monkeypatch):
    """All commands that were run, in place of running them; and who is interrupted."""
    ran, stopped = [], []

    def out_of(words):
        return Path(words[words.index("--out") + 1] if "--out" in words else words[1])

    def command(kind):
        def run(words):
            ran.append([kind, *words])
            out = out_of(words)
            out.mkdir(parents=True, exist_ok=True)
            (out / "config.json").write_text("{}")
            if kind in stopped:
                stopped.clear()
                return 130
            if words[0] == "report":
                (out / "report.html").write_text("")
            elif "posterior" in out.name:
                files.write_arrays(out / "posterior.npz", {})
                if "undrawn" in stopped:
                    return 0
                (out / "report.html").write_text("")
            elif kind == "deploy":
                (out / "table.csv").write_text("policy,return\n")
            elif kind == "design":
                (out / "experiment_1.csv").write_text("time [s],dx [m],dz [m]\n")
                (out / "design.png").write_text("")
            else:
                (out / "domain/seed_000").mkdir(parents=True, exist_ok=True)
                a_policy(out / "domain/seed_000/policy.npz")
                for name in ("table.csv", "curves.png"):
                    (out / name).write_text("")
            return 0

        return run

    def rollout(arguments, policy, path, iteration):
        if not path.exists():
            ran.append(["rollout", str(policy), str(path)])
            path.write_text("")
        return path

    monkeypatch.setattr(r2s2r.train, "main", command("train"))
    monkeypatch.setattr(r2s2r.command_line, "main", command("infer or resume"))
    monkeypatch.setattr(r2s2r.whip, "main", command("deploy"))
    monkeypatch.setattr(r2s2r.loops.design, "main", command("design"))
    monkeypatch.setattr(r2s2r, "_rollout", rollout)
    monkeypatch.setattr(r2s2r_page, "write", lambda arguments, policies: ran.append(["page", *map(str, policies)]))
    return ran, stopped


def test_the_stages_follow_each_other(stages, tmp_path):
    ran, _ = stages
    out = tmp_path / "loop"
    words = ["--object", "dlo-0", "--out", str(out), "--seed", "3", "--iterations", "2", "--total-steps", "960"]
    assert r2s2r.main(words) == 0
    assert [words[0] for words in ran] == [
        "train", "rollout", "infer or resume", "train", "rollout", "infer or resume", "train", "deploy", "page",
    ]  # fmt: skip
    first, second = out / "policy_0/domain/seed_000/policy.npz", out / "iteration_1/policy/domain/seed_000/policy.npz"
    assert ran[0][1:4] == ["whip", "--domain", "uniform"] and "960" in ran[0] and "3" in ran[0]
    assert ran[1][1:] == [str(first), str(out / "iteration_1/rollout.npz")]
    assert ran[2][1:6] == ["infer", "whip", "--object", str(out / "iteration_1/rollout.npz"), "--heuristic"]
    assert ran[3][3] == str(out / "iteration_1/posterior")
    assert ran[4][1] == str(second)  # the second time round by the policy on the first posterior
    rollouts = [str(out / f"iteration_{i}/rollout.npz") for i in (1, 2)]
    assert ran[5][4:6] == rollouts  # all rollouts so far together
    assert len(ran[-1]) == 4 and ran[-2][2:4] == ran[-1][1:3]
    ran.clear()
    assert r2s2r.main(words) == 0
    assert [words[0] for words in ran] == ["page"]  # all else is there


def test_all_policies_have_the_reward_that_is_asked_for(stages, tmp_path, capsys):
    ran, _ = stages
    words = ["--object", "dlo-0", "--out", str(tmp_path / "loop"), "--reward"]
    assert r2s2r.main([*words, "kind"]) and not ran
    assert "reward: expected one of paper, ordered, settled, got 'kind'" in capsys.readouterr().err
    assert r2s2r.main([*words, "settled"]) == 0
    trainings = [words for words in ran if words[0] == "train"]
    assert len(trainings) == 2 and all(words[-2:] == ["--reward", "settled"] for words in trainings)


EXPLORING = ["--object", "dlo-0", "--iterations", "3", "--explore", "design", "--design", "--rated 16", "--seed", "3"]


def test_the_next_rollout_can_be_of_the_whip_that_tells_most(stages, tmp_path):
    """The first is the policy's, and each of the others is designed by the posterior before it."""
    ran, _ = stages
    out = tmp_path / "loop"
    assert r2s2r.main([*EXPLORING, "--out", str(out)]) == 0
    first = str(out / "policy_0/domain/seed_000/policy.npz")
    designs = [str(out / f"iteration_{i}/design") for i in (2, 3)]
    assert [words[1] for words in ran if words[0] == "rollout"] == [first, *(f"{d}/experiment_1.csv" for d in designs)]
    designed = [words[1:] for words in ran if words[0] == "design"]
    assert [one[0] for one in designed] == [str(out / f"iteration_{i}/posterior") for i in (1, 2)]
    arguments = r2s2r.loops.design.parser().parse_args(designed[1])
    assert (arguments.rated, arguments.seed, str(arguments.out)) == (16, 3, designs[1])
    inferred = [words for words in ran if words[1] == "infer"]
    assert inferred[-1][4:7] == [str(out / f"iteration_{i}/rollout.npz") for i in (1, 2, 3)]
    ran.clear()
    assert r2s2r.main([*EXPLORING, "--out", str(out)]) == 0 and [words[0] for words in ran] == ["page"]


def test_a_design_that_was_cut_short_is_made_anew(stages, tmp_path):
    """What a kill left of it goes; recordings that are there stay."""
    ran, stopped = stages
    out = tmp_path / "loop"
    stopped.append("design")
    assert r2s2r.main([*EXPLORING, "--out", str(out)]) == 130
    (out / "iteration_2/design/designs.csv").write_text("part")
    before = len(ran)
    assert ran[-1][0] == "design"
    assert r2s2r.main([*EXPLORING, "--out", str(out)]) == 0
    assert ran[before] == ran[before - 1]  # the same words give the same design
    assert not (out / "iteration_2/design/designs.csv").exists()
    assert [words[0] for words in ran].count("rollout") == 3


def test_a_folder_that_was_begun_before_there_was_an_option_is_gone_on_with(stages, tmp_path):
    ran, _ = stages
    out = tmp_path / "loop"
    words = ["--object", "dlo-0", "--out", str(out)]
    assert r2s2r.main(words) == 0
    config = files.read_json(out / "config.json")
    del config["asked"]["explore"], config["asked"]["design"]
    files.write_json(out / "config.json", config)
    ran.clear()
    assert r2s2r.main(words) == 0 and [one[0] for one in ran] == ["page"]


def test_the_commands_understand_the_words_of_their_stages(stages, tmp_path):
    ran, _ = stages
    words = ["--object", "dlo-0", "--out", str(tmp_path / "loop"), "--seed", "3", "--total-steps", "960"]
    assert r2s2r.main(words) == 0
    of = {kind: [one[1:] for one in ran if one[0] == kind] for kind in ("train", "infer or resume", "deploy")}
    for one in of["train"]:
        arguments = r2s2r.train.parser().parse_args(one)
        assert (arguments.first_seed, arguments.settings) == (3, {"total_steps": 960})
    (one,) = of["infer or resume"]
    arguments = r2s2r.command_line.parse(one)
    assert (arguments.heuristic, arguments.first_seed, arguments.preset) == ("edge", 3, "quick")
    (one,) = of["deploy"]
    arguments = r2s2r.whip.parser().parse_args(one)
    assert (arguments.repetitions, arguments.seed, arguments.object) == (16, 3, ["dlo-0"])


def test_what_sees_the_object_is_what_simulations_have_the_errors_of(stages, tmp_path):
    ran, _ = stages
    learnt = ["--detector", "learnt", "--renderer", "raycast"]
    assert r2s2r.main(["--object", "dlo-0", "--out", str(tmp_path / "loop"), *learnt]) == 0
    of = {kind: [one[1:] for one in ran if one[0] == kind] for kind in ("train", "infer or resume", "deploy")}
    assert [one[0] for one in of["train"]] == ["whip,detector=learnt"] * 2
    assert of["infer or resume"][0][:2] == ["infer", "whip,detector=learnt"]
    arguments = r2s2r.whip.parser().parse_args(of["deploy"][0])
    assert (arguments.detector, arguments.renderer, arguments.weights) == ("learnt", "raycast", None)


@pytest.mark.parametrize(("kind", "again"), [("train", "resume"), ("infer or resume", "resume"), ("deploy", "deploy")])
def test_it_goes_on_where_it_was_stopped(stages, tmp_path, kind, again, capsys):
    ran, stopped = stages
    words = ["--object", "dlo-1", "--out", str(tmp_path / "loop")]
    stopped.append(kind)
    assert r2s2r.main(words) == 130
    assert "the same command goes on from here" in capsys.readouterr().err
    before = len(ran)
    assert r2s2r.main(words) == 0
    assert ran[before][1] == again and ran[before - 1][0] == kind
    assert [words[0] for words in ran][-2:] == ["deploy", "page"]


def test_a_stage_is_complete_with_its_last_file(stages, tmp_path):
    """A kill between the results of a stage and its pictures leaves the rest of it to be done."""
    ran, stopped = stages
    out, words = tmp_path / "loop", ["--object", "dlo-1", "--out", str(tmp_path / "loop")]
    assert r2s2r.main(words) == 0
    (out / "policy_0" / "curves.png").unlink()
    (out / "iteration_1/posterior" / "report.html").unlink()
    ran.clear()
    stopped.append("undrawn")  # a run that is complete is not drawn by resuming it
    assert r2s2r.main(words) == 0
    assert [words[1] for words in ran[:3]] == ["resume", "resume", "report"] and len(ran) == 4


def test_stages_are_replaced_by_files(stages, tmp_path, monkeypatch):
    ran, _ = stages
    policy = a_policy(tmp_path / "policy.npz")
    monkeypatch.setattr("jaxlfi.envs.whip.real2sim.recorded", lambda name: None)
    monkeypatch.setattr("jaxlfi.cli.domains.domain", lambda environment, word: None)
    words = ["--object", "dlo-2", "--policy", str(policy), "--recording", "rollout.npz", "--posterior", "runs/found"]
    assert r2s2r.main([*words, "--out", str(tmp_path / "loop")]) == 0
    assert [words[0] for words in ran] == ["train", "deploy", "page"]
    assert ran[0][3] == "runs/found" and ran[1][2] == str(policy)


class OfOthers:
    """The run of another task."""

    space = Space(("prey", "predators"), (True, True))
    feasible = jaxlfi.Support([0.0, 0.0], [1.0, 1.0])
    units = ("", "")


def test_bad_input_is_one_line_and_leaves_nothing(stages, tmp_path, capsys, monkeypatch):
    other, of_others = a_policy(tmp_path / "other.npz", "line"), tmp_path / "others"
    of_others.mkdir()
    monkeypatch.setattr("jaxlfi.runs.load.load", lambda folder: OfOthers())
    for words, expected in (
        (["--object", "dlo-9"], "expected one of dlo-0"),
        (["--object", "dlo-0", "--iterations", "0"], "iterations: expected at least 1"),
        (["--object", "dlo-0", "--explore", "design"], "iterations: expected at least 2 with --explore design"),
        ([*EXPLORING[:-3], "--rated 8"], "rated: expected at least 16, got 8"),
        (["--object", "dlo-0", "--policy", str(other)], "policy: expected environment 'whip', got one of 'line'"),
        (["--object", "dlo-0", "--recording", "none.npz"], "none.npz"),
        (["--object", "dlo-0", "--posterior", "none"], "none"),
        (["--object", "dlo-0", "--posterior", str(of_others)], "domain: expected a posterior of "),
        (["--object", "dlo-0", "--heuristic", "egde"], "heuristic: expected "),
        (["--object", "dlo-0", "--detector", "learnt", "--renderer", "raycast", "--weights", "none"], "segmenter.npz"),
        (["--object", "dlo-0", "--seed", "-3"], "seed: expected seeds from 0 to 4294967295, got -3"),
        (["--object", "dlo-0", "--total-steps", "0"], "total_steps: expected "),
    ):
        assert r2s2r.main([*words, "--out", str(tmp_path / "loop")]) == 2
        error = capsys.readouterr().err
        assert error.startswith("jaxlfi r2s2r: error: ") and expected in error and error.count("\n") == 1
        assert not (tmp_path / "loop").exists()
    assert r2s2r.main(["--object", "dlo-0", "--out", str(tmp_path / "loop")]) == 0
    assert r2s2r.main(["--object", "dlo-1", "--out", str(tmp_path / "loop")]) == 2
    assert "out: expected a new folder, or one of the same command" in capsys.readouterr().err


def test_it_goes_on_where_its_own_description_was_not_written_to_the_end(stages, tmp_path):
    ran, _ = stages
    out = tmp_path / "loop"
    out.mkdir()
    (out / "config.json.part").write_text("{")
    assert r2s2r.main(["--object", "dlo-0", "--out", str(out)]) == 0
    assert ran[-1][0] == "page" and not (out / "config.json.part").exists()


def test_a_rollout_is_recorded_once_and_what_a_kill_left_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxlfi.envs.whip.reference_objects.robot.ReferenceRig", Rig)
    monkeypatch.setattr("jaxlfi.envs.whip.reference_objects.robot._found", found)
    policy, path = a_policy(tmp_path / "policy.npz"), tmp_path / "rollout.npz"
    path.write_text("part of one")
    arguments = r2s2r.parser().parse_args(["--object", "dlo-0", "--out", str(tmp_path), "--seed", "3"])
    assert r2s2r._rollout(arguments, policy, path, 1) == path
    made = recording.read(path)
    # Below its workspace after seven steps, the gripper is held still.
    np.testing.assert_allclose(made.actions, np.repeat([[0.03, -0.03], [0, 0]], [7, 9], axis=0), atol=1e-6)
    planned = np.column_stack([0.16 * np.arange(16), np.tile([[0.02, 0.01], [-0.02, -0.01]], (8, 1))])
    played.write(tmp_path / "experiment_1", ["time [s]", "dx [m]", "dz [m]"], planned)
    designed = r2s2r._rollout(arguments, tmp_path / "experiment_1.csv", tmp_path / "designed.npz", 1)
    np.testing.assert_allclose(recording.read(designed).actions, planned[:, 1:], atol=1e-6)
    before = path.stat().st_mtime_ns
    assert r2s2r._rollout(arguments, policy, path, 1) == path and path.stat().st_mtime_ns == before


def test_what_was_believed(tmp_path):
    """Quantiles of a run's draws in natural units, beside its last support."""

    class Run:
        space = Space(("length", "young"), (False, True))

        def final_support(self):
            return jaxlfi.Support([100.0, 1e3], [300.0, 1e5])

        def draws(self):
            return np.stack([np.linspace(150, 250, 101), np.full(101, 2e4)], axis=1)

    rows = r2s2r_page.believed(tmp_path, Run())
    assert [row["parameter"] for row in rows] == ["length", "young"]
    assert rows[0]["median"] == "200" and rows[0]["90 % interval"] == "155 to 245"
    assert rows[0]["last support"] == "100 to 300" and rows[1]["last support"] == "1000 to 1e+05"


def test_the_page_says_all_of_it(tmp_path, monkeypatch):
    out = tmp_path / "loop"
    (out / "deployed").mkdir(parents=True)
    (out / "deployed/table.csv").write_text("policy,object,return\nfirst<b>,dlo-0,1.2345\n")
    (out / "policy_0").mkdir()
    for name in ("film.gif", "policy_0/curves.png"):
        (out / name).write_bytes(b"")
    monkeypatch.setattr(r2s2r_page, "load", lambda folder: None)
    monkeypatch.setattr(r2s2r_page, "predicted", lambda out, runs: [out / "predictive_1.png"])
    monkeypatch.setattr(r2s2r_page, "believed", lambda folder, run: [{"run": folder.name, "median": "200"}])
    policy = a_policy(tmp_path / "policy.npz")
    arguments = r2s2r.parser().parse_args(["--object", "dlo-0", "--out", str(out)])
    text = r2s2r_page.write(arguments, [policy]).read_text()
    for part in (
        "<td>posterior</td><td>200</td>",
        "first&lt;b&gt;",
        "<td>1.23</td>",
        "policy_0/curves.png",
        str(policy),
    ):
        assert part in text
    alternatives = re.findall(r'<img[^>]* alt="([^"]*)"', text)
    assert len(alternatives) == 3 and all(len(words.split()) > 5 for words in alternatives)
    assert "sheet.png" not in text


def test_what_a_kill_left_of_the_making_of_a_stage_goes(stages, tmp_path):
    for name in (".policy-x1", ".policy_0-x2", "policy"):
        (tmp_path / name).mkdir()
    out = tmp_path / "policy"
    for _ in range(2):
        r2s2r._begin_or_resume(r2s2r.train.main, ["whip", "--out", str(out)], out, "a policy")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".policy_0-x2", "policy"]
    assert stages[0] == [["train", "whip", "--out", str(out)], ["infer or resume", "resume", str(out)]]
