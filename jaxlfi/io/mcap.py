"""MCAP files: messages with time stamps, as ROS 2 and Foxglove write and show them.

Each signal is a topic, such as /observation/state for "observation.state", with messages encoded as JSON of the schema
`jaxlfi.Signal`: {"time": 0.16, "values": [0.4, 0.36]}. The channel's metadata describe the numbers: `dtype`, `names` (a
JSON list), `unit` (or a JSON list of them), `duration`. Units may also stand in the JSON schema, as the `unit` of its
property `values`, or of its property `time` if times are not in s. The rollout's metadata are in the record
`jaxlfi.rollout`. Topics of other schemas are not read. If a file, or the folder of a bag, has none of these topics,
those of ROS 2 are read (`ros2`).

Times of the log are in ns from the first message on. Those of the rollout, which may begin before zero, are in the
messages, in full precision.

Needs the extra `robotics` (mcap).
"""

import importlib.util
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxlfi.io import clocks, files, ros2, units
from jaxlfi.io.formats import require_version
from jaxlfi.io.rollout import Rollout, Signal, array, numbers

SCHEMA, RECORD, VERSION = "jaxlfi.Signal", "jaxlfi.rollout", 1
INSTALL = "MCAP files need the package mcap: pip install 'jaxlfi[robotics]'"


def installed() -> bool:
    """Whether mcap is installed."""
    return importlib.util.find_spec("mcap") is not None


def write(path: str | Path, rollout: Rollout) -> None:
    """Write a rollout.

    Args:
        path: a new file.
        rollout: rollout with any signals; numbers that are not finite are written as null, and read as NaN.

    Raises:
        ValueError: for a path that exists.
        ImportError: without mcap.
    """
    path = Path(path)
    if path.exists():
        raise ValueError(f"path: expected a new file, got {path}, which exists")
    if dotted := [name for name in rollout.signals if name != ros2.topic_name(_topic(name))]:
        raise ValueError(f"signals: expected words with dots between them, got {dotted[0]!r}")
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise ImportError(INSTALL) from error
    import io

    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(library="jaxlfi")
    messages = []
    for name, signal in rollout.signals.items():
        schema = writer.register_schema(SCHEMA, "jsonschema", json.dumps(_schema(signal)).encode())
        metadata = {"dtype": signal.values.dtype.name, "names": json.dumps(signal.names), "unit": _unit_text(signal)}
        if signal.duration is not None:
            metadata["duration"] = repr(float(signal.duration))
        channel = writer.register_channel(_topic(name), "json", schema, metadata)
        messages += [
            (time, channel, values) for time, values in zip(signal.times.tolist(), numbers(signal.values), strict=True)
        ]
    messages.sort(key=lambda message: message[0])
    begin = messages[0][0] if messages else 0.0
    count = {}
    for time, channel, values in messages:
        stamp = round((time - begin) * 1e9)
        count[channel] = count.get(channel, 0) + 1
        body = json.dumps({"time": time, "values": values}, allow_nan=False).encode()
        writer.add_message(channel, stamp, body, stamp, count[channel])
    described = {"version": str(VERSION), "task": rollout.task}
    writer.add_metadata(RECORD, {**described, "metadata": json.dumps(dict(rollout.metadata), allow_nan=False)})
    writer.finish()
    files.write_bytes(path, stream.getvalue())


def read(path: str | Path) -> Rollout:
    """Read a rollout.

    Args:
        path: a file, or the folder of a ROS 2 bag, whose files are read together.

    Raises:
        ValueError: for a file that is missing, truncated, damaged, of another version or without such topics.
        ImportError: without mcap, and for messages of ROS 2 without mcap-ros2-support.
    """
    path, messages, others, records = Path(path), [], set(), {}
    several = sorted(path.glob("*.mcap")) if path.is_dir() else [path]
    if not several:
        raise ValueError(f"{path}: expected a bag of MCAP files, got none: `ros2 bag convert` converts other bags")
    for file in several:
        found, left, said = _content(file)
        messages += found
        others |= left
        records |= said
    messages.sort(key=lambda one: one[2].log_time)
    try:
        return _rollout(messages, others, records)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def is_bag(path: Path) -> bool:
    """Whether a path is the folder of a ROS 2 bag."""
    return path.is_dir() and ((path / "metadata.yaml").exists() or any(path.glob("*.mcap")))


def _content(path: Path) -> tuple[list[tuple[Any, Any, Any]], set[str], dict[str, Mapping[str, str]]]:
    """The messages of a file that can be read, with their schemas and channels; its other topics; and its metadata.

    Other messages, such as pictures, are not loaded.
    """
    try:
        from mcap.reader import make_reader
    except ImportError as error:
        raise ImportError(INSTALL) from error
    try:
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            if summary is not None and summary.channels:
                channels = [(summary.schemas.get(one.schema_id), one) for one in summary.channels.values()]
            else:  # writers may leave the summary out
                channels = [(schema, channel) for schema, channel, _ in reader.iter_messages()]
            wanted = {
                channel.topic for schema, channel in channels if _is_ours(schema, channel) or ros2.is_known(schema)
            }
            others = {
                f"{channel.topic} ({schema.name if schema else 'no schema'}, {channel.message_encoding})"
                for schema, channel in channels
                if channel.topic not in wanted
            }
            messages = list(reader.iter_messages(topics=sorted(wanted))) if wanted else []
            return messages, others, {record.name: record.metadata for record in reader.iter_metadata()}
    except OSError as error:
        raise ValueError(f"{path}: expected an MCAP file, got {error.strerror}") from error
    except Exception as error:  # mcap and its decompressors each raise their own
        raise ValueError(
            f"{path}: expected a complete MCAP file, got a truncated or damaged one; `mcap recover` of the MCAP "
            "command line saves what is left of one"
        ) from error


