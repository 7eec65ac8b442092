"""Dynamics models that predict the next latent frame in one pass: from a scene, or a grid."""
