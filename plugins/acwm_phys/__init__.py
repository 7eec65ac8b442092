"""The benchmark ACWM-Phys (arXiv 2605.08567): its protocol and its published figures."""
