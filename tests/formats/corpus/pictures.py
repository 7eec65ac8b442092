"""Pictures that show a number in blocks, which survive compression, scaling and colour conversion.

Two rows of four blocks: the first, at the top left, is red and tells what is up and which channel
is first; the others are the bits of the number, bright or dark.
"""

import numpy as np

BITS = 7
SIZE = (48, 64)
DARK, BRIGHT, RED = (30, 30, 30), (225, 225, 225), (210, 40, 40)
NEAR, MIDDLE, FAR = 500, 1000, 1500  # of a depth picture, in mm


def picture(number, size=SIZE):
    """The number as ``[H, W, 3]`` uint8."""
    bits = [BRIGHT if number >> bit & 1 else DARK for bit in range(BITS)]
    blocks = np.array([RED, *bits], np.uint8).reshape(2, 4, 3)
    rows = np.arange(size[0]) * 2 // size[0]
    columns = np.arange(size[1]) * 4 // size[1]
    return blocks[rows][:, columns]


def depth(number, size=SIZE):
    """The number as ``[H, W]`` uint16, in mm: bright blocks are far."""
    shown = picture(number, size)
    red = (shown == RED).all(2)
    return np.where(red, MIDDLE, np.where(shown[..., 1] > 128, FAR, NEAR)).astype(np.uint16)


def blocks(frame):
    """The middle of each block, ``[8, 3]``."""
    height, width = frame.shape[0] // 2, frame.shape[1] // 4
    parts = [frame[r * height : (r + 1) * height, c * width : (c + 1) * width] for r, c in GRID]
    middle = [p[height // 4 : -(height // 4), width // 4 : -(width // 4)] for p in parts]
    return np.array([part.reshape(-1, 3).mean(0) for part in middle])


GRID = [(row, column) for row in range(2) for column in range(4)]


def number_in(frame, grey=False):
    """The number that a frame shows, or what is wrong with its colours."""
    first, *bits = blocks(frame.astype(float))
    if not grey:
        found = np.abs(first - RED).max()
        assert found < 30, f"the red block is {first.round()}"
        plain = [DARK, BRIGHT]
        worst = max(min(np.abs(bit - each).max() for each in plain) for bit in bits)
        assert worst < 30, f"a block is {worst:.0f} from its colour"
    return sum((bit.mean() > 128) << place for place, bit in enumerate(bits))
