"""Training with Lightning: task, data module, callbacks, run folders and `fit`.

The only package that imports lightning. Import what you need from its modules; `config` is free of
torch, and `run` loads a trained model without lightning.
"""
