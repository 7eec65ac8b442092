"""What a shell completes: names of components, recipes, and keys of recipes with their values."""
