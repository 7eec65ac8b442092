"""What a dataset tells about itself: lengths, actions, frames, near-duplicates, and delays."""
