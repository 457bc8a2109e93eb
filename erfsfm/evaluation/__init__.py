"""How good depth and motion are, in the protocols of the papers."""
