"""The report kit: parts of pages, plots and images of results.

:mod:`.page` and :mod:`.page_style` make one HTML file of cards, tables and panels, :mod:`.plots` plots curves as SVG
and PNG in the colours of :mod:`minisplat_ref.interface.palette`, :mod:`.images` turns renders, errors and depths into
images for the eye, :mod:`.commands` writes command lines that a reader can copy, and :mod:`.check_report` is the page
of ``oracle`` and ``bench``. Tables in Markdown and the description of the machine are in
:mod:`minisplat_ref.interface.reporting`.
"""
