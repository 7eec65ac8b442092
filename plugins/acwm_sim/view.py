"""The numbers that every kernel needs, packed in one array to keep launches cheap."""

import math

import numpy as np
from numpy.typing import NDArray

from acwm_sim.camera import Camera, Light, linear
from acwm_sim.parts import Fluid

# Offsets into the packed view; the comments give the length and content.
ROTATION = 0  # 9: rows right, up, forward
EYE = 9  # 3: metres
FOCAL = 12  # 1: focal length in samples
CENTER_X = 13  # 1: principal point in samples
CENTER_Y = 14
ACROSS = 15  # 4: world to shadow-map column in texels (x, y, z, offset)
ALONG = 19  # 4: world to shadow-map row in texels
DEEP = 23  # 4: world to depth along the light, metres
TEXEL = 27  # 1: texels per metre
BLUR = 28  # 1: half width of a shadow's edge, texels
BIAS = 29  # 1: shadow bias, metres
AO_RADIUS = 30  # 1: reach of ambient occlusion, metres
SUN = 31  # 3: linear colour
SKY = 34  # 3
BOUNCE = 37  # 3
BACKGROUND = 40  # 3
DISC = 43  # 2 × TAPS: points spread evenly over the unit disc
TAPS = 16
ABSORB = DISC + 2 * TAPS  # 3: what the fluid absorbs, 1/m
BODY = ABSORB + 3  # 3: linear colour of the light that the fluid scatters
HAZE = ABSORB + 6  # 1: how fast scattered light grows with thickness, 1/m
GRAIN = ABSORB + 7  # 1: radius of the fluid's particles as they are drawn, metres
LENGTH = ABSORB + 8

NEAR = 0.02
"""Near plane in metres: nothing closer to the eye is drawn."""

INFLATE = 1.5
"""Drawn radius of a fluid particle, relative to half the spacing, so that the gaps close."""

SHARE = 8 / (4 / 3 * math.pi * INFLATE**3)
"""A particle represents a cube as wide as the spacing: this share of the ball that is drawn."""


def pack(
    camera: Camera,
    light: Light,
    grid: tuple[int, int],
    focus: tuple[tuple[float, float, float], float],
    texels: int,
    footprint: float,
    ao_radius: float,
) -> NDArray[np.float32]:
    """Pack a view for a grid of samples (rows, columns).

    Args:
        camera: the camera.
        light: sun and sky.
        grid: samples down and across the frame.
        focus: centre and radius in metres of the ball that the shadow map covers.
        texels: side of the shadow map.
        footprint: samples along a side of a pixel; shadows are blurred by at least half a pixel.
        ao_radius: reach of ambient occlusion in metres.
    """
    rows, columns = grid
    center, radius = np.asarray(focus[0], np.float32), focus[1]
    focal, texel, basis = camera.focal(rows), texels * 0.5 / radius, light.basis
    distance = float(np.linalg.norm(center - np.asarray(camera.eye)))
    half_pixel = 0.5 * footprint * distance / focal
    view = np.zeros(LENGTH, np.float32)
    view[ROTATION:EYE] = (camera.axes * [[1.0], [-1.0], [1.0]]).ravel()  # right, up, forward
    view[EYE:FOCAL] = camera.eye
    view[FOCAL], view[CENTER_X], view[CENTER_Y] = focal, columns * 0.5, rows * 0.5
    for at, row, scale in ((ACROSS, 0, texel), (ALONG, 1, texel), (DEEP, 2, 1.0)):
        middle = texels * 0.5 if at != DEEP else 0.0
        view[at : at + 3] = basis[row] * scale
        view[at + 3] = middle - basis[row] @ center * scale
    view[TEXEL], view[BLUR] = texel, max(light.softness, half_pixel) * texel
    view[BIAS] = 1.0 / texel
    view[AO_RADIUS] = ao_radius
    view[SUN:SKY], view[SKY:BOUNCE], view[BOUNCE:BACKGROUND] = light.sun, light.sky, light.bounce
    view[BACKGROUND:DISC] = linear(light.background)
    view[DISC:ABSORB] = _disc(TAPS).ravel()
    return view


def pack_fluid(view: NDArray[np.float32], fluid: Fluid) -> None:
    """Write the look of a fluid into a packed view."""
    left = np.clip(fluid.color, 1e-4, 1.0)
    view[ABSORB:BODY] = -np.log(left) / fluid.depth
    view[BODY:HAZE] = fluid.color
    view[HAZE] = -math.log(max(1 - fluid.haze, 1e-4)) / fluid.depth
    view[GRAIN] = INFLATE * fluid.radius


def _disc(points: int) -> NDArray[np.float32]:
    """Points spread evenly over the unit disc in a sunflower pattern, [points, 2]."""
    k = np.arange(points) + 0.5
    angle, radius = k * math.pi * (3 - math.sqrt(5)), np.sqrt(k / points)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]).astype(np.float32)
