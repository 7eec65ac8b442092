"""Trained models: those that ship, those of the Hugging Face Hub, and how a run becomes one."""
