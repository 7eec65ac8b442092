"""Data: simulate episodes, pack them into shards, and read them back as clips for training."""
