"""Pictures enlarged for people, with the names of their views above them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from acwm_core.data.pictures import enlarge, join, magnification
from acwm_core.env.environment import EnvironmentCard
from acwm_core.evaluation.results import DIVIDER
from acwm_core.evaluation.videos import DARK

HEIGHT, SIZE, MARGIN = 24, 15, 4
"""Height of a line of captions, of its letters, and what is left free beside them, in pixels."""

INK = (232, 234, 238)


def enlarged(picture: NDArray[np.uint8], card: EnvironmentCard) -> NDArray[np.uint8]:
    """Enlarge frames side by side `[H, W, 3]`; if they show several views, names stand above."""
    scale = magnification(card.frame_size[0])
    large = enlarge(picture, scale)
    if not card.views:
        return large
    width, period = card.frame_size[1] * scale, (card.frame_size[1] + DIVIDER) * scale
    line = Image.new("RGB", (large.shape[1], HEIGHT), DARK)
    drawing, font = ImageDraw.Draw(line), ImageFont.load_default(SIZE)
    room = width / len(card.views)
    for left in range(0, large.shape[1], period):
        for place, name in enumerate(card.view_names):
            while drawing.textlength(name, font) > room - 2 * MARGIN and len(name) > 1:
                name = "…" + name.lstrip("…")[1:]  # ends differ more than beginnings
            drawing.text((left + place * room + MARGIN, MARGIN / 2), name, INK, font)
    return join([np.asarray(line), large], down=True)
