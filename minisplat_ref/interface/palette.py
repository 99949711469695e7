"""The colours of all figures, by name, and the resolution of their PNG files.

A page has a light and a dark value of each colour in :data:`PAGE_NAMES`; the light one is the value here. All of
:data:`SERIES` have a contrast of at least 3 to white.
"""

TITLE_COLOR = "#4a5560"
GRID_COLOR = "#e6eaee"
EDGE_COLOR = "#8a94a0"
TICK_COLOR = "#6a7580"
RED, BLUE, GREEN, PURPLE = "#b4553d", "#2d6a8e", "#4b7f52", "#8a5a9e"
OCHRE, GREY, TEAL, BROWN = "#b08a2e", "#5a6570", "#2c7f86", "#8c5a2e"
SERIES = (RED, BLUE, GREEN, PURPLE, OCHRE, GREY, TEAL, BROWN)
MIDDLE_BLUE, LIGHT_BLUE = "#6d96bd", "#a9c1d9"  # for curves of less of the same
PAGE_NAMES = {
    TITLE_COLOR: "soft",
    GRID_COLOR: "grid",
    EDGE_COLOR: "edge",
    TICK_COLOR: "faint",
    "#ffffff": "panel",
    **dict(zip(SERIES, ("red", "blue", "green", "purple", "ochre", "grey", "teal", "brown"), strict=True)),
}
PNG_DPI = 150
