"""Observation files and what is made of them; observations checked against the simulator, or simulated at the truth."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxlfi.distributions.support import Support
from jaxlfi.tasks.host import HostSimulator, SimulatorError
from jaxlfi.tasks.observation import (
    Columns,
    as_given,
    checked,
    observe,
    read,
    read_for,
    simulate_observation,
    simulator_shapes,
)
from jaxlfi.tasks.record_times import missing_records
from jaxlfi.tasks.task import Task
from jaxlfi.tasks.trials import repeated

VALUES = np.float32([8.0, 5.3626, 3.5946, -2.4096])
COLUMN = VALUES[:, None]
BOX = Support([0.5, 1.0], [3.0, 8.0])


def decay(key, theta):
    """A trajectory [4]."""
    return theta[1] * jnp.exp(-theta[0] * jnp.arange(4.0)) + 0.1 * jax.random.normal(key, (4,))


def task(simulate=decay, **changes) -> Task:
    """Two parameters, the first in logarithms."""
    return Task(simulate, ("rate", "start"), {"box": BOX}, BOX, log=("rate",), **changes)


def lines(cells=VALUES, heading: str | None = None, row="{value}", end="\n") -> str:
    """Rows of a file."""
    rows = [row.format(index=i, value=f"{value:.4f}") for i, value in enumerate(cells)]
    return end.join([heading, *rows] if heading is not None else rows) + end


@pytest.mark.parametrize(
    "text",
    [
        lines(),
        lines(heading="signal"),
        lines(heading='"a signal, in mV"'),
        lines(end="\r\n"),
        lines(heading="signal", end="\r\n"),
        lines(end="\n\n"),
        "# a comment\n" + lines(),
        lines(row=" {value} "),
        lines(heading="time,signal", row="{index},{value}"),
        lines(heading="Time (s),signal", row="{index},{value}"),
        lines(heading="t [ms],signal", row="{index},{value}"),
        lines(heading="seconds,signal", row="{index},{value}"),
        lines(heading=",signal", row="{index},{value}"),  # the index that pandas writes
        lines(heading="Year , signal", row="{index},{value}"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
@pytest.mark.parametrize("suffix", [".csv", ".CSV"])
def test_one_channel_is_read_with_every_record(tmp_path, text, encoding, suffix):
    """A byte-order mark takes no record away, and a column of times or indices is no channel."""
    path = tmp_path / f"x{suffix}"
    path.write_text(text, encoding=encoding)
    np.testing.assert_allclose(read(path), COLUMN, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0,8\n1,5\n", [[0, 8], [1, 5]]),  # without headings nothing says that the first column is a time
        ("a,b\n0,8\n1,5\n", [[0, 8], [1, 5]]),
        ("time\n0\n1\n", [[0], [1]]),  # the only column is the channel, whatever it is called
        ("time,a,b\n0,8,-1\n1,5,2e3\n", [[8, -1], [5, 2000]]),
        ("8,00000\n5,36256\n", [[8, 0], [5, 36256]]),  # decimal commas are two columns, refused by their shape
    ],
)
def test_columns_are_channels(tmp_path, text, expected):
    (tmp_path / "x.csv").write_text(text)
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), np.float32(expected))


RISING = "{}\n0,8,-1\n1,5,2\n2,4,7\n"
FLAT = "{}\n1,8,-1\n1,5,2\n2,4,7\n"


@pytest.mark.parametrize(
    ("heading", "time"),
    [
        ("t,a,b", True),
        ("t [ms],a,b", True),
        ("Time (s),a,b", True),
        ("TIMESTAMP,a,b", True),
        (",a,b", True),
        ("Year,hare,lynx", True),
        ("day,ill,well", True),
        ("Minutes (min),a,b", True),
        ("S,I,R", False),
        ("T,p,v", False),
        ("s,a,b", False),
        ("temperature,a,b", False),
        ("a,t,b", False),  # only a first column can be one
        ("times seen,a,b", False),
        ("timer,a,b", False),
    ],
)
def test_a_column_is_time_where_its_heading_says_so_and_it_increases(tmp_path, heading, time):
    (tmp_path / "rising.csv").write_text(RISING.format(heading))
    (tmp_path / "flat.csv").write_text(FLAT.format(heading))
    said = []
    assert read(tmp_path / "rising.csv", say=said.append).shape == (3, 3 - time)
    assert len(said) == time and all("skipped" in line and repr(heading.split(",")[0]) in line for line in said)
    assert read(tmp_path / "flat.csv", say=said.append).shape == (3, 3) and len(said) == time


def test_dates_are_times(tmp_path):
    """Their order decides; a date in another column, or an invalid one, is refused."""
    rows = [("1978-01-22", 3), ("1978-01-23", 8), ("1978-02-01", 26)]
    write = lambda text: (tmp_path / "x.csv").write_text(text)
    write("date,in bed\n" + "".join(f"{day},{count}\n" for day, count in rows))
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), [[3], [8], [26]])
    write("time,in bed\n" + "".join(f"{day}T08:00:00Z,{count}\n" for day, count in rows))
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), [[3], [8], [26]])
    write("week,in bed\n2020-W52,3\n2020-W53,8\n2021-W01,26\n2021-W03,5\n")
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), [[3], [8], [26], [5]])
    five = Columns(records=lambda: 5)  # the second week of 2021 is missing
    np.testing.assert_array_equal(read(tmp_path / "x.csv", five), [[3], [8], [26], [np.nan], [5]])
    for text in ("week,in bed\n2021-W53,3\n", "date,in bed\n22.1.1978,3\n"):
        write(text)
        with pytest.raises(ValueError, match="in row 2, where a date is written as 2024-03-31 or 2024-W13, got"):
            read(tmp_path / "x.csv")
    for text in ("date,in bed\n1978-13-45,3\n", "bed,date\n3,1978-01-22\n", "date,in bed\nMonday,3\n"):
        write(text)
        with pytest.raises(ValueError, match="expected 2 numbers in row 2"):
            read(tmp_path / "x.csv")


def test_times_that_single_precision_cannot_tell_apart_increase(tmp_path):
    (tmp_path / "x.csv").write_text("timestamp,a\n1700000000.0,1\n1700000000.1,2\n1700000000.2,3\n")
    np.testing.assert_array_equal(read(tmp_path / "x.csv"), [[1], [2], [3]])


@pytest.mark.parametrize(("count", "shape"), [(3, (3, 3)), (2, (3, 2)), (4, (3, 2)), (None, (3, 2))])
def test_nothing_is_left_out_of_as_many_columns_as_are_expected(tmp_path, count, shape):
    (tmp_path / "x.csv").write_text(RISING.format("t,a,b"))
    said = []
    assert read(tmp_path / "x.csv", Columns(count=count), said.append).shape == shape
    (line,) = said
    assert ("taken as a channel" in line) == (count == 3)


def test_headings_that_name_the_channels_say_which_column_is_which(tmp_path):
    (tmp_path / "x.csv").write_text("index,b,note,a\n0,1,9,2\n1,3,9,4\n")
    said = []
    np.testing.assert_array_equal(read(tmp_path / "x.csv", Columns(("a", "b"), 2), said.append), [[2, 1], [4, 3]])
    expected = ("'index', is taken as the time and skipped", "'note' left out", "in the order a, b")
    assert len(said) == 3 and all(part in line for part, line in zip(expected, said, strict=True))
    (tmp_path / "y.csv").write_text("t,b\n5,1\n6,3\n")  # a channel called t
    np.testing.assert_array_equal(read(tmp_path / "y.csv", Columns(("t", "b"), 2), said.append), [[5, 1], [6, 3]])
    assert len(said) == 3


def test_what_a_task_knows_of_its_channels(tmp_path):
    channels = task(lambda key, theta: jnp.zeros((3, 3)))
    assert Columns.of(channels) == Columns((), 3)
    assert Columns.of(dataclasses.replace(channels, channels=("S", "I", "R"))) == Columns(("S", "I", "R"), 3)
    assert Columns.of(dataclasses.replace(channels, channels=("S", "I"))) == Columns((), 3)
    assert Columns.of(task(lambda key, theta: jnp.zeros(3))) == Columns((), 1)
    host = dataclasses.replace(channels, simulate=HostSimulator(lambda rng, theta: np.zeros((len(theta), 3, 2))))
    assert Columns.of(host) == Columns() and Columns.of(dataclasses.replace(host, channels=("a", "b"))).count == 2
    (tmp_path / "x.csv").write_text(RISING.format("t,a,b"))
    assert read_for(channels, tmp_path / "x.csv").shape == (3, 3)
    assert read_for(dataclasses.replace(host, channels=("a", "b")), tmp_path / "x.csv").shape == (3, 2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected at least one row of numbers, got none"),
        ("\n\n", "expected at least one row of numbers, got none"),
        ("signal\n", "expected at least one row of numbers, got headings only"),
        (lines() + "1,2\n", "expected 1 numbers in row 5, got '1,2'"),
        (lines(row="{value},"), "expected a row of headings or a row of numbers first, got '8.0000,'"),
        ("a,b\n1,2\n3,?\n", "expected 2 numbers in row 3, got '3,?'"),
        ("signal\n1\nbroken\n2\n", "expected 1 numbers in row 3, got 'broken'"),
        ("hello\nworld\n", "expected 1 numbers in row 2, got 'world'"),
        ("8.0;1\n5.3;1\n", "expected 1 numbers in row 2, got '5.3;1'"),
        ("8.0  5.3  3.5\n", "got headings only"),
        ("1,a\n2,3\n", "expected a row of headings or a row of numbers first, got '1,a'"),
    ],
)
def test_broken_files_are_reported_in_one_line(tmp_path, text, message):
    path = tmp_path / "x.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"^observation: expected a readable file, got .*x.csv': ") as error:
        read(path)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "latin.csv").write_bytes("größe\n8.0\n".encode("latin-1"))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 not a zip")
    for name in ("latin.csv", "broken.npz", "missing.csv", "missing.npz"):
        with pytest.raises(ValueError, match=r"^observation: expected a readable file, got ") as error:
            read(tmp_path / name)
        assert "\n" not in str(error.value)
    for name in ("x.npy", "x.txt", "x"):
        with pytest.raises(ValueError, match=r"^observation: expected a .csv or .npz file, got"):
            read(tmp_path / name)


def test_arrays_are_read_as_they_are(tmp_path):
    for name, arrays in {
        "one": {"anything": np.arange(6).reshape(3, 2)},
        "named": {"trajectory": np.arange(6.0).reshape(3, 2), "times": np.arange(3)},
        "flags": {"trajectory": np.ones((3, 2), bool)},
    }.items():
        np.savez(tmp_path / f"{name}.npz", **arrays)
        got = read(tmp_path / f"{name}.npz")
        assert got.dtype == np.float64
        np.testing.assert_array_equal(got, next(iter(arrays.values())))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"a": np.ones(3), "b": np.ones(3)}, "expected an array called 'trajectory'"),
        ({"trajectory": np.ones(3) + 1j}, "expected numbers or texts, got complex128 as trajectory"),
        ({"trajectory": np.array(["8.0", "5.3"])}, "expected real numbers, got an array of type <U3"),
        ({"trajectory": np.array([[1.0], None], object)}, "expected a complete .npz file"),
    ],
)
def test_arrays_that_are_no_numbers_are_refused(tmp_path, arrays, message):
    """Object arrays are pickles, and never loaded."""
    np.savez(tmp_path / "x.npz", **arrays)
    with pytest.raises(ValueError, match=r"^observation: expected a readable file") as error:
        read(tmp_path / "x.npz")
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_file_takes_the_simulators_shape_where_only_axes_of_one_differ(tmp_path):
    (tmp_path / "x.csv").write_text(lines())
    assert read_for(task(), tmp_path / "x.csv").shape == (4,)
    assert read_for(task(lambda key, theta: jnp.zeros((4, 1, 1))), tmp_path / "x.csv").shape == (4, 1, 1)
    # Another shape stays as it is, and is refused in the simulator's terms.
    assert read_for(task(lambda key, theta: jnp.zeros(5)), tmp_path / "x.csv").shape == (4, 1)
    host = task(HostSimulator(lambda rng, theta: theta))
    assert read_for(host, tmp_path / "x.csv").shape == (4, 1)


# -------------------------------------------------------------------------------------------------- checking


def test_shapes_are_found_without_running_the_simulator():
    shapes = simulator_shapes(task(summary=lambda trajectory: trajectory[:3]))
    assert (shapes.trajectory, shapes.summary) == ((4,), 3)
    with_outcome = task(lambda key, theta: (decay(key, theta), theta[0] > 0))
    assert simulator_shapes(with_outcome).trajectory == (4,)


@pytest.mark.parametrize(
    ("simulate", "message"),
    [
        (lambda key, theta: np.asarray(theta), r"expected a function JAX can trace \(wrap .* jaxlfi.HostSimulator\)"),
        (lambda key, theta: 1 / 0, "got ZeroDivisionError: division by zero"),
        (lambda key, theta: theta["rate"], "expected a function JAX can trace"),
        (lambda key, theta: theta[0], "expected one array"),
        (lambda key, theta: {"x": theta}, "expected one array"),
        (lambda key, theta: None, "expected one array"),
        (lambda key, theta: (theta, theta), "expected a scalar outcome"),
        (lambda: None, "got TypeError"),
    ],
)
def test_simulators_that_break_their_contract_are_reported_in_one_line(simulate, message):
    with pytest.raises(SimulatorError, match=f"^simulate: .*{message}") as error:
        simulator_shapes(task(simulate))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "summary", [lambda trajectory: trajectory[0], lambda trajectory: trajectory["x"], lambda x: x.reshape(2, 2)]
)
def test_summaries_that_are_no_vectors_are_reported_in_one_line(summary):
    with pytest.raises(SimulatorError, match=r"^summary: expected a ") as error:
        simulator_shapes(task(summary=summary))
    assert "\n" not in str(error.value)


def test_observations_have_the_simulators_shape_and_are_finite():
    shapes = simulator_shapes(task())
    taken = checked(VALUES.astype(np.float64), shapes)
    np.testing.assert_array_equal(taken, VALUES)
    for wrong in (COLUMN, VALUES[:3], 1.0):
        with pytest.raises(ValueError, match=r"^observation: expected the shape the simulator produces, \[4\], got"):
            checked(wrong, shapes)
    for wrong in (np.nan, np.inf):
        with pytest.raises(ValueError, match=r"^observation: expected finite numbers"):
            checked([*VALUES[:3], wrong], shapes)


def test_an_observation_is_given_or_the_tasks_or_simulated_at_the_truth(key):
    given, own = jnp.ones(4), np.full(4, 2.0, np.float32)
    np.testing.assert_array_equal(observe(jax.random.clone(key), task(observation=own), given)[0], given)
    np.testing.assert_array_equal(observe(jax.random.clone(key), task(observation=own), None)[0], own)
    quiet = task(lambda key, theta: jnp.stack([theta[0], theta[1]]), truth=[2.0, 5.0])
    observed, x = observe(jax.random.clone(key), quiet, None)
    np.testing.assert_allclose(observed, [2.0, 5.0], rtol=1e-6)  # in natural units
    np.testing.assert_allclose(x, [2.0, 5.0], rtol=1e-6)
    with pytest.raises(ValueError, match=r"^observation: expected one, as the task has neither an observation nor"):
        observe(key, task(), None)


def test_a_summary_that_is_not_finite_is_refused(key):
    broken = task(summary=jnp.log)
    with pytest.raises(ValueError, match=r"^observation: expected a finite summary, got"):
        observe(key, broken, VALUES)


def test_the_truth_is_simulated_until_it_succeeds(key):
    """Half of the simulations fail; and one that always fails is reported."""
    half = task(lambda key, theta: (theta, jax.random.bernoulli(key)), truth=[2.0, 5.0])
    for k in jax.random.split(key, 8):
        np.testing.assert_allclose(simulate_observation(k, half), [2.0, 5.0], rtol=1e-6)
    never = task(lambda key, theta: (theta, False), truth=[2.0, 5.0])
    with pytest.raises(SimulatorError, match="got 16 failures in 16 tries"):
        simulate_observation(jax.random.key(0), never)
    host = dataclasses.replace(never, simulate=HostSimulator(lambda rng, theta: 1 / 0))
    with pytest.raises(SimulatorError, match=r"^simulate: ZeroDivisionError: division by zero$"):
        simulate_observation(jax.random.key(0), host)


# ------------------------------------------------------------------------------------------- other forms of the same


def two_channels(key, theta):
    """A trajectory [4, 2]."""
    return jnp.stack([decay(key, theta), theta[0] + jnp.arange(4.0)], axis=1)


@pytest.mark.parametrize("simulate", [decay, lambda key, theta: decay(key, theta)[:, None]])
@pytest.mark.parametrize("given", [VALUES, COLUMN, VALUES.tolist(), COLUMN.tolist()])
def test_the_axis_of_one_channel_is_the_simulators(simulate, given):
    own = task(simulate)
    found = as_given(own, given)
    shape = simulator_shapes(own).trajectory
    assert np.shape(found) == shape and np.ravel(found).tolist() == VALUES.tolist()
    assert jax.eval_shape(lambda one: as_given(own, one), np.asarray(given)).shape == shape


def test_frames_are_read_by_the_names_of_their_columns():
    pandas = pytest.importorskip("pandas")
    own = task(two_channels, channels=("height", "speed"))
    table = np.stack([VALUES, [1.0, 2.0, 3.0, 4.0]], axis=1)
    frame = pandas.DataFrame(table, columns=["height", "speed"])
    dates = pandas.date_range("2020-01-01", periods=4)
    for one in (frame, frame[["speed", "height"]], frame.assign(when=dates), pandas.DataFrame(table), table):
        np.testing.assert_array_equal(as_given(own, one), table)
    np.testing.assert_array_equal(as_given(own, [frame, frame[["speed", "height"]]]), [table, table])
    with pytest.raises(ValueError, match=r"^observation: expected columns height, speed, got none for speed$"):
        as_given(own, frame.rename(columns={"speed": "velocity"}))
    with pytest.raises(
        ValueError, match=r"^observation: expected columns height, speed, got a, b: rename them, or pass"
    ):
        as_given(own, frame.set_axis(["a", "b"], axis=1))
    column = frame[["height"]]
    for one in (column, column.rename(columns={"height": "signal"}), column["height"]):
        np.testing.assert_array_equal(as_given(task(), one), VALUES)


def test_a_file_that_names_some_of_the_channels_is_refused(tmp_path):
    (tmp_path / "x.csv").write_text("height,velocity\n1,2\n3,4\n")
    with pytest.raises(ValueError, match="expected columns height, speed, got none for speed"):
        read(tmp_path / "x.csv", Columns(("height", "speed"), 2))


# ------------------------------------------------------------------------------------------- missing records

SKIPPING = "time,height,speed\n0.0,1,2\n0.1,3,4\n0.21,5,6\n0.5,7,8\n"
"""Records at every tenth of a second, but for those at 0.3 and 0.4."""


@pytest.mark.parametrize("channels", [(), ("height", "speed"), ("speed", "height")])
@pytest.mark.parametrize("on_host", [False, True])
def test_records_that_the_times_show_to_be_missing_count_as_missing_values(tmp_path, channels, on_host):
    (tmp_path / "x.csv").write_text(SKIPPING)
    simulate = HostSimulator(lambda rng, theta: np.zeros((6, 2)), each=True) if on_host else None
    own = task(simulate or (lambda key, theta: jnp.zeros((6, 2))), channels=channels)
    said = []
    found = read_for(own, tmp_path / "x.csv", say=said.append)
    expected = np.full((6, 2), np.nan)
    expected[[0, 1, 2, 5]] = [[1, 2], [3, 4], [5, 6], [7, 8]]
    np.testing.assert_array_equal(found, expected[:, ::-1] if channels[:1] == ("speed",) else expected)
    assert said[-1].endswith(": 2 of 6 records are missing, as the times show; they count as missing values")
    trials = read_for(repeated(own, 2), tmp_path / "x.csv", tmp_path / "x.csv")
    np.testing.assert_array_equal(trials, np.concatenate([found, found]))


@pytest.mark.parametrize("length", [4, 5, 7])
@pytest.mark.parametrize("on_host", [False, True])
def test_no_record_is_missing_of_a_simulator_of_other_lengths(tmp_path, length, on_host):
    """One that simulates the uneven times themselves; and one that no gap explains, which is refused later."""
    (tmp_path / "x.csv").write_text(SKIPPING)
    simulate = HostSimulator(lambda rng, theta: np.zeros((length, 2)), each=True) if on_host else None
    own = task(simulate or (lambda key, theta: jnp.zeros((length, 2))))
    assert read_for(own, tmp_path / "x.csv").shape == (4, 2)


def test_only_regular_times_show_that_records_are_missing():
    regular = np.arange(8.0)[[0, 1, 2, 5, 7]]
    assert missing_records(regular, 8).nonzero()[0].tolist() == [3, 4, 6]
    shifted = np.add(regular, [0.0, 0.1, 0.0, -0.1, 0.1])
    assert missing_records(1e9 + 0.01 * shifted, 8).nonzero()[0].tolist() == [3, 4, 6]
    for irregular in (np.add(regular, [0, 0, 0.4, 0, 0]), np.cumsum(1.7 ** np.arange(5))):
        assert all(missing_records(irregular, length) is None for length in range(5, 30))


def test_a_host_simulator_is_run_for_the_length_of_a_recording_only_where_its_times_skip(tmp_path):
    calls = []

    def simulate(rng, theta):
        calls.append(theta)
        if theta[0] < 5:
            raise RuntimeError("no luck")
        return np.zeros((6, 2))

    for text, columns, expected in ((SKIPPING, 2, 1), ("time,a\n0,1\n1,2\n2,3\n", 1, 0)):
        (tmp_path / "x.csv").write_text(text)
        calls.clear()
        own = task(HostSimulator(simulate, each=True))
        assert read_for(own, tmp_path / "x.csv").shape[1] == columns and len(calls) == expected
        assert not calls or np.allclose(calls[0], [np.sqrt(1.5), 4.5])  # the middle, where the rate is a logarithm
    (tmp_path / "x.csv").write_text(SKIPPING)
    timed = task(HostSimulator(simulate, each=True), times=np.arange(6.0))
    calls.clear()
    assert read_for(timed, tmp_path / "x.csv").shape == (6, 2) and not calls


def test_frames_lack_records_as_files_do():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"time": [0.0, 0.1, 0.2, 0.5], "height": [1.0, 3.0, 5.0, 7.0]})
    for channels in ((), ("height",)):
        own = task(lambda key, theta: jnp.zeros(6), channels=channels)
        np.testing.assert_array_equal(as_given(own, frame), [1, 3, 5, np.nan, np.nan, 7])
