"""Dynamics models that compute the next latent frame at once, from a state that they carry on."""
