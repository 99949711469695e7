"""Compact files of Gaussians: order, bytes and container.

A relative brings integers, which is its own business to quantise, and a header. :mod:`.morton` sorts points so that
neighbours in the file are similar, :mod:`.planes` splits integers into planes of bytes, :mod:`.container` packs named
streams with zstandard and reads them back without trusting a claimed size. :mod:`.pieces` has the rows of a large
population a few at a time, :mod:`.deflating` gzip streams at a level that their size allows.
"""
