"""MCAP files: what is written is read, by the mcap package too, and other topics stand beside ours."""

import io
import json
import sys

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from same_rollouts import same

from jaxlfi.io import mcap
from jaxlfi.io.rollout import Rollout, Signal


def rollout(joints: int = 3, points: int = 5) -> Rollout:
    """Frames of a camera from before the first action on, actions at another rate, an event."""
    random = np.random.default_rng(joints)
    times = (np.arange(20) - 2 + 0.2 * np.sin(np.arange(20))) / 30
    keypoints = random.uniform(size=(20, 2 * points)).astype(np.float32)
    keypoints[3, 0] = np.nan
    made = {
        "observation.state": (times, random.normal(size=(20, joints)), "rad", None),
        "observation.keypoints": (times, keypoints, "normalised pixels", None),
        "observation.seen": (times, random.uniform(size=(20, points)) < 0.7, "boolean", None),
        "action": (0.1 * np.arange(6), random.normal(size=(6, joints)).astype(np.float32), "rad", 0.1),
        "touch.count": (np.array([0.3, 0.3, 0.5]), np.array([[1], [-2], [3]]), "", None),
    }
    signals = {
        name: Signal(times, values, tuple(f"{name} {i}" for i in range(values.shape[1])), unit, duration)
        for name, (times, values, unit, duration) in made.items()
    }
    return Rollout(signals, {"camera": {"position": [1.5, None]}, "by": "a «test»"}, "turn left")


@pytest.mark.parametrize(("joints", "points"), [(3, 5), (1, 1), (7, 12)])
def test_what_is_written_is_read(tmp_path, joints, points):
    mcap.write(tmp_path / "one.mcap", rollout(joints, points))
    same(mcap.read(tmp_path / "one.mcap"), rollout(joints, points))
    assert [path.name for path in tmp_path.iterdir()] == ["one.mcap"]


