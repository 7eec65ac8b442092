"""Data: simulate episodes, pack them in shards, and read them back as clips for training."""
