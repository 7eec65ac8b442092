"""Shared simulation toolkit: a software renderer that needs no GPU and no OpenGL.

This package registers nothing; environment plugins import it. `acwm_sim.scene.Scene` is the
entrance: triangle meshes and sphere impostors under a directional light, with soft shadows,
ambient occlusion, anti-aliasing and an instance mask from the same pass, drawn on one CPU core
by Taichi kernels over numpy arrays. Equal inputs give equal bytes in every process.
"""
