"""Evaluation: roll out the test clips beside reference rows, and sum up.

Import what you need from its modules; `config` and `results` are free of torch.
"""
