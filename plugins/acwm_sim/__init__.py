"""Shared simulation toolkit: a software renderer that needs no GPU and no OpenGL.

This package registers nothing; environment plugins import it. Start with `acwm_sim.scene.Scene`.
It draws triangle meshes and sphere impostors under a directional light, with soft shadows, ambient
occlusion and anti-aliasing, and an instance mask from the same pass. Taichi kernels over numpy
arrays do the drawing on one CPU core. Equal inputs give equal bytes in every process.
"""
