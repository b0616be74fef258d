"""Prints what is in an MCAP file as one JSON object, as two independent readers agree on it.

    read.py FILE            a whole file: its index, its checksums, each message by both readers
    read.py --recover FILE  a file that ends early: what can be read of it, front to back, by the first reader

The first reader is the MCAP project's, which decodes by the definitions in the file. The second is rosbags, which decodes by
its own definitions of ROS 2's types, and to which those in the file must be equal.
"""

import json
import struct
import sys
from pathlib import Path

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, SeekingReader
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap_ros2.decoder import DecoderFactory
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def plain(value):
    """A message as either reader has it, in lists, dictionaries, numbers and strings."""
    if isinstance(value, (bytes, bytearray, memoryview)):
        return list(bytes(value))
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (bool, int, float, str)):
        return value
    names = getattr(value, "__dataclass_fields__", None) or value.__slots__
    return {
        name: plain(getattr(value, name))
        for name in names
        # Constants are no fields.
        if not name.startswith("_") and not name.isupper()
    }


def line(schema, channel, message):
    decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
    return {
        "topic": channel.topic,
        "type": schema.name,
        "about": channel.metadata,
        "sequence": message.sequence,
        "log_time": message.log_time,
        "publish_time": message.publish_time,
        "message": plain(decode(message.data)),
    }


def by_mcap(path):
    """All messages by the index, and the same front to back with all checksums."""
    with path.open("rb") as file:
        reader = SeekingReader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None, "no index"
        indexed = [line(*found) for found in reader.iter_messages()]
        assert len(indexed) == summary.statistics.message_count
    with path.open("rb") as file:
        streamed = [line(*found) for found in NonSeekingReader(file, validate_crcs=True).iter_messages()]

    def order(found):
        return json.dumps(found, sort_keys=True)

    assert sorted(indexed, key=order) == sorted(streamed, key=order), "the index leads to other messages"
    return indexed


def by_rosbags(path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    with Reader(path) as reader:
        for connection in reader.connections:
            written = get_types_from_msg(connection.msgdef.data, connection.msgtype)
            for name, (constants, fields) in written.items():
                assert store.fielddefs[name] == (constants, fields), f"{name} is not ROS 2's"
        return [
            (connection.topic, connection.msgtype, time, plain(store.deserialize_cdr(data, connection.msgtype)))
            for connection, time, data in reader.messages()
        ]


def recovered(path):
    schemas, channels, lines = {}, {}, []
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, validate_crcs=True).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    channel = channels[record.channel_id]
                    lines.append(line(schemas[channel.schema_id], channel, record))
        except (McapError, CRCValidationError, struct.error) as end:
            return lines, f"{type(end).__name__}: {end}"
    return lines, None


def main():
    *options, path = sys.argv[1:]
    path = Path(path)
    if options == ["--recover"]:
        lines, end = recovered(path)
        print(json.dumps({"messages": lines, "end": end}))
        return
    lines = by_mcap(path)

    def order(found):
        return json.dumps(found, sort_keys=True)

    ours = sorted(((found["topic"], found["type"], found["log_time"], found["message"]) for found in lines), key=order)
    theirs = sorted(by_rosbags(path), key=order)
    assert json.dumps(ours) == json.dumps(theirs), "the readers do not agree"
    print(json.dumps({"messages": lines, "end": None}))


main()
