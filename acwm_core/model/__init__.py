"""World models: codec, conditioner and dynamics, how they learn, and how they predict."""
