"""Contact sheets and films: sizes, moments, and labels that can be read whole."""

import numpy as np
import pytest

from acwm_core.data.pictures import join
from acwm_core.env.card import ActionSpec
from acwm_formats.sheets import (
    ACCENT,
    GAP,
    LINE_HEIGHT,
    MAX_WIDTH,
    Label,
    action_shares,
    contact_sheet,
    magnified,
    play_together,
)


def film(frames, height, width, shade=100):
    """Frame t is uniformly of the shade t + `shade`, so that a moment can be told."""
    levels = (np.arange(frames) + shade) % 256
    return np.broadcast_to(levels[:, None, None, None], (frames, height, width, 3)).astype(np.uint8)


def shades(row):
    """The shades of the pictures in a row of pixels, the gaps left out."""
    values = row[:, 0].tolist()
    return [v for k, v in enumerate(values) if v != 255 and (k == 0 or values[k - 1] != v)]


def accent(picture):
    return (np.abs(picture.astype(int) - ACCENT).max(-1) < 40).any(1)


@pytest.mark.parametrize(
    ("size", "columns", "width"), [((240, 240), 8, 8 * 246 - 6), ((240, 400), 6, 6 * 406 - 6)]
)
def test_a_sheet_shows_evenly_spaced_moments_as_many_as_fit(size, columns, width):
    sheet = contact_sheet([Label("train 0")] * 2, [film(121, *size)] * 2)
    assert sheet.shape == (2 * (LINE_HEIGHT + 240) + GAP, width, 3)
    assert sheet.shape[1] <= MAX_WIDTH
    expected = np.linspace(0, 120, columns).round().astype(int) + 100
    assert shades(sheet[LINE_HEIGHT + 5]) == expected.tolist()


def test_a_short_film_shows_every_frame_once():
    sheet = contact_sheet([Label("train 0")], [film(3, 144, 144)])
    assert shades(sheet[-1]) == [100, 101, 102]


def test_small_frames_are_enlarged_without_blur():
    frame = np.arange(16 * 24 * 3, dtype=np.uint8).reshape(16, 24, 3)
    large = magnified(frame)
    assert large.shape == (144, 216, 3)
    np.testing.assert_array_equal(large[4::9, 4::9], frame)
    big = np.zeros((240, 400, 3), np.uint8)
    assert magnified(big).shape == big.shape


def test_films_of_many_lengths_play_to_the_end_of_the_longest():
    films = [film(300, 64, 64, 0), film(5, 64, 64, 0)]
    played = list(play_together([Label("a 0"), Label("a 1")], films))
    assert len(played) == 300
    assert shades(played[2][-1]) == [2, 2]
    assert shades(played[200][-1]) == [200, 4]  # the short one rests on its last frame
    assert all(frame.shape == played[0].shape for frame in played)


def test_a_grid_has_as_many_across_as_wanted():
    labels, films = [Label(f"a {k}") for k in range(6)], [film(1, 144, 144)] * 6
    (usual,), (wide,) = (play_together(labels, films), play_together(labels, films, across=6))
    assert usual.shape[1] < wide.shape[1]
    assert wide.shape[1] // 144 == 6
    assert wide.shape[0] < usual.shape[0]


def test_a_long_label_breaks_into_lines_and_nothing_of_it_is_lost():
    label = Label("ood_test 12", "placement=edge+cube_count=5+colors=pastel+light=overcast")
    (frame,) = play_together([label], [film(1, 48, 48, 0)])
    lines = len(frame) // LINE_HEIGHT - 144 // LINE_HEIGHT
    assert lines == 5  # the name, and a line for each factor that is not alone in its line
    for k in range(1, 5):
        strip = frame[k * LINE_HEIGHT : (k + 1) * LINE_HEIGHT]
        assert accent(strip).any()
        assert (strip[:, -2:] == 255).all()  # it ends before the edge
    (wide,) = contact_sheet([label], [film(1, 240, 400)])[None]
    assert len(wide) > 240


def test_words_without_end_are_cut():
    (frame,) = play_together([Label("train 0", "x" * 500)], [film(1, 144, 144)])
    assert frame.shape == (2 * LINE_HEIGHT + 144, 144, 3)
    assert (frame[:LINE_HEIGHT, -1] == 255).all()


def test_labels_stand_right_above_their_pictures():
    labels = [Label("ood_test 0", "a_long_factor=1+another_one=2"), Label("train 1", "short")]
    (frame,) = play_together(labels, [film(1, 144, 144), film(1, 144, 144)])
    top = len(frame) - 144
    right = frame[top - LINE_HEIGHT : top, 150:]
    assert accent(right).any()


def test_rows_of_unequal_width_share_a_page():
    page = join([np.zeros((4, n, 3), np.uint8) for n in (10, 6)], down=True, gap=GAP)
    assert page.shape == (8 + GAP, 10, 3)
    assert (page[-1, 6:] == 255).all()


def test_actions_stand_within_their_bounds_and_the_last_one_is_that_before():
    spec = ActionSpec(("x", "y"), ("", ""), (-1, 0), (1, 4), "absolute")
    shares = action_shares(np.array([[1, 0], [0, 1], [0, 0]], np.float32), spec)
    np.testing.assert_allclose(shares, [[0, 1], [0.5, 0.75], [0.5, 0.75]])
