"""Images of any kind become the colours that they show, or one sentence that names the option."""

import io
import struct
import subprocess
import zlib

import numpy as np
import pytest
from PIL import Image

from acwm_core.errors import DataError
from acwm_formats.images import guessed_range, read_image, to_rgb
from tests.formats.corpus.pictures import FAR, NEAR, SIZE, depth, number_in, picture

NUMBER = 37
COLOURS = picture(NUMBER)

SAME = {
    "bytes": COLOURS,
    "channels first": COLOURS.transpose(2, 0, 1),
    "opaque": np.dstack([COLOURS, np.full(SIZE, 255, np.uint8)]),
    "float to 1": COLOURS / np.float32(255),
    "float to 255": COLOURS.astype(np.float64),
    "half": (COLOURS / 255).astype(np.float16),
}


@pytest.mark.parametrize("image", SAME.values(), ids=SAME)
def test_the_same_picture(image):
    np.testing.assert_array_equal(to_rgb(image, pixel_range=guessed_range(image)), COLOURS)


@pytest.mark.parametrize("most", [1023, 4095, 65535])
def test_more_than_8_bits_need_to_be_told_their_range(most):
    image = np.rint(COLOURS / 255 * most).astype(np.uint16)
    with pytest.raises(DataError, match="--pixel-range"):
        guessed_range(image)
    assert np.abs(to_rgb(image, pixel_range=(0, most)).astype(int) - COLOURS).max() <= 1


def test_a_range_that_is_too_narrow_is_refused():
    with pytest.raises(DataError, match="another --pixel-range"):
        to_rgb(COLOURS.astype(np.float32), pixel_range=(0, 1))


@pytest.mark.parametrize("shape", [(1, *SIZE), (*SIZE, 1), SIZE])
def test_grey_is_repeated(shape):
    grey = COLOURS[..., 1].reshape(shape)
    np.testing.assert_array_equal(to_rgb(grey), np.repeat(COLOURS[..., 1:2], 3, 2))


def test_what_is_clear_is_laid_on_black():
    clear = np.dstack([np.full((16, 16, 3), 200, np.uint8), np.full((16, 16), 51, np.uint8)])
    assert (to_rgb(clear) == 40).all()


@pytest.mark.parametrize("image", [depth(NUMBER), depth(NUMBER).astype(np.float32) / 1000])
def test_depth_is_grey_between_two_distances(image):
    with pytest.raises(DataError, match="--depth-range"):
        to_rgb(image)
    shown = to_rgb(image, depth_range=(NEAR / 1000, FAR / 1000))
    levels = {NEAR: 255, 1000: 128, FAR: 0}
    wanted = np.vectorize(levels.get)(depth(NUMBER))
    np.testing.assert_array_equal(shown[..., 0], wanted)
    unmeasured = np.zeros(SIZE, np.uint16)
    assert not to_rgb(unmeasured, depth_range=(0.1, 2)).any()


@pytest.mark.parametrize("shape", [(3, 40, 3), (40, 40, 2), (2, 40, 40), (40,)])
def test_no_images(shape):
    with pytest.raises(DataError, match="an image is"):
        to_rgb(np.zeros(shape, np.uint8))


def test_stacked_episodes_are_no_images():
    with pytest.raises(DataError, match="five axes stacks whole episodes"):
        to_rgb(np.zeros((3, 40, 40, 3), np.uint8))


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "P", "CMYK", "L", "1", "I;16"])
def test_pictures_are_read_as_they_are_stored(mode):
    image = Image.fromarray(depth(NUMBER)) if mode == "I;16" else Image.fromarray(COLOURS)
    file = io.BytesIO()
    stored = image if mode == "I;16" else image.convert(mode)
    stored.save(file, "TIFF" if mode == "CMYK" else "PNG")
    span = (0.4, 1.6) if mode == "I;16" else None
    found = read_image(file.getvalue())
    shown = to_rgb(found, depth_range=span)
    if mode == "I;16":
        assert found.dtype == np.uint16
        shown = np.uint8(255) - shown
    assert number_in(shown, grey=mode in ("L", "1", "I;16")) == NUMBER


def test_a_phone_that_was_turned():
    """EXIF says how to turn the picture; the stored pixels are sideways."""
    exif, file = Image.Exif(), io.BytesIO()
    exif[0x0112] = 6  # turn it clockwise
    Image.fromarray(np.rot90(COLOURS)).save(file, "PNG", exif=exif)
    np.testing.assert_array_equal(to_rgb(read_image(file.getvalue())), COLOURS)


def stored(kind, image=None):
    """A picture in a file of some kind."""
    file = io.BytesIO()
    (image or Image.fromarray(COLOURS)).save(file, kind)
    return file.getvalue()


OTHER_KINDS = {kind: stored(kind) for kind in ("EPS", "PPM", "TGA", "PCX", "GIF", "ICO", "PDF")} | {
    "a loop of PostScript": b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n{ } loop\n",
    "EPS of Windows": b"\xc5\xd0\xd3\xc6" + bytes(26) + b"%!PS-Adobe-3.0\n",
    "nothing": b"",
    "text": b"GIF89a of nothing",
}


@pytest.mark.parametrize("data", OTHER_KINDS.values(), ids=OTHER_KINDS)
def test_pictures_of_other_kinds_are_never_opened(tmp_path, monkeypatch, data):
    """Pillow hands some to programs, such as EPS to Ghostscript, which runs them."""
    monkeypatch.setattr(subprocess, "Popen", None)
    path = tmp_path / "0.png"
    path.write_bytes(data)
    for source in (data, path):
        with pytest.raises(DataError, match="not a picture in PNG, JPEG, WEBP, BMP, TIFF"):
            read_image(source)


def test_the_bytes_tell_the_kind(tmp_path):
    for kind in ("PNG", "WEBP", "BMP", "TIFF"):
        path = tmp_path / f"{kind}.jpg"
        path.write_bytes(stored(kind))
        assert number_in(to_rgb(read_image(path))) == NUMBER


@pytest.mark.parametrize("kind", ["TIFF", "WEBP", "PNG"])
def test_a_file_of_several_pictures_is_refused(kind):
    """Of which the first would be taken, in silence."""
    first, other = (Image.new("RGB", (8, 8), colour) for colour in ("red", "blue"))
    buffer = io.BytesIO()
    first.save(buffer, kind, save_all=True, append_images=[other])
    with pytest.raises(DataError, match="holds 2 pictures"):
        read_image(buffer.getvalue())


def claiming(kind, width, height):
    """A small picture whose header claims another size."""
    data = bytearray(stored(kind, Image.new("L", (8, 8))))
    if kind == "PNG":
        data[16:24] = struct.pack(">II", width, height)
        data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    elif kind == "BMP":
        data[18:26] = struct.pack("<ii", width, height)
    else:
        place = data.index(b"\xff\xc0")
        data[place + 5 : place + 9] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize("kind", ["PNG", "BMP", "JPEG"])
@pytest.mark.parametrize("size", [(9000, 9000), (60_000, 60_000), (65_000, 1100)])
def test_pictures_that_would_fill_the_memory(kind, size, recwarn):
    with pytest.raises(DataError, match="pixels"):
        read_image(claiming(kind, *size))
    assert not recwarn.list
