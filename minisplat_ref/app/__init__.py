"""The application: what ``minisplat-ref`` does beyond the library, and nothing below imports.

===================== =============================================================================
:mod:`.cli`           one thin module per command
:mod:`.runs`          a training and its folder: settings, checkpoints, evaluation, simplification
:mod:`.comparison`    several runs side by side
:mod:`.blocks`        one large scene in blocks
:mod:`.viewer`        a scene in the browser, live or as one page
:mod:`.reports`       pages, plots and images of results
:mod:`.film`          images as a film
:mod:`.listing_file`  a scene without its pixels as a file, for workers
===================== =============================================================================
"""
