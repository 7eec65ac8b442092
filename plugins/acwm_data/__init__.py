"""Shows datasets, checks them, takes them in and out, and encodes them."""
