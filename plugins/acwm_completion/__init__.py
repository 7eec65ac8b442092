"""Shell completion of component names, recipes, and recipe keys with their values."""
