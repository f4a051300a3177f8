"""`jaxlfi mujoco inspect`: signals, what is odd about them, and a file that is a task, of recordings as made."""

import csv
import dataclasses
import json
import re
import tomllib
import warnings
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")

from envs_mujoco import ARM, recorded

from jaxlfi.cli import parser as cli
from jaxlfi.envs.mujoco import config, inspection, log_files
from jaxlfi.envs.mujoco.model_task import compile_spec, specification
from jaxlfi.envs.mujoco.renaming import Called
from jaxlfi.envs.mujoco.simulator import simulator_of
from jaxlfi.io import lerobot, mcap
from jaxlfi.io.rollout import Rollout, Signal

EXAMPLES = Path(__file__).parents[3] / "examples/mujoco"
NOISE = 0.003


@pytest.fixture(scope="module")
def swing():
    """Noisy measurements of the arm's sensors: 101 rows at 50 Hz."""
    log, random = recorded(), np.random.default_rng(1)
    noisy = {name: values + NOISE * random.standard_normal(101) for name, values in log.signals.items()}
    return {"motor": log.signals["motor"], "angle": noisy["angle"], "velocity[0]": noisy["velocity[0]"]}


@pytest.fixture(scope="module")
def arm():
    spec = specification(ARM.replace('name="motor" joint', 'name="motor" ctrlrange="-1 1" joint'))
    return inspection.sensing(spec), compile_spec(spec)


def looked(arm, signals, times=None, units=None, faults=()):
    """What is found in a recording that is made of arrays."""
    times = 0.02 * np.arange(len(next(iter(signals.values())))) if times is None else times
    known = dict.fromkeys([*signals, "time"], "") | (units or {})
    return inspection.inspect(*arm, log_files.Recorded(np.asarray(times), signals, "day1.csv", known, tuple(faults)))


def test_what_is_in_a_recording(arm, swing):
    found = looked(arm, swing, units={"motor": "mN m", "angle": "deg"})
    assert (found.name, found.rows, found.odd, found.usable, found.time) == ("day1.csv", 101, (), True, None)
    assert found.duration == pytest.approx(2.0) and found.measured == ("angle", "velocity[0]")
    motor, angle, velocity = found.signals.values()
    assert (motor.unit, angle.unit, velocity.unit) == ("N m", "rad", "m/s")
    assert (motor.low, motor.high) == pytest.approx((1e-3 * swing["motor"].min(), 1e-3 * swing["motor"].max()))
    assert angle.high == pytest.approx(np.deg2rad(swing["angle"].max()))
    assert (angle.rate, angle.gaps, angle.samples) == (pytest.approx(50), 0, 101)
    assert motor.place.what == "control of actuator motor" and angle.place.name == "angle"
    assert velocity.noise == pytest.approx(NOISE, rel=0.4) and angle.called is None


def odd(found, name):
    return " | ".join(found.signals[name].odd)


def test_what_is_odd_about_values(arm, swing):
    values = swing["angle"].copy()
    values[30:42] = np.nan
    assert "has no sample in 12 of 101 rows, the first in row 31" in odd(looked(arm, {"angle": values}), "angle")
    gap = looked(arm, {"angle": values}).signals["angle"]
    assert (gap.gaps, gap.samples) == (1, 89) and gap.longest == pytest.approx(0.26)
    assert odd(looked(arm, {"angle": np.full(101, 0.5)}), "angle").startswith("is constant, 0.5")
    assert looked(arm, {"angle": np.full(101, 0.5)}).signals["angle"].noise is None
    clipped = np.minimum(swing["angle"], 0.6 * swing["angle"].max())
    assert re.search(
        r"is at its largest value, .*, in \d+ of 101 samples: saturated", odd(looked(arm, {"angle": clipped}), "angle")
    )
    assert "largest" not in odd(looked(arm, swing), "angle")
    held = np.repeat(swing["angle"][::4], 4)[:101]
    assert "75 of 101 samples repeat the one before, a new one comes about every 4" in odd(
        looked(arm, {"angle": held}), "angle"
    )
    slow = looked(arm, {"angle": held}).signals["angle"]
    assert slow.rate == pytest.approx(12.5) and slow.samples == 26
    clamped = looked(arm, swing | {"motor": 2 * swing["motor"]})
    share = 100 * np.mean(np.abs(2 * swing["motor"]) > 1)
    assert f"{share:.3g} % of its samples are beyond the actuator's ctrlrange, -1 to 1" in odd(clamped, "motor")
    infinite = looked(arm, swing | {"velocity[0]": np.where(np.arange(101) == 6, np.inf, 0.0)})
    assert odd(infinite, "velocity[0]") == "is infinite in row 7" and infinite.usable
    assert "velocity[0]" not in infinite.log.signals and infinite.signals["angle"].samples == 101
    unknown = looked(arm, swing, units={"angle": "furlong"})
    assert "is in 'furlong', which is not a known unit" in odd(unknown, "angle")
    assert unknown.signals["angle"].called == Called(read=False)