def _topic(name: str) -> str:
    return "/" + name.replace(".", "/")


def _schema(signal: Signal) -> dict[str, Any]:
    """A JSON schema of a signal's messages."""
    kind = {"b": "boolean", "i": "integer", "u": "integer", "f": ["number", "null"]}[signal.values.dtype.kind]
    count = len(signal.names)
    values = {"type": "array", "items": {"type": kind}, "minItems": count, "maxItems": count}
    properties = {"time": {"type": "number", "description": "in s"}, "values": values}
    return {"type": "object", "title": SCHEMA, "properties": properties, "required": ["time", "values"]}


def _is_ours(schema: Any, channel: Any) -> bool:
    return schema is not None and schema.name == SCHEMA and channel.message_encoding == "json"


def _rollout(
    messages: list[tuple[Any, Any, Any]], others: set[str], records: Mapping[str, Mapping[str, str]]
) -> Rollout:
    channels, times, values, said = {}, {}, {}, {}
    for schema, channel, message in messages:
        if not _is_ours(schema, channel):
            continue
        name = ros2.topic_name(channel.topic)
        if name not in channels:
            channels[name], said[name] = channel, _said(schema.data)
        time, row = _message(channel.topic, message.data)
        times.setdefault(name, []).append(time)
        values.setdefault(name, []).append(row)
    if not channels and messages:
        return ros2.rollout(messages)
    if not channels:
        raise ValueError(
            f"expected topics of ROS 2 of the types {', '.join(ros2.TYPES)}, or of JSON messages by the schema "
            f"{SCHEMA}, got {_some(others)}"
        )
    signals, faults = {}, []
    for name, channel in channels.items():
        try:
            unit = units.parse(said[name].get("time", "s"))
            if unit.name != "s":
                raise ValueError(f"expected times in a unit of time, got {said[name]['time']!r}")
            when = [unit.factor * time for time in times[name]]
            rows, fault = clocks.order(np.array(when), "message", repeated=True)
            faults += [f"{channel.topic}: expected times in order, got {fault}"] if fault else []
            described = {"unit": said[name].get("values", ""), **channel.metadata}
            signals[name] = _signal(described, np.array(when), values[name], rows)
        except ValueError as error:
            raise ValueError(f"{channel.topic}: {error}") from error
    record = records.get(RECORD, {"version": str(VERSION)})
    version = record.get("version")
    require_version("record", RECORD, VERSION, int(version) if str(version).isdecimal() else version)
    try:
        metadata = json.loads(record.get("metadata", "{}"))
        return Rollout(signals, dict(metadata), record.get("task", ""), tuple(faults))
    except (ValueError, TypeError) as error:
        raise ValueError(f"expected a JSON object as metadata in the record {RECORD}, got another text") from error


def _said(schema: bytes) -> dict[str, str]:
    """The units that a JSON schema gives for its properties."""
    try:
        properties = json.loads(schema)["properties"]
        return {name: one["unit"] for name, one in properties.items() if isinstance(one.get("unit"), str)}
    except (ValueError, KeyError, TypeError, AttributeError):
        return {}


def _message(topic: str, data: bytes) -> tuple[float, list]:
    try:
        body = json.loads(data)
        time, row = float(body["time"]), body["values"]
        if not isinstance(row, list) or not math.isfinite(time):
            raise TypeError("values are a list, times finite")
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f'{topic}: expected messages {{"time": in s, "values": [...]}}, got {data[:60].decode(errors="replace")!r}'
        ) from error
    return time, row


def _signal(metadata: Mapping[str, str], times: np.ndarray, rows: list[list], order: np.ndarray) -> Signal:
    if len({len(row) for row in rows}) != 1:
        raise ValueError(f"expected messages of one size, got {sorted({len(row) for row in rows})}")
    values = array(rows, metadata.get("dtype", "float64"))
    try:
        names = json.loads(metadata["names"]) if "names" in metadata else [f"{i}" for i in range(len(rows[0]))]
        duration = float(metadata["duration"]) if "duration" in metadata else None
        names = tuple(map(str, names))
    except (ValueError, TypeError) as error:
        raise ValueError(f"expected names as a JSON list and a duration in s, got {dict(metadata)}") from error
    return Signal(times[order], values[order], names, _unit(metadata.get("unit", "")), duration)


def _unit_text(signal: Signal) -> str:
    return signal.unit if isinstance(signal.unit, str) else json.dumps(signal.unit)


def _unit(text: str) -> str | tuple[str, ...]:
    """The unit, or those of each number from a JSON list."""
    try:
        several = json.loads(text) if text.startswith("[") else None
    except ValueError:
        return text
    return text if several is None else tuple(map(str, several))


def _some(names: set[str]) -> str:
    """Topics in words; of many, the first few."""
    shown = sorted(names)[:4]
    return ", ".join(shown) + (f" and {len(names) - 4} more" if len(names) > 4 else "") if shown else "no messages"
