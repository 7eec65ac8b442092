"""Evaluation: predict the test clips, score them beside reference rows, and summarise.

Import what you need from its modules; `config` and `results` do not import torch.
"""
