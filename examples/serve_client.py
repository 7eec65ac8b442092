"""A client of `acwm serve` to copy: needs numpy, msgpack and websockets, neither torch nor acwm.

with Client("ws://127.0.0.1:8427", token) as client:
    client.start(frame)  # [H, W, 3] uint8, of client.facts["frame_size"]
    frames = client.step(actions)["frames"]  # [N, A] give [N, H, W, 3]
"""

import msgpack
import numpy as np
from websockets.sync.client import connect


def as_map(array):
    """An array as it is sent."""
    array = np.ascontiguousarray(array)
    facts = {"dtype": array.dtype.str, "shape": array.shape, "data": array.tobytes()}
    return {"__ndarray__": True, **facts}


def as_array(values):
    """A map that was received, or the array that it holds."""
    if "__ndarray__" not in values:
        return values
    return np.frombuffer(values["data"], values["dtype"]).reshape(values["shape"])


class Client:
    """One video of a model on a server."""

    def __init__(self, address, token):
        headers = {"Authorization": f"Bearer {token}"}
        self._connection = connect(address, additional_headers=headers, max_size=None)

    def start(self, frames, **options):
        """Begin with frames [K, H, W, 3]; options: actions, seed, goal, want=["states", …]."""
        return self._ask({"frames": np.asarray(frames, np.uint8), **options})

    def step(self, actions):
        """Predict the frames that raw actions [N, A] lead to; N is a multiple of the stride."""
        return self._ask({"actions": np.asarray(actions, np.float32)})

    def plan(self, frames, goal, **options):
        """The next raw actions [N, A] towards a goal, from frames [N, H, W, 3] that were seen.

        Options: actions between the frames, still (action for no motion), seed.
        """
        return self._ask({"observed": np.asarray(frames, np.uint8), "goal": goal, **options})

    def _ask(self, message):
        self.socket.send(msgpack.packb(message, default=as_map))
        return self._receive()

    def _receive(self):
        answer = self.socket.recv()
        if isinstance(answer, str):  # one sentence that says what is wrong
            raise RuntimeError(answer)
        return msgpack.unpackb(answer, object_hook=as_array)

    def __enter__(self):
        self.socket = self._connection.__enter__()
        self.facts = self._receive()
        return self

    def __exit__(self, *error):
        self._connection.__exit__(*error)
