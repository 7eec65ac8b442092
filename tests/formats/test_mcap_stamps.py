"""When messages of a log were taken: headers that differ from the times of the log."""

import base64
import json

import mcap.writer
import numpy as np
import pytest
from mcap_ros2.writer import Writer as Ros2

from acwm_formats.mcap_logs import MCAP
from tests.formats.corpus.cases import Case, episode
from tests.formats.corpus.logs import COMPRESSED, START, encoded

LATE = np.array([0.1, 0.15, 0.2, 0.25, 0.2, 0.12, 0.1, 0.1])
TIMES = np.arange(8) / 10
CASE = Case("late", (episode(),))
STAMPED = """\
std_msgs/Header header
float64[] data
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""


def ns(seconds):
    return round(float(seconds) * 1e9)


def foxglove(path, camera, command):
    """Messages in JSON, with a timestamp where the given function says one, in ns."""
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start()
        image = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        other = writer.register_schema("Command", "jsonschema", b"{}")
        channels = [
            writer.register_channel("/camera", "json", image),
            writer.register_channel("/command", "json", other),
        ]
        said = []
        for place, time in enumerate(TIMES):
            data = base64.b64encode(encoded(place, CASE)).decode()
            contents = {"format": "jpeg", "data": data}, {"turn": float(place)}
            for number, stamp in enumerate((camera, command)):
                logged = START + ns(time + (LATE[place] if number == 0 else 0))
                content = dict(contents[number])
                if stamp is not None:
                    at = stamp(time)
                    content["timestamp"] = {"sec": at // 10**9, "nsec": at % 10**9}
                said.append((logged, channels[number], json.dumps(content).encode()))
        for logged, channel, content in sorted(said):
            writer.add_message(channel, logged, content, logged)
        writer.finish()


def ros2(path, camera, command):
    """The same in messages of ROS 2."""
    with path.open("wb") as file:
        writer = Ros2(file)
        image = writer.register_msgdef("sensor_msgs/msg/CompressedImage", COMPRESSED)
        array = writer.register_msgdef("my_msgs/msg/Command", STAMPED)

        def header(stamp, time):
            at = stamp(time) if stamp else 0
            stamped = {"sec": at // 10**9, "nanosec": at % 10**9}
            return {"header": {"stamp": stamped, "frame_id": "x"}}

        said = []
        for place, time in enumerate(TIMES):
            shown = {"format": "jpeg", "data": encoded(place, CASE), **header(camera, time)}
            told = {"data": [float(place)], **header(command, time)}
            said.append((START + ns(time + LATE[place]), 0, "/camera", image, shown))
            said.append((START + ns(time), 1, "/command", array, told))
        for logged, _, topic, schema, content in sorted(said, key=lambda each: each[:2]):
            writer.write_message(topic, schema, content, logged, logged)
        writer.finish()


def epoch(time):
    return START + ns(time)


def device(time):
    return 77 * 10**9 + ns(time)


def fixed(time):
    return START + 1


WRITERS = {"json": foxglove, "ros2": ros2}
both = pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)


def read(folder, write, camera, command, **options):
    write(folder / "a.mcap", camera, command)
    found = MCAP().read(folder, **options)
    recording = found.splits[0]
    return recording.cameras["camera"].times, recording.actions.times, found.notes[0]


@both
@pytest.mark.parametrize("command", [None, epoch, device], ids=["none", "epoch", "device"])
def test_pictures_have_the_times_at_which_they_were_taken(tmp_path, write, command):
    frames, actions, note = read(tmp_path, write, epoch, command)
    np.testing.assert_allclose(frames, TIMES, atol=1e-6)
    np.testing.assert_allclose(actions, TIMES, atol=1e-6)
    assert "/camera 0.135 s before it was logged" in note


@both
def test_stamps_of_one_other_clock_are_compared_with_each_other(tmp_path, write):
    frames, actions, note = read(tmp_path, write, device, device)
    np.testing.assert_allclose(frames, TIMES, atol=1e-6)
    np.testing.assert_allclose(actions, TIMES, atol=1e-6)
    assert "headers" in note


@both
@pytest.mark.parametrize(
    ("camera", "command"), [(device, None), (fixed, None), (None, None), (None, device)]
)
def test_stamps_that_cannot_be_compared_are_not_taken(tmp_path, write, camera, command):
    frames, actions, note = read(tmp_path, write, camera, command)
    np.testing.assert_allclose(frames, TIMES + LATE - LATE[0], atol=1e-6)
    np.testing.assert_allclose(actions, TIMES - LATE[0], atol=1e-6)
    assert "times are those of the log" in note
    assert ("not of the headers" in note) == (device in (camera, command))


def swapped(time):
    return START + ns(time if time > 0.15 else 0.15 - time)


@both
def test_stamps_that_go_back_are_told(tmp_path, write):
    frames, _, note = read(tmp_path, write, swapped, None)
    np.testing.assert_allclose(frames, TIMES + LATE - LATE[0], atol=1e-6)
    assert "go back in the headers of /camera" in note


@both
def test_the_user_decides(tmp_path, write):
    frames, _, note = read(tmp_path, write, epoch, None, stamps="log")
    np.testing.assert_allclose(frames, TIMES + LATE - LATE[0], atol=1e-6)
    assert "as asked" in note
