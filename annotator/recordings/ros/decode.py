"""Messages from their bytes, by the definitions in the bag: ROS 1, ROS 2 (CDR), Protobuf and JSON.

ROS messages are decoded by rosbags, imported only here. A decoded message is an object whose attributes are the fields
of its definition, except that all ROS times have `sec` and `nanosec`.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from annotator.recordings.ros.bag import Channel, Topic, short_type
from annotator.types.checks import LATEST_NS
from annotator.types.errors import MissingExtraError

# Enough of a message for its time.
HEAD_BYTES = 32
SECOND = 10**9
# What reading the fields of a message raises if they are missing, or of other types than usual.
FIELD_ERRORS = (ValueError, TypeError, AttributeError, LookupError, ArithmeticError)


def decode(channel: Channel, data: bytes) -> Any:
    """Decodes a message.

    Raises:
        ValueError: it is damaged, or its encoding is unknown.
        MissingExtraError: rosbags or protobuf is not installed.
    """
    try:
        return _decoder(channel.encoding, channel.type, channel.schema_encoding, channel.schema)(data)
    except MissingExtraError:
        raise
    # for damaged messages and definitions, the libraries raise any exception
    except Exception as error:
        raise ValueError(f"is not a {short_type(channel.type)} ({str(error)[:120]})") from error


def message(topic: Topic, i: int) -> Any:
    """Reads and decodes message `i` of a topic.

    Raises:
        ValueError: it is damaged.
        OSError: the file cannot be read.
        MissingExtraError: rosbags or protobuf is not installed.
    """
    channel, data = topic.read(i)
    return decode(channel, data)


def stamp_ns(content: Any) -> int:
    """Returns the time in a message's header, nanoseconds; 0 = not set.

    Raises:
        ValueError: it is before 1970 or after 2262.
    """
    time = content.header.stamp if hasattr(content, "header") else content.timestamp
    if hasattr(time, "nanosec"):
        stamp = int(time.sec) * SECOND + int(time.nanosec)
    elif hasattr(time, "nanos"):
        stamp = int(time.seconds) * SECOND + int(time.nanos)
    else:
        stamp = int(time.sec) * SECOND + int(time.nsec)
    if not 0 <= stamp <= LATEST_NS:
        raise ValueError(f"has the impossible time {stamp} ns")
    return stamp


def frame_id(content: Any) -> str:
    """Returns the tf frame of a message, without a slash before it."""
    name = content.header.frame_id if hasattr(content, "header") else content.frame_id
    return str(name).lstrip("/")


def quick_stamp_ns(topic: Topic, i: int) -> int | None:
    """Returns the time in the header of message `i`, of a type that begins with it; None if it is damaged."""
    try:
        channel, data = topic.read(i, HEAD_BYTES)
        return _stamp_of_head(channel, data) if channel.encoding in ("ros1", "cdr") else stamp_ns(message(topic, i))
    except (*FIELD_ERRORS, OSError, struct.error):
        return None


def _stamp_of_head(channel: Channel, data: bytes) -> int:
    if channel.encoding == "cdr":
        sec, nanosec = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    else:
        # a header of ROS 1 begins with a number
        has_header = not channel.type.startswith("foxglove")
        sec, nanosec = struct.unpack_from("<II", data, 4 if has_header else 0)
    return int(sec) * SECOND + int(nanosec)


@lru_cache(maxsize=256)
def _decoder(encoding: str, kind: str, schema_encoding: str, schema: bytes) -> Callable[[bytes], Any]:
    if encoding == "json":
        return _from_json
    if encoding == "protobuf":
        return _protobuf_decoder(kind, schema)
    if encoding not in ("ros1", "cdr"):
        raise ValueError(f"has the unknown encoding {encoding!r}; known are ros1, cdr, protobuf and json")
    store, name = _typestore(kind, schema_encoding, schema), _ros2_type(kind)
    method = store.deserialize_ros1 if encoding == "ros1" else store.deserialize_cdr
    return lambda data: method(data, name)


def _ros2_type(kind: str) -> str:
    package, _, name = short_type(kind).partition("/")
    package = "foxglove_msgs" if package == "foxglove" else package
    return f"{package}/msg/{name}"


def _typestore(kind: str, schema_encoding: str, schema: bytes) -> Any:
    try:
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtraError("rosbags", "ros") from error
    if not schema:
        # bags of ROS 2 before Iron have no definitions
        return get_typestore(Stores.ROS2_HUMBLE)
    text = schema.decode("utf-8", "replace")
    store = get_typestore(Stores.EMPTY)
    if schema_encoding in ("ros1msg", "ros2msg"):
        types = get_types_from_msg(text, _ros2_type(kind))
    elif schema_encoding in ("ros2idl", "omgidl"):
        types = {}
        for part in text.split("=" * 80 + "\n"):
            types.update(get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL: ") else part))
    else:
        raise ValueError(f"has a definition of the unknown kind {schema_encoding!r}")
    store.register(types)
    return store


def _protobuf_decoder(kind: str, schema: bytes) -> Callable[[bytes], Any]:
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError as error:
        raise MissingExtraError("protobuf", "ros") from error
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    parse: Callable[[bytes], Any] = message_factory.GetMessageClass(pool.FindMessageTypeByName(kind)).FromString
    return parse


def _from_json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda values: SimpleNamespace(**values))


def byte_array(data: Any) -> np.ndarray:
    """Returns the bytes of a field: an array, bytes, base64 text (JSON) or a list of numbers.

    Raises:
        ValueError: something else.
    """
    if isinstance(data, str):
        try:
            data = base64.b64decode(data, validate=True)
        except binascii.Error as error:
            raise ValueError("its data are not base64") from error
    if isinstance(data, bytes | bytearray | memoryview):
        return np.frombuffer(data, np.uint8)
    return np.asarray(data).view(np.uint8) if isinstance(data, np.ndarray) else np.array(data, np.uint8)
