"""What a dataset tells about itself: lengths, actions, frames, twins, and what follows what."""