def test_angles_that_wrap_and_angles_in_degrees(arm):
    times = 0.02 * np.arange(300)
    turning = 2.5 * times + 0.4 * np.sin(2 * times)
    wrapped = (turning + np.pi) % (2 * np.pi) - np.pi
    found = looked(arm, {"motor": np.zeros(300), "angle": wrapped}, times)
    assert "wraps after 6.283 rad, twice: made continuous" in odd(found, "angle")
    assert found.signals["angle"].high == pytest.approx(turning.max())
    in_degrees = looked(arm, {"motor": np.zeros(300), "angle": np.rad2deg(turning)}, times)
    assert "looks like degrees, from 0 to" in odd(in_degrees, "angle")
    assert in_degrees.signals["angle"].called == Called(None, "deg")
    assert in_degrees.signals["angle"].high == pytest.approx(turning.max())
    with_unit = looked(arm, {"motor": np.zeros(300), "angle": np.rad2deg(turning)}, times, {"angle": "rad"})
    assert with_unit.signals["angle"].called is None and "degrees" not in odd(with_unit, "angle")


def test_a_joints_limits_tell_degrees_from_radians():
    spec = specification(ARM.replace('<joint name="shoulder"', '<joint name="shoulder" range="-60 60" limited="true"'))
    limited = inspection.sensing(spec), compile_spec(spec)
    swung = 40 * np.sin(0.1 * np.arange(80))
    assert looked(limited, {"angle": swung}).signals["angle"].called == Called(None, "deg")
    assert looked(limited, {"angle": np.deg2rad(swung)}).signals["angle"].called is None


def test_what_is_odd_about_times(arm, swing):
    milliseconds = looked(arm, swing, 20.0 * np.arange(101))
    assert milliseconds.time == Called(None, "ms") and milliseconds.duration == pytest.approx(2.0)
    assert milliseconds.odd == ("times have no unit and look like ms: read so, unless [signals] says another",)
    assert looked(arm, swing, 20.0 * np.arange(101), {"time": "ms"}).time is None
    nanoseconds = looked(arm, swing, 20_000_000 * np.arange(101))
    assert "read as ns" in nanoseconds.odd[0] and nanoseconds.time is None
    times = 0.02 * np.arange(101)
    times[[7, 50]] = times[[6, 49]]
    times[[80, 81]] = times[[81, 80]]
    disorder = looked(arm, swing, times, faults=["topic: samples 2 and 3"])
    assert disorder.odd[0] == "topic: samples 2 and 3" and not disorder.usable
    assert "rows 8 and 51 repeat a time and row 82 goes back" in disorder.odd[1]
    assert disorder.rows == 101 and disorder.signals["angle"].samples == 99
    assert np.all(np.diff(disorder.log.times) > 0)


def test_what_a_signal_cannot_be_and_what_is_missing(arm, swing):
    found = looked(arm, {"angle": swing["angle"], "velocity[0]": swing["velocity[0]"]}, units={"angle": "mm"})
    assert "is in mm, and sensor angle in rad: not taken for it" in odd(found, "angle")
    assert found.signals["angle"].place is None and found.measured == ("velocity[0]",)
    assert found.odd == ("has no control of motor",)
    found = looked(arm, {"angel": swing["angle"], "q_elbow": swing["angle"], "spare": swing["angle"]})
    assert found.signals["angel"].nearest[0] == "angle" and not found.signals["spare"].nearest
    assert found.signals["q_elbow"].called == Called("joint/elbow/qpos", None)
    with pytest.raises(ValueError, match=r"day1.csv: expected signals with finite samples, got none"):
        looked(arm, {"angle": np.full(101, np.nan)})


def test_a_recording_that_begins_elsewhere(arm, swing):
    found = looked(arm, swing | {"angle": swing["angle"] + 0.5})
    assert re.search(r"the recording begins at 0\.\d+ rad, the model at 0 rad", odd(found, "angle"))


