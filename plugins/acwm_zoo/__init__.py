"""Trained models: shipped ones, those on the Hugging Face Hub, and making one from a run."""
