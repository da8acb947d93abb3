"""Messages out of ROS 1 bags, ROS 2 bags and MCAP files, through rosbags and mcap."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Protocol

from depthba.convert.packages import package
from depthba.errors import DatasetError, DepthbaError

_MORE = 4
"""Bytes that RealSense's recorder leaves behind the images of its bags of ROS 1, which the type
of the message does not have: the unit of depth, a float."""


class Store(Protocol):
    """Where messages lie. Times are those of the log, ns."""

    topics: dict[str, str]
    """Type of message, such as sensor_msgs/msg/Image, by topic."""

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Give topic, time and message of all messages of these topics."""

    def message(self, topic: str, time: int) -> Any:
        """Return the message of a topic at a time."""


def opened(path: Path) -> Store:
    """Open a bag: a .bag, .mcap or .db3 file, or a folder of ROS 2."""
    return _Mcap(path) if path.suffix == ".mcap" else _Bag(path)


class _Bag:
    """What rosbags reads."""

    def __init__(self, path: Path) -> None:
        highlevel = package("rosbags.highlevel", "a bag")
        typesys = package("rosbags.typesys", "a bag")
        self._path = path
        # bags of before Iron do not carry the definitions of their messages
        known = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        try:
            self._reader = highlevel.AnyReader([path], default_typestore=known)
            self._reader.open()
        except Exception as error:  # broken bags fail in many ways
            raise DatasetError(f"{path}: {error}, expected a bag of ROS 1 or 2") from error
        for connection in self._reader.connections:
            for name in (connection.topic, connection.msgtype):
                if not isinstance(name, str):
                    raise DatasetError(f"{path}: topic or type {name!r}, expected a name")
        self.topics = {c.topic: c.msgtype for c in self._reader.connections}

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = set(topics)
        connections = [c for c in self._reader.connections if c.topic in wanted]
        if not connections:  # none would mean all
            return
        found = self._reader.messages(connections=connections)
        for connection, time, data in _whole(found, self._path):
            yield connection.topic, time, self._decoded(connection.msgtype, data, connection.topic)

    def message(self, topic: str, time: int) -> Any:
        connections = [c for c in self._reader.connections if c.topic == topic]
        found = self._reader.messages(connections, start=time, stop=time + 1)
        for connection, _, data in _whole(found, self._path):
            return self._decoded(connection.msgtype, data, topic)
        raise DatasetError(f"{self._path}: no message of {topic} at {time} ns")

    def _decoded(self, kind: str, data: bytes, topic: str) -> Any:
        try:
            try:
                return self._reader.deserialize(data, kind)
            except Exception:
                if not (topic.startswith("/device_") and kind == "sensor_msgs/msg/Image"):
                    raise
                return self._reader.deserialize(data[:-_MORE], kind)
        except Exception as error:  # cut off, or not of that type
            raise DatasetError(f"{self._path}: {topic}: {error!r}, expected {kind}") from error

    def __del__(self) -> None:
        reader = getattr(self, "_reader", None)
        if reader is not None and reader.stack:
            reader.close()


class _Mcap:
    """MCAP files with messages of ROS 1 or ROS 2, whose definitions lie in the file."""

    def __init__(self, path: Path) -> None:
        reading = package("mcap.reader", "MCAP")
        typesys = package("rosbags.typesys", "MCAP")
        self._path = path
        self._types = typesys.get_typestore(typesys.Stores.EMPTY)
        try:
            self._file = path.open("rb")
            self._reader = reading.make_reader(self._file)
            summary = self._reader.get_summary()
            if summary is None:
                raise ValueError("no summary at its end: it was cut off")
            self.topics: dict[str, str] = {}
            for channel in summary.channels.values():
                schema = summary.schemas.get(channel.schema_id)
                if schema is not None and schema.encoding in ("ros1msg", "ros2msg"):
                    name = schema.name if "/msg/" in schema.name else _long(schema.name)
                    text = schema.data.decode()
                    self._types.register(typesys.get_types_from_msg(text, name))
                    self.topics[channel.topic] = name
        except OSError as error:
            raise DatasetError(f"{path}: {error.strerror}, expected an MCAP file") from error
        except Exception as error:  # broken files fail in many ways
            raise DatasetError(f"{path}: {error}, expected an MCAP file of ROS") from error

    def messages(self, topics: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        wanted = [topic for topic in topics if topic in self.topics]
        if wanted:
            found = self._reader.iter_messages(topics=wanted)
            for _, channel, message in _whole(found, self._path):
                yield channel.topic, message.log_time, self._decoded(channel, message)

    def message(self, topic: str, time: int) -> Any:
        found = self._reader.iter_messages(topics=[topic], starting_at=time, ending_before=time + 1)
        for _, channel, message in _whole(found, self._path):
            return self._decoded(channel, message)
        raise DatasetError(f"{self._path}: no message of {topic} at {time} ns")

    def _decoded(self, channel: Any, message: Any) -> Any:
        kind = self.topics[channel.topic]
        try:
            if channel.message_encoding == "ros1":
                return self._types.deserialize_ros1(message.data, kind)
            return self._types.deserialize_cdr(message.data, kind)
        except Exception as error:  # cut off, or not of that type
            raise DatasetError(
                f"{self._path}: {channel.topic}: {error!r}, expected {kind}"
            ) from error

    def __del__(self) -> None:
        if hasattr(self, "_file"):
            self._file.close()


def _whole(found: Iterator[Any], path: Path) -> Iterator[Any]:
    """Give what a library finds in a bag; whatever it throws becomes a known error."""
    try:
        yield from found
    except DepthbaError:
        raise
    except Exception as error:  # broken bags fail in many ways
        raise DatasetError(f"{path}: {error}, expected a whole bag") from error


def _long(name: str) -> str:
    """Return a type's name as ROS 2 has it."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[-1]}"
