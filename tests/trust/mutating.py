"""Damage as accidents and strangers make it, the same every time for a seed."""

import contextlib
import copy
import json
import random
import resource
import signal

from acwm_core.errors import AcwmError

EVIL = [
    *(None, True, -1, 0, 2**31, 10**12, 10**30, 10**400, 1e308, float("nan"), float("inf"), 0.5),
    *("", "x", "../../x", "/etc/passwd", "a\0b", "\x1b[31m", "=1+1", "$x^", "é" * 40, "9" * 5000),
    *([], {}, [[]], {"": []}, [1, "a", None], ["x"] * 2000, {"x": {"y": 1}}),
]
"""In place of some value."""


def deep(levels):
    value = 1
    for _ in range(levels):
        value = [value]
    return value


def damaged(data: bytes, seed: int) -> bytes:
    """Bytes with a few flipped, cut, repeated or put in."""
    draw, data = random.Random(seed), bytearray(data)
    for _ in range(draw.randint(1, 4)):
        place, end = draw.randrange(len(data) + 1), draw.randrange(1, 64)
        kind = draw.randrange(6)
        if kind == 0 and place < len(data):
            data[place] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[place:]
        elif kind == 2:
            del data[place : place + end]
        elif kind == 3:
            data[place:place] = data[place : place + end]
        elif kind == 4:
            data[place : place + 8] = draw.choice([b"\xff" * 8, b"\0" * 8, b"\x7f" + b"\xff" * 7])
        else:
            data[place : place + end] = draw.randbytes(end)
    return bytes(data)


def places(value, path=()):
    """Where there are values in a value."""
    yield path
    if isinstance(value, dict | list):
        for key, each in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(each, (*path, key))


def changed(value, seed):
    """JSON's kinds of values with some replaced, lost or renamed."""
    draw, value = random.Random(seed), copy.deepcopy(value)
    for _ in range(draw.randint(1, 3)):
        path = draw.choice(list(places(value)))
        new = deep(draw.choice([30, 300])) if draw.random() < 0.03 else draw.choice(EVIL)
        if not path:
            if draw.random() < 0.1:
                value = copy.deepcopy(new)
            continue
        holder = value
        for key in path[:-1]:
            holder = holder[key]
        kind = draw.random()
        if kind < 0.25:
            del holder[path[-1]]
        elif kind < 0.35 and isinstance(holder, dict):
            holder[str(new)[:50]] = holder.pop(path[-1])
        else:
            holder[path[-1]] = copy.deepcopy(new)
    return value


def dumped(value):
    """As JSON; what is too deep or too long for Python is spelt out."""
    try:
        return json.dumps(value).encode()
    except (RecursionError, ValueError):
        return b"[" * 3000 + b"]" * 3000


@contextlib.contextmanager
def survives(seconds=60, megabytes=600):
    """Whatever the block reads ends well or as an `AcwmError` of one line, and costs little."""

    def late(*_):
        raise TimeoutError(f"{seconds} seconds of work, or ten times as long")

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    timers = {signal.ITIMER_PROF: signal.SIGPROF, signal.ITIMER_REAL: signal.SIGALRM}
    previous = {number: signal.signal(number, late) for number in timers.values()}
    signal.setitimer(signal.ITIMER_PROF, seconds)  # of this process, however busy the machine is
    signal.setitimer(signal.ITIMER_REAL, 10 * seconds)  # what waits for ever does not work
    try:
        yield
    except AcwmError as error:
        said = str(error).strip()
        if not said or "\n" in said:
            raise AssertionError(f"no sentence: {said}") from error
    finally:
        for timer in timers:
            signal.setitimer(timer, 0)
        for number, handler in previous.items():
            signal.signal(number, handler)
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024
    assert grown < megabytes, f"it took {grown} MB"
