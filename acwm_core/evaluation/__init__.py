"""Evaluation: roll out the test clips beside reference rows, sum up, report.

Import what you need from its modules; `config` and `report` are free of torch.
"""
