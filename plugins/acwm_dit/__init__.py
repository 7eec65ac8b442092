"""The ACWM-DiT: a video diffusion transformer in several sizes, and its action conditioners."""