def test_the_file_is_what_the_documentation_says(tmp_path):
    mcap.write(tmp_path / "one.mcap", rollout())
    with (tmp_path / "one.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        found = [(schema, channel, message) for schema, channel, message in reader.iter_messages()]
        (record,) = reader.iter_metadata()
    topics = {channel.topic: (schema, channel) for schema, channel, _ in found}
    assert set(topics) == {
        *("/observation/state", "/observation/keypoints", "/observation/seen", "/action", "/touch/count")
    }
    assert (record.name, record.metadata["version"], record.metadata["task"]) == ("jaxlfi.rollout", "1", "turn left")
    stamps = [message.log_time for _, _, message in found]
    assert stamps == sorted(stamps) and stamps[0] == 0  # times before the first action are no negative stamps
    schema, channel = topics["/action"]
    assert (schema.name, schema.encoding, channel.message_encoding) == ("jaxlfi.Signal", "jsonschema", "json")
    assert channel.metadata["unit"] == "rad" and json.loads(channel.metadata["names"])[2] == "action 2"
    assert json.loads(schema.data)["properties"]["values"]["maxItems"] == 3
    bodies = [json.loads(message.data) for _, channel, message in found if channel.topic == "/action"]
    assert [body["time"] for body in bodies] == (0.1 * np.arange(6)).tolist()
    np.testing.assert_array_equal([body["values"] for body in bodies], rollout().signals["action"].values)
    first = rollout().signals["observation.state"].times[0]
    action = next(message for _, channel, message in found if channel.topic == "/action")
    assert action.log_time == pytest.approx(-first * 1e9, abs=1)


def by_hand(path, *topics, record=None, described=b"{}"):
    """A file of another program: (topic, schema, encoding, channel's metadata, bodies)."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    for topic, name, encoding, metadata, bodies in topics:
        schema = writer.register_schema(name, "jsonschema", described) if name else 0
        channel = writer.register_channel(topic, encoding, schema, metadata)
        for i, body in enumerate(bodies):
            writer.add_message(channel, 10**18 + i, body, 10**18 + i)
    if record:
        writer.add_metadata("jaxlfi.rollout", record)
    writer.finish()
    path.write_bytes(stream.getvalue())
    return path


BODY = b'{"time": 0.5, "values": [1.5, null]}'
STATE = ("/observation/state", "jaxlfi.Signal", "json", {}, [BODY, b'{"values": [2, 3], "time": 1, "by": "me"}'])
ROS = ("/joint_states", "sensor_msgs/msg/JointState", "cdr", {}, [b"\x00\x01\x00\x00"])


def test_what_others_wrote_is_read_beside_their_own_topics(tmp_path):
    path = by_hand(tmp_path / "one.mcap", ROS, STATE, ("/log", "", "json", {}, [b"{}"]))
    read = mcap.read(path)
    assert list(read.signals) == ["observation.state"] and read.metadata == {} and read.task == ""
    state = read.signals["observation.state"]
    assert state.times.tolist() == [0.5, 1.0] and state.names == ("0", "1") and state.unit == ""
    np.testing.assert_array_equal(state.values, [[1.5, np.nan], [2.0, 3.0]])


def test_units_stand_in_the_metadata_or_in_the_schema(tmp_path):
    said = {"properties": {"time": {"unit": "ms"}, "values": {"unit": "deg"}}}
    path = by_hand(tmp_path / "one.mcap", STATE, described=json.dumps(said).encode())
    state = mcap.read(path).signals["observation.state"]
    assert state.times.tolist() == [0.0005, 0.001] and state.units == ("deg", "deg")
    path = by_hand(tmp_path / "two.mcap", with_state({"unit": '["mm", "N"]'}), described=json.dumps(said).encode())
    assert mcap.read(path).signals["observation.state"].units == ("mm", "N")
    path = by_hand(tmp_path / "three.mcap", STATE, described=b'{"properties": {"time": {"unit": "mm"}}}')
    with pytest.raises(ValueError, match="/observation/state: expected times in a unit of time, got 'mm'"):
        mcap.read(path)
    with pytest.raises(ValueError, match="unit: expected one, or 2 for the numbers, got 1"):
        mcap.read(by_hand(tmp_path / "four.mcap", with_state({"unit": '["mm"]'})))


def with_state(metadata, *bodies):
    return ("/observation/state", "jaxlfi.Signal", "json", metadata, bodies or STATE[-1])


FOREIGN = {
    "other topics": (
        [("/log", "Log", "json", {}, [b"{}"])],
        {},
        r"expected topics of ROS 2 .*, or of JSON messages by the schema jaxlfi.Signal, got /log \(Log, json\)",
    ),
    "ROS's other topics": (
        [("/tf", "tf2_msgs/msg/TFMessage", "cdr", {}, [b""])],
        {},
        r"expected topics of ROS 2 of the types sensor_msgs/JointState, .*, got /tf \(tf2_msgs/msg/TFMessage, cdr\)",
    ),
    "no topics": ([], {}, "by the schema jaxlfi.Signal, got no messages"),
    "no time": ([with_state({}, b'{"values": [1]}')], {}, '/observation/state: expected messages {"time": in s'),
    "no JSON": ([with_state({}, b"\x00\xff")], {}, "/observation/state: expected messages"),
    "a number": ([with_state({}, b'{"time": 0, "values": 1}')], {}, "/observation/state: expected messages"),
    "a word": (
        [with_state({}, b'{"time": 0, "values": ["up"]}')],
        {},
        "/observation/state: expected an array of float",
    ),
    "sizes": (
        [with_state({}, BODY, b'{"time": 1, "values": [1]}')],
        {},
        r"expected messages of one size, got \[1, 2\]",
    ),
    "type": ([with_state({"dtype": "object"})], {}, "/observation/state: expected an array of object"),
    "names": ([with_state({"names": '["a"]'})], {}, "/observation/state: names: expected 2"),
    "no list": ([with_state({"names": "a, b"})], {}, "/observation/state: expected names as a JSON list"),
    "version": ([STATE], {"version": "2"}, "expected jaxlfi.rollout of version 1, got version 2, which a newer"),
    "metadata": ([STATE], {"version": "1", "metadata": "3"}, "expected a JSON object as metadata"),
}


@pytest.mark.parametrize(("topics", "record", "message"), FOREIGN.values(), ids=FOREIGN)
def test_files_that_do_not_fit_are_refused_in_one_line(tmp_path, topics, record, message):
    path = by_hand(tmp_path / "one.mcap", *topics, record=record)
    with pytest.raises(ValueError, match=message) as caught:
        mcap.read(path)
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)


@pytest.mark.parametrize("part", [0.05, 0.5, 0.95, 0.999])
def test_truncated_files_are_refused(tmp_path, part):
    path = tmp_path / "one.mcap"
    mcap.write(path, rollout())
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    with pytest.raises(
        ValueError, match="expected a complete MCAP file, got a truncated or damaged one; `mcap recover`"
    ):
        mcap.read(path)


def test_damaged_files_are_refused_or_read_as_they_were(tmp_path):
    path = tmp_path / "one.mcap"
    mcap.write(path, rollout())
    content, refused = path.read_bytes(), 0
    for place in range(9, len(content), len(content) // 40):
        spoiled = bytearray(content)
        spoiled[place] ^= 0xFF
        path.write_bytes(spoiled)
        try:
            back = mcap.read(path)
        except ValueError:
            refused += 1
        else:
            same(back, rollout())
    assert refused > 10


def test_other_paths_are_refused(tmp_path):
    with pytest.raises(ValueError, match="expected an MCAP file, got No such file"):
        mcap.read(tmp_path / "one.mcap")
    (tmp_path / "one.mcap").write_text("precious")
    with pytest.raises(ValueError, match=r"path: expected a new file, got .*, which exists"):
        mcap.write(tmp_path / "one.mcap", rollout())
    with pytest.raises(ValueError, match=r"signals: expected words with dots between them, got '\.a'"):
        mcap.write(tmp_path / "two.mcap", Rollout({".a": Signal([0.0], [[1.0]], ("a",))}))
    assert (tmp_path / "one.mcap").read_text() == "precious" and not (tmp_path / "two.mcap").exists()


def test_without_mcap_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxlfi\[robotics\]'"):
        mcap.write(tmp_path / "one.mcap", rollout())