def test_a_unit_that_one_recording_gives_away_is_that_of_all():
    small, large = (size * np.sin(0.1 * np.arange(100)) + 0.01 * np.cos(np.arange(100) ** 2) for size in (3.0, 2000.0))
    raws = [
        log_files.Recorded(0.02 * np.arange(100), {"angle": values}, name, {"angle": "", "time": ""})
        for name, values in (("a.csv", small), ("b.csv", large))
    ]
    spec = specification(ARM)
    first, second = inspection.inspect_all(spec, compile_spec(spec), raws)
    assert first.signals["angle"].called == second.signals["angle"].called == Called(None, "deg")
    joined = inspection.together([first, second])["angle"]
    assert (joined.samples, joined.high) == (200, pytest.approx(np.deg2rad(large.max())))


# --------------------------------------------------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def folder(tmp_path_factory, swing):
    """The same recording in every format, with a laboratory's own names."""
    folder, times = tmp_path_factory.mktemp("formats"), 0.02 * np.arange(101)
    (folder / "arm.xml").write_text(ARM)
    names = {"motor": "tau_motor", "angle": "q_shoulder", "velocity[0]": "velocity[0]"}
    columns = {names[name]: values for name, values in swing.items()}
    with (folder / "swing.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["time", "tau_motor [N m]", "q_shoulder", "velocity[0]", "battery"])
        writer.writerows([f"{cell:.9g}" for cell in (*row, 24.0)] for row in zip(times, *columns.values(), strict=True))
    np.savez(folder / "swing.npz", times=times, battery=np.full(101, 24.0), **columns)
    state = np.stack([columns["q_shoulder"], columns["velocity[0]"], 24 + 0 * times], axis=1)
    signals = {
        "state": Signal(times, state, ("q_shoulder", "velocity[0]", "battery")),
        "command": Signal(times, columns["tau_motor"][:, None], ("tau_motor",), "N m"),
    }
    rollout = Rollout(signals)
    mcap.write(folder / "swing.mcap", rollout)
    lerobot.write(folder / "set", [rollout, rollout], "state", 50)
    return folder


def command(capsys, *words):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        status = cli.main(["mujoco", "inspect", *map(str, words)])
    return status, capsys.readouterr()


@pytest.mark.parametrize("log", ["swing.csv", "swing.npz", "swing.mcap", "set#episode=1", "set#episodes=0-1"])
def test_every_format_makes_a_task(folder, tmp_path, capsys, swing, log):
    out = tmp_path / "new/arm.toml"
    status, said = command(capsys, folder / log, "--model", folder / "arm.xml", "--out", out)
    assert status == 0 and "control of actuator motor" in " ".join(said.out.split()) and "battery" in said.out
    assert "written, a task with the parameters joint/shoulder/damping" in said.out
    task = config.read(out)
    episodes = 2 if "episodes" in log else 1
    assert task.observation.shape == (101 * episodes, 2)
    np.testing.assert_allclose(task.observation[:101, 0], swing["angle"], atol=1e-6)
    simulator = task.simulate.function
    np.testing.assert_allclose(simulator.logs[0].signals["motor"], swing["motor"], atol=1e-6)
    said = tomllib.loads(out.read_text())
    assert said["signals"] == {"q_shoulder": "joint/shoulder/qpos", "tau_motor": "motor"}
    assert said["noise"]["joint/shoulder/qpos"] == pytest.approx(NOISE, rel=0.4)


PENDULUM = """<mujoco><worldbody><body><joint name="hip" axis="0 1 0" damping="0.01"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/><body pos="0 0 -0.4">
<joint name="knee" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="0.3"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize(("joints", "expected"), [
    (("hip", "knee"), {"from": "log"}),
    (("hip",), {"hip/qpos": pytest.approx(0.8, abs=0.01)}),  # where the knee begins, nobody says
])  # fmt: skip
def test_a_task_begins_where_its_recording_does(tmp_path, capsys, joints, expected):
    (tmp_path / "pendulum.xml").write_text(PENDULUM)
    times, random = 0.01 * np.arange(200), np.random.default_rng(3)
    angles = {"hip": 0.8 * np.cos(5 * times), "knee": -0.5 * np.cos(7 * times)}
    signals = {f"joint/{name}/qpos": angles[name] + 1e-3 * random.standard_normal(200) for name in joints}
    np.savez(tmp_path / "swing.npz", times=times, **{f"{name} [rad]": values for name, values in signals.items()})
    out = tmp_path / "pendulum.toml"
    arguments = ["mujoco", "inspect", tmp_path / "swing.npz", "--model", tmp_path / "pendulum.xml", "--out", out]
    assert cli.main([str(word) for word in arguments]) == 0, capsys.readouterr().err
    said = tomllib.loads(out.read_text())["initial"]
    assert said == expected
    begun = simulator_of(config.read(out)).starts[0].state
    np.testing.assert_allclose(begun[1], 0.8, atol=0.01)  # the time comes first


def test_json_has_the_same(folder, capsys):
    status, said = command(capsys, folder / "swing.csv", "--model", folder / "arm.xml", "--json")
    found = json.loads(said.out)
    (one,) = found["recordings"]
    assert status == 0 and one["rows"] == 101 and one["usable"] is True
    angle, battery = one["signals"]["q_shoulder"], one["signals"]["battery"]
    own = {"name": "joint/shoulder/qpos", "what": "position of joint shoulder"}
    assert angle["place"] == {**own, "sure": False, "unit": ""}
    assert angle["rate"] == pytest.approx(50) and battery["noise"] is None and battery["odd"] == ["is constant, 24"]


def uncommented(text):
    """The file with all parameters switched on."""
    return re.sub(r"^#(?=\[parameters|support|feasible|unit|log)", "", text, flags=re.MULTILINE)


@pytest.mark.parametrize("example", ["furuta", "arm", "puck", "finger", "shuffle", "servo"])
def test_all_that_a_file_offers_can_be_inferred(tmp_path, capsys, example):
    """Checked for the library's models with their own recordings."""
    out = tmp_path / f"{example}.toml"
    assert command(capsys, EXAMPLES / f"{example}.csv", "--model", EXAMPLES / f"{example}.xml", "--out", out)[0] == 0
    few = config.read(out)
    assert 1 <= len(few.names) <= 3
    own = tomllib.loads((EXAMPLES / f"{example}.toml").read_text())["parameters"]
    out.write_text(uncommented(out.read_text()))
    task = config.read(out)
    assert len(task.names) > len(few.names) + 2 and set(few.names) < set(task.names)
    of_the_model = {
        name
        for name in own
        if name.startswith(("joint/", "body/", "control/"))
        and name.endswith(("damping", "frictionloss", "mass", "delay"))
    }
    assert of_the_model <= set(task.names)
    offered = tomllib.loads(out.read_text())["parameters"]
    now = dict(re.findall(r'^\[parameters\."(.*?)"\]\s+# (\S+) in the model$', out.read_text(), re.MULTILINE))
    for name, bounds in offered.items():
        assert (
            bounds["feasible"][0]
            <= bounds["support"][0]
            <= float(now[name])
            <= bounds["support"][1]
            <= bounds["feasible"][1]
        )


def test_what_cannot_be_read_is_one_line(folder, tmp_path, capsys):
    (tmp_path / "empty.csv").write_text("time [s],angle\n0,nan\n1,nan\n")
    (tmp_path / "there.toml").write_text("precious")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((folder / "swing.mcap").read_bytes()[:500])
    for words, expected in (
        ([folder / "none.csv"], "none.csv: expected a CSV file"),
        ([tmp_path / "empty.csv"], "empty.csv: expected signals with finite samples, got none"),
        ([cut], "cut.mcap: expected a complete MCAP file, got a truncated or damaged one"),
        ([f"{folder}/set"], "one of its 2 episodes, got none: name it as set#episode=0"),
        ([f"{folder}/set#episodes=0-7"], "expected an episode from 0 to 1, got 2"),
        ([folder / "swing.csv", "--out", tmp_path / "there.toml"], "--out: expected a new file, got"),
        ([folder / "swing.csv", "--model", folder / "none.xml"], "model: expected an MJCF file, got none called"),
    ):
        model = [] if "--model" in words else ["--model", folder / "arm.xml"]
        status, said = command(capsys, *words, *model)
        assert status == 2 and expected in said.err and said.err.count("\n") == 1, said.err
    assert (tmp_path / "there.toml").read_text() == "precious"


def test_a_recording_in_disorder_is_looked_at_and_left_out_of_the_file(folder, tmp_path, capsys):
    lines = (folder / "swing.csv").read_text().splitlines()
    (tmp_path / "bad.csv").write_text("\n".join([*lines[:60], lines[59], *lines[60:]]))
    out = tmp_path / "arm.toml"
    words = [folder / "swing.csv", tmp_path / "bad.csv", "--model", folder / "arm.xml", "--out", out]
    status, said = command(capsys, *words)
    assert status == 0 and "got 1.16 in row 60 after 1.16 (bad.csv)" in said.out
    assert [Path(one).name for one in tomllib.loads(out.read_text())["log"]] == ["swing.csv"]
    assert len(config.read(out).observation) == 101


def test_together_has_each_signal_once(arm, swing):
    one, other = looked(arm, swing), looked(arm, {"motor": swing["motor"]})
    several = inspection.together([one, dataclasses.replace(other, name="day2.csv")])
    assert list(several) == ["motor", "angle", "velocity[0]"]
    assert (several["motor"].samples, several["angle"].samples) == (202, 101)


@pytest.mark.parametrize("name", ["motor", "angle", "velocity[0]"])
def test_an_axis_that_is_counted_the_other_way_round_is_named_and_read_as_the_model_counts_it(name, arm, swing):
    """A sensor without an axis has no sign to be wrong: a velocity in space has the sign of its frame."""
    right = looked(arm, swing)
    assert "opposite sign" not in repr(right)
    found = looked(arm, swing | {name: -swing[name]})
    says = "seems to have the opposite sign: over the first 2 s the model moves against the recording, and with it"
    has_axis = name != "velocity[0]"
    assert (says in odd(found, name)) == has_axis
    assert not any(
        "opposite sign" in text for other in found.signals.values() if other.name != name for text in other.odd
    )
    assert found.signals[name].called == (Called(scale=-1.0) if has_axis else None)
    sign = 1 if has_axis else -1
    np.testing.assert_array_equal(found.log.signals[name], sign * right.log.signals[name])


def test_a_sign_that_one_recording_gives_away_is_that_of_all_but_those_that_jaxlfi_made(arm, swing):
    turned = swing | {"angle": -swing["angle"]}
    still = {name: np.zeros(101) + 1e-4 * (np.arange(101) % 2) for name in swing}
    units = dict.fromkeys([*swing, "time"], "")
    several = [
        log_files.Recorded(0.02 * np.arange(101), signals, f"day{number}.csv", units, by_us=by_us)
        for number, (signals, by_us) in enumerate([(turned, False), (still, False), (still, True)])
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = inspection.inspect_all(specification(ARM), arm[1], several)
    assert [one.signals["angle"].called for one in found] == [Called(scale=-1.0), Called(scale=-1.0), None]
    np.testing.assert_allclose(found[1].log.signals["angle"], -still["angle"])
    np.testing.assert_allclose(found[2].log.signals["angle"], still["angle"])


def test_the_sign_of_what_jaxlfi_recorded_is_the_drivers(arm, swing):
    signals = swing | {"angle": -swing["angle"]}
    units = dict.fromkeys([*swing, "time"], "")
    ours = log_files.Recorded(0.02 * np.arange(101), signals, "rollout.csv", units, by_us=True)
    found = inspection.inspect(*arm, ours)
    assert odd(found, "angle").endswith("as jaxlfi recorded it, change it in [robot.names]")
    np.testing.assert_array_equal(found.log.signals["angle"], signals["angle"])


def test_where_a_motor_or_its_only_sensor_may_be_counted_the_other_way_round_both_are_named(arm, swing):
    found = looked(arm, {"motor": -swing["motor"], "angle": swing["angle"]})
    assert "one of motor, angle seems to have the opposite sign" in " | ".join(found.odd)
    assert found.opposite == ("motor", "angle") and not any(one.called for one in found.signals.values())
    assert "opposite sign" not in repr(looked(arm, {"angle": -swing["angle"]}))  # without controls nothing moves it


@pytest.mark.parametrize("sensors", [("angle", "velocity[0]"), ("angle",)])
def test_the_file_counts_as_the_model_does_or_has_both_ways_to_do_so(sensors, tmp_path, swing):
    """A motor that is counted the other way round, which one sensor alone cannot tell from itself."""
    path, model = tmp_path / "day1.csv", tmp_path / "arm.xml"
    model.write_text(ARM)
    columns = {"time [s]": 0.02 * np.arange(101), "motor [N m]": -swing["motor"]}
    columns |= {name: swing[name] for name in sensors}
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([columns, *zip(*columns.values(), strict=True)])
    cli.main(["mujoco", "inspect", str(path), "--model", str(model), "--out", str(tmp_path / "arm.toml")])
    text = (tmp_path / "arm.toml").read_text()
    if len(sensors) == 1:
        both = "#motor = { scale = -1.0 }\n#angle = { scale = -1.0 }\n"
        assert "# One of these seems to count the other way round than in the model:\n" + both in text
        (tmp_path / "arm.toml").write_text(text.replace("#motor = {", "motor = {"))
    controls = config.read(tmp_path / "arm.toml").simulate.function.logs[0].signals["motor"]
    np.testing.assert_array_equal(controls, swing["motor"])
