"""What only a simulator can answer: other actions, perturbed starts and ensembles of futures."""
