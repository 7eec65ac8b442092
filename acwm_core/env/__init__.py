"""Environments: the interface, cards, episodes, what can be measured, and tasks. No torch."""
