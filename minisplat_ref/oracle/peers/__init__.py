"""Other renderers, called through their own functions."""
