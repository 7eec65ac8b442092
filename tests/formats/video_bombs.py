"""Videos of a few kilobytes that claim more than any machine holds."""

import functools
import io
import struct

import av
import numpy as np

SIDE = 4096


@functools.cache
def video(container="mp4", size=(32, 32), frames=8, codec="libx264", pixels="yuv420p", options=()):
    """A small black video."""
    buffer = io.BytesIO()
    with av.open(buffer, "w", format=container, options=dict(options)) as output:
        stream = output.add_stream(codec, rate=10)
        stream.height, stream.width, stream.pix_fmt = *size, pixels
        for _ in range(frames):
            picture = np.zeros((*size, 3), np.uint8)
            output.mux(stream.encode(av.VideoFrame.from_ndarray(picture)))
        output.mux(stream.encode(None))
    return buffer.getvalue()


def patched(data, kind, offset, *numbers):
    """With other numbers of 32 bits at a place after the first box of a kind."""
    place = data.index(kind) + 4 + offset
    new = struct.pack(f">{len(numbers)}I", *numbers)
    return data[:place] + new + data[place + len(new) :]


def many_samples(count):
    """Samples of one byte each, all in one chunk."""
    data = patched(video(), b"stsz", 4, 1, count)
    data = patched(data, b"stsc", 12, count)
    return patched(data, b"stts", 4, 1, count)


def many_in_a_fragment(count):
    """Samples of the default size."""
    options = (("movflags", "frag_keyframe+empty_moov+default_base_moof"),)
    data = video(options=options)
    place = data.index(b"trun") + 4
    return data[:place] + struct.pack(">II", 0, count) + data[place + 8 :]


def many_edits(count):
    """The whole video, again and again."""
    data = video()  # whose header comes last
    place = data.index(b"edts") - 4
    size = int.from_bytes(data[place : place + 4])
    entry = struct.pack(">IiHH", 800, 0, 1, 0)
    body = struct.pack(">II", 0, count) + entry * count
    elst = struct.pack(">I4s", 8 + len(body), b"elst") + body
    edits = struct.pack(">I4s", 8 + len(elst), b"edts") + elst
    data = data[:place] + edits + data[place + size :]
    for kind in (b"trak", b"moov"):
        place = data.index(kind) - 4
        old = int.from_bytes(data[place : place + 4])
        data = data[:place] + struct.pack(">I", old + len(edits) - size) + data[place + 4 :]
    return data


def large(codec):
    """A size of 65535×65535 in the frames, or in the header if they state none."""
    if codec == "mjpeg":
        data = video("avi", codec="mjpeg", pixels="yuvj420p")
        start = data.index(b"\xff\xc0") + 5
        return data[:start] + b"\xff" * 4 + data[start + 4 :]
    if codec == "png":
        data = video("mov", codec="png", pixels="rgb24")
        return patched(data, b"IHDR", 0, 65535, 65535)
    if codec == "rawvideo":
        data = video("avi", codec="rawvideo", pixels="yuv420p")
        place = data.index(b"strf") + 12
        return data[:place] + struct.pack("<ii", 65535, 65535) + data[place + 8 :]
    data = video("matroska", (512, 512), codec="ffv1", pixels="yuv420p")
    old, new = (b"\xb0\x82" + n + b"\xba\x82" + n for n in (b"\x02\x00", b"\xff\xff"))
    assert old in data
    return data.replace(old, new)


def dense(container, count, side=SIDE):
    """Frames that are like the one before, of a few bytes each."""
    data, buffer = video(container, (side, side), 2), io.BytesIO()
    with av.open(io.BytesIO(data)) as source, av.open(buffer, "w", format=container) as output:
        stream = output.add_stream_from_template(source.streams.video[0])
        packets = [bytes(p) for p in source.demux(video=0) if p.size]
        for number in range(count):
            packet = av.Packet(packets[min(number, 1)])
            packet.pts = packet.dts = number * 1000
            packet.time_base, packet.stream = source.streams.video[0].time_base, stream
            packet.is_keyframe = number == 0
            output.mux(packet)
    return buffer.getvalue()


BOMBS = {
    "samples.mp4": lambda: many_samples(170_000_000),
    "fragment.mp4": lambda: many_in_a_fragment(170_000_000),
    "edits.mp4": lambda: many_edits(300_000),
    "mjpeg.avi": lambda: large("mjpeg"),
    "png.mov": lambda: large("png"),
    "raw.avi": lambda: large("rawvideo"),
    "ffv1.mkv": lambda: large("ffv1"),
    "dense.mkv": lambda: dense("matroska", 400),
}
