"""Training with Lightning: module, data, callbacks, run folders and `fit`.

This is the only package that imports lightning. Import what you need from its modules; `config`
does not import torch, and `run` loads a trained model without lightning.
"""
