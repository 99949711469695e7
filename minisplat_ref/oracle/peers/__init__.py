"""Other renderers, called through their own functions: ``gsplat_torch`` on the CPU, ``cuda`` on a GPU."""
