"""Logs in MCAP, written by the libraries of MCAP: JSON, ROS 2 and Protobuf."""

import base64
import io
import json
from fractions import Fraction

import av
import mcap.writer
import numpy as np
from mcap_ros2.writer import Writer as Ros2
from PIL import Image

from tests.formats.corpus.clips import FAST
from tests.formats.corpus.pictures import depth, picture

START = 1_700_000_000 * 10**9  # when the first frame was logged, in ns since 1970

COMPRESSED = """\
std_msgs/Header header
string format
uint8[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
ARRAY = """\
std_msgs/MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""


def encoded(number, case):
    """A frame as the bytes of a PNG or JPEG."""
    file = io.BytesIO()
    if case.pixels == "depth":
        Image.fromarray(depth(number, case.size)).save(file, "PNG")
    else:
        Image.fromarray(picture(number, case.size)).save(file, "JPEG", quality=92)
    return file.getvalue()


def messages(episode, case):
    """Topic, time in ns and content of each message, in order of time."""
    frames = zip(episode.numbers, episode.times, strict=True)
    found = [("/camera", t, encoded(number, case)) for number, t in frames]
    rows = zip(episode.row_times, episode.rows, strict=True)
    found += [("/command", t, [float(value) for value in row]) for t, row in rows]
    return [(topic, START + round(t * 10**9), what) for topic, t, what in sorted(found, key=_time)]


def _time(message):
    return message[1]


def in_json(folder, case):
    """With the schemas of Foxglove."""
    for place, episode in enumerate(case.episodes):
        with (folder / f"run_{place}.mcap").open("wb") as file:
            writer = mcap.writer.Writer(file)
            writer.start()
            image = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
            command = writer.register_schema("Command", "jsonschema", b"{}")
            channels = {
                "/camera": writer.register_channel("/camera", "json", image),
                "/command": writer.register_channel("/command", "json", command),
            }
            for topic, time, what in messages(episode, case):
                content = {"clock": what[0], "turn": what[1]} if topic == "/command" else None
                content = content or {"format": "jpeg", "data": base64.b64encode(what).decode()}
                writer.add_message(channels[topic], time, json.dumps(content).encode(), time)
            writer.finish()
    return folder, {}


def in_ros2(folder, case):
    """With messages of ROS 2 in CDR."""
    for place, episode in enumerate(case.episodes):
        with (folder / f"run_{place}.mcap").open("wb") as file:
            writer = Ros2(file)
            image = writer.register_msgdef("sensor_msgs/msg/CompressedImage", COMPRESSED)
            array = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
            header = {"stamp": {"sec": 1, "nanosec": 2}, "frame_id": "camera"}
            for topic, time, what in messages(episode, case):
                if topic == "/camera":
                    content = {"header": header, "format": "jpeg", "data": what}
                    writer.write_message(topic, image, content, time, time)
                else:
                    content = {"layout": {"dim": [], "data_offset": 0}, "data": what}
                    writer.write_message(topic, array, content, time, time)
            writer.finish()
    return folder, {}


def coded(numbers, codec, size, options=(), pixels="yuv420p"):
    """Pictures as the packets of a video, a key frame and three others, in the encoder's order."""
    encoder = av.CodecContext.create(codec, "w")
    encoder.width, encoder.height, encoder.pix_fmt = size[1], size[0], pixels
    encoder.time_base, encoder.framerate = Fraction(1, 10), Fraction(10)
    encoder.gop_size, encoder.max_b_frames, encoder.thread_count = 4, 0, 1
    encoder.options = {**FAST[codec], **dict(options)}
    for place, number in enumerate(numbers):
        image = np.ascontiguousarray(picture(number, size))
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts = place
        yield from encoder.encode(frame)
    yield from encoder.encode(None)


def in_video(path, packets, times, rows, name):
    """One log with a topic of Foxglove's CompressedVideo, and a row of actions at each time."""
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        kind = writer.register_schema("foxglove.CompressedVideo", "jsonschema", b"{}")
        camera = writer.register_channel("/camera", "json", kind)
        command = writer.register_channel(
            "/command", "json", writer.register_schema("Command", "jsonschema", b"{}")
        )
        for packet, time, row in zip(packets, times, rows, strict=True):
            data = base64.b64encode(packet).decode()
            content = {"timestamp": {"sec": 7, "nsec": 7}, "format": name, "data": data}
            at = START + round(time * 10**9)
            writer.add_message(camera, at, json.dumps(content).encode(), at)
            writer.add_message(command, at, json.dumps({"turn": row}).encode(), at)
        writer.finish()
