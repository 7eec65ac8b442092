"""Logs in MCAP: times of the log, topics by name, three encodings."""

import json

import mcap.writer
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import SeekingReader

from acwm_core.errors import DataError
from acwm_formats.mcap_logs import MCAP
from tests.formats.corpus import logs
from tests.formats.corpus.cases import Case, at, episode
from tests.formats.corpus.pictures import SIZE, number_in

LATE = Case("late", (episode(times=at(*range(2, 10)), row_times=at(*range(8))),))


@pytest.mark.parametrize("write", [logs.in_json, logs.in_ros2])
def test_times_count_from_the_first_frame(tmp_path, write):
    write(tmp_path, LATE)
    found = MCAP().read(tmp_path)
    recording = found.splits[0]
    frames = recording.cameras["camera"]
    np.testing.assert_allclose(frames.times, np.arange(8) / 10)
    np.testing.assert_allclose(recording.actions.times, np.arange(-2, 6) / 10)
    np.testing.assert_array_equal(recording.actions.values, LATE.episodes[0].rows)
    assert [int(number_in(frame)) for frame in frames.read([0, 3, 3, 7])] == [0, 3, 3, 7]
    assert [int(number_in(frame)) for frame in frames.read([1])] == [1]


TIMES = [0, 0.1, 0.2, 0.31, 0.4, 0.5, 0.79, 0.9, 1.0]  # two frames were lost


def video_log(path, codec="libx264", name="h264", first=0, packets=None, **options):
    packets = packets or [bytes(p) for p in logs.coded(range(9), codec, SIZE, options.items())]
    rows = [number / 10 for number in range(9)]
    logs.in_video(path, packets[first:], TIMES[first:], rows[first:], name)


@pytest.mark.parametrize(("codec", "name"), [("libx264", "h264"), ("libx265", "h265")])
def test_video_has_the_times_of_the_log(tmp_path, codec, name):
    video_log(tmp_path / "a.mcap", codec, name)
    recording = MCAP().read(tmp_path).splits[0]
    frames = recording.cameras["camera"]
    np.testing.assert_allclose(frames.times, TIMES, atol=1e-9)
    assert [int(number_in(frame)) for frame in frames.read([0, 1, 4, 4, 8])] == [0, 1, 4, 4, 8]
    assert [int(number_in(frame)) for frame in frames.read([3])] == [3]
    assert frames.size == SIZE
    assert recording.length is None


def test_video_begins_with_its_first_key_frame(tmp_path):
    video_log(tmp_path / "a.mcap", first=2)
    recording = MCAP().read(tmp_path).splits[0]
    frames = recording.cameras["camera"]
    np.testing.assert_allclose(frames.times, np.array(TIMES[4:]) - TIMES[4], atol=1e-9)
    assert [int(number_in(frame)) for frame in frames.read(range(5))] == [4, 5, 6, 7, 8]
    np.testing.assert_allclose(recording.actions.times[:3], [-0.2, -0.09, 0], atol=1e-9)
    assert recording.length == 7  # so that it is told


def test_video_that_cannot_be_read_right_is_refused(tmp_path):
    def frames():
        return list(MCAP().read(tmp_path).splits[0].cameras["camera"].read(range(9)))

    path = tmp_path / "a.mcap"
    video_log(path, bf="2", **{"b-adapt": "0"})
    with pytest.raises(DataError, match="B-frames"):
        frames()
    packets = [bytes(p) for p in logs.coded(range(9), "libx264", SIZE)]
    video_log(path, packets=[*packets[:5], packets[5][: len(packets[5]) // 2], *packets[6:]])
    with pytest.raises(DataError, match="the video /camera"):
        frames()
    video_log(path, packets=packets, name="vp9")
    with pytest.raises(DataError, match="write it as MP4"):
        frames()
    lengths = [len(p).to_bytes(4, "big") + p[4:] for p in packets]
    video_log(path, packets=lengths)
    with pytest.raises(DataError, match="not in Annex B"):
        frames()


def test_a_log_is_scanned_once(tmp_path, monkeypatch):
    protobuf_log(tmp_path / "a.mcap", ["/arm", "/hand"])
    found = MCAP().read(tmp_path, actions="/arm:torque", states="/arm:force,/hand")
    scanned, scan = [], SeekingReader.iter_messages

    def counted(reader, *args, **options):
        scanned.append(1)
        return scan(reader, *args, **options)

    monkeypatch.setattr(SeekingReader, "iter_messages", counted)
    recording = found.splits[0]
    assert recording.states["hand"].values.tolist() == [[1, 2]]
    assert len(scanned) == 1


def protobuf_log(path, topics):
    """A log of one Protobuf message per topic, with a field `force` and a header."""
    pool = descriptor_pool.DescriptorPool()
    file = descriptor_pb2.FileDescriptorProto(name="wrench.proto", syntax="proto3")
    kind = file.message_type.add(name="Wrench")
    double = descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE
    for number, name in enumerate(("stamp", "force", "torque"), 1):
        kind.field.add(name=name, number=number, type=double, label=1)
    pool.Add(file)
    wrench = message_factory.GetMessageClass(pool.FindMessageTypeByName("Wrench"))
    schema = descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString()
    with path.open("wb") as opened:
        writer = mcap.writer.Writer(opened)
        writer.start()
        known = writer.register_schema("Wrench", "protobuf", schema)
        image = writer.register_schema("foxglove.CompressedImage", "jsonschema", b"{}")
        camera = writer.register_channel("/camera", "json", image)
        for place, topic in enumerate(topics):
            channel = writer.register_channel(topic, "protobuf", known)
            data = wrench(stamp=9, force=place, torque=2).SerializeToString()
            writer.add_message(channel, 5, data, 5)
        writer.add_message(camera, 5, json.dumps({"data": ""}).encode(), 5)
        writer.finish()


def test_protobuf_and_a_field(tmp_path):
    protobuf_log(tmp_path / "a.mcap", ["/arm"])
    found = MCAP().read(tmp_path)
    assert found.actions.names == ("force", "torque")
    found = MCAP().read(tmp_path, actions="/arm:torque", states="/arm:force")
    assert found.actions.names == ("torque",)
    assert found.splits[0].states["arm:force"].values.tolist() == [[0.0]]


def test_the_topic_must_be_told_if_there_are_two(tmp_path):
    protobuf_log(tmp_path / "a.mcap", ["/arm", "/hand"])
    with pytest.raises(DataError, match=r"2 topics of numbers \(/arm, /hand\): give --actions"):
        MCAP().read(tmp_path)
    with pytest.raises(DataError, match="did you mean '/hand'"):
        MCAP().read(tmp_path, actions="/hnd")


def test_a_log_that_is_cut_off(tmp_path):
    logs.in_json(tmp_path, LATE)
    path = tmp_path / "run_0.mcap"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match=r"the log .* cannot be read"):
        MCAP().read(tmp_path)
